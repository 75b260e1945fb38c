"""Take the picture of the README: ``python -m docs.scripts.make_picture out/demo/bridge/report.html``."""

from __future__ import annotations

import sys
from pathlib import Path

WIDTH, HEIGHT = 1060, 1240
PICTURE = Path(__file__).resolve().parents[1] / "pictures/report.png"
# The verdicts and the view in space stand next to each other in the picture; on the page tables lie between them.
HIDE_TABLES = """() => {
    const verdicts = document.querySelector('ul.verdicts');
    let node = document.querySelector('.live');
    for (; node && !node.contains(verdicts); node = node.parentElement)
        for (let before = node.previousElementSibling; before; before = before.previousElementSibling)
            if (verdicts.compareDocumentPosition(before) & Node.DOCUMENT_POSITION_FOLLOWING)
                before.style.display = 'none';
    window.dispatchEvent(new Event('resize'));
}"""


def main(page: Path) -> None:
    """Write docs/pictures/report.png: verdicts and view of a report."""
    from tests.support.pages.browser import opened

    with opened(page.resolve(), WIDTH, HEIGHT) as shown:
        shown.evaluate(HIDE_TABLES)
        shown.wait_for_timeout(500)
        shown.screenshot(path=str(PICTURE))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
