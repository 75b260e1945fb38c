"""Take the picture of the README: ``python -m docs.scripts.make_picture out/demo/bridge/report.html``."""

from __future__ import annotations

import sys
from pathlib import Path

WIDTH, HEIGHT = 1060, 1240
PICTURE = Path(__file__).resolve().parents[1] / "pictures/report.png"


def main(page: Path) -> None:
    """Write docs/pictures/report.png: the sheet of a report, as its page begins."""
    from tests.support.pages.browser import opened

    with opened(page.resolve(), WIDTH, HEIGHT) as shown:
        shown.screenshot(path=str(PICTURE))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
