"""Draw docs/pictures/rooms.svg, the rooms of processor and who imports whom: ``python -m docs.scripts.make_rooms``."""

from __future__ import annotations

from pathlib import Path

from tests.support.structure import MODULES, STEPS, used_modules

PICTURE = Path(__file__).resolve().parents[1] / "pictures/rooms.svg"
# Files that are rooms by themselves; other files of processor beside the folders are small tools of many rooms.
FILES = ("pipeline", "scene_cloud", "views")
CORE = ("views", "scene_cloud", "geometry", "registration", "adjustment", "limits", *STEPS)  # docs/architecture.md
# Drawn size, in pixels: text of 13 fits a box of 30, and eight rooms a row fit 1000.
WIDTH, BOX, APART, LETTER, PAD = 1000.0, 30.0, 62.0, 7.4, 18.0
STYLE = """text { font: 13px sans-serif; text-anchor: middle; fill: #222 }
rect { fill: #f2f2f2; stroke: #777; rx: 4 } .core { fill: #d5e8f5; stroke: #005a94 }
.step { fill: #fbe3d3; stroke: #b34700 }
line { stroke: #999; stroke-width: 1 }"""


def rooms() -> dict[str, set[str]]:
    """Return the rooms that each room imports."""
    names = {name.split(".")[1] for name in MODULES if name.startswith("processor.") and name.count(".") > 1}
    names |= set(FILES)
    found: dict[str, set[str]] = {name: set() for name in sorted(names - {"__main__"})}
    for module in MODULES:
        room = module.split(".")[1] if module.startswith("processor.") else ""
        if room in found:
            used = (other.split(".")[1] for other in used_modules(module) if other.startswith("processor."))
            found[room] |= {other for other in used if other in found and other != room}
    return found


def ranks(used: dict[str, set[str]]) -> dict[str, int]:
    """Return the row of each room, from 0: above all rooms that it imports; the steps are in one row."""
    rank = dict.fromkeys(used, 0)
    for _ in used:
        rank = {name: max((rank[other] + 1 for other in others), default=0) for name, others in used.items()}
        rank |= dict.fromkeys(STEPS, max(rank[step] for step in STEPS))
    return rank


def arrows(used: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Return pairs of a room and one that it imports, without those that follow from others (transitive reduction)."""
    below: dict[str, set[str]] = {}
    for name in sorted(used, key=ranks(used).__getitem__):
        below[name] = used[name].union(*(below[other] for other in used[name]))
    return [
        (name, other)
        for name, others in used.items()
        for other in sorted(others)
        if not any(other in below[between] for between in others)
    ]


def places(rank: dict[str, int], drawn: list[tuple[str, str]]) -> dict[str, tuple[float, float]]:
    """Return the middle of each room's box: rows from the lowest up, in each the rooms above what they import."""
    x = dict.fromkeys(rank, 0.5 * WIDTH)
    top = max(rank.values())
    for row in range(top + 1):
        here = [name for name, of_room in rank.items() if of_room == row]
        lower = {name: [x[b] for a, b in drawn if a == name] or [x[name]] for name in here}
        here.sort(key=lambda name: (sum(lower[name]) / len(lower[name]), name))
        room = (WIDTH - sum(_width(name) for name in here)) / (len(here) + 1)
        left = room
        for name in here:
            x[name] = left + 0.5 * _width(name)
            left += _width(name) + room
    return {name: (x[name], (top - rank[name] + 0.5) * APART) for name in rank}


def _width(name: str) -> float:
    return LETTER * len(name) + PAD


def picture() -> str:
    """Return the picture as SVG."""
    used = rooms()
    rank, drawn = ranks(used), arrows(used)
    at = places(rank, drawn)
    height = (max(rank.values()) + 1) * APART
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:.0f} {height:.0f}">',
        "<title>Rooms of processor: each imports from rooms below it alone</title>",
        f"<style>{STYLE}</style>",
    ]
    for pair in drawn:
        (x1, y1), (x2, y2) = (at[name] for name in pair)
        lines.append(f'<line x1="{x1:.0f}" y1="{y1 + BOX / 2:.0f}" x2="{x2:.0f}" y2="{y2 - BOX / 2:.0f}"/>')
    for name, (x, y) in at.items():
        kind = "step" if name in STEPS else "core" if name in CORE else ""
        wide, left, top = _width(name), x - _width(name) / 2, y - BOX / 2
        lines += [
            f'<rect class="{kind}" x="{left:.0f}" y="{top:.0f}" width="{wide:.0f}" height="{BOX:.0f}"/>',
            f'<text x="{x:.0f}" y="{y + 4:.0f}">{name}</text>',
        ]
    return "\n".join([*lines, "</svg>"]) + "\n"


if __name__ == "__main__":
    PICTURE.write_text(picture(), "utf-8")
