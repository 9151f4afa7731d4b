#!/usr/bin/env python3
"""Draw the rooms of lce_rig and the imports between them into docs/images/architecture.svg.

Rooms stand in the layers of pyproject.toml's import contract. An arrow is an import that no chain of other
imports implies. A test compares the drawing with the code.
"""

import ast
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.sax.saxutils import escape

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
_BOX_PX, _GAP_PX, _ROW_PX, _WIDTH_PX = (132, 40), 44, 92, 890


def layers() -> list[list[str]]:
    """Read the layers of rooms, the topmost first."""
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (contract,) = config["tool"]["importlinter"]["contracts"]
    return [[room.strip().removeprefix("lce_rig.") for room in row.split("|")] for row in contract["layers"]]


def imports(rooms: Iterable[str]) -> dict[str, set[str]]:
    """Find which rooms each room imports."""
    known = set(rooms)
    found: dict[str, set[str]] = {}
    for room in known:
        names: set[str] = set()
        for path in sorted((ROOT / "lce_rig" / room.replace(".", "/")).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom):
                    names.add(node.module or "")
                elif isinstance(node, ast.Import):
                    names |= {alias.name for alias in node.names}
        found[room] = {
            other
            for other in known - {room}
            if any(f"{name}.".startswith(f"lce_rig.{other}.") for name in names)
        }
    return found


def reduced(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Remove imports implied by a chain of others."""

    def reached(room: str) -> set[str]:
        return set().union(*({target} | reached(target) for target in graph[room]), set())

    return {
        room: {t for t in targets if not any(t in reached(other) for other in targets - {t})}
        for room, targets in graph.items()
    }


def summary(room: str) -> str:
    """Take the first clause of a room's docstring."""
    text = (
        ast.get_docstring(ast.parse((ROOT / "lce_rig" / room.replace(".", "/") / "__init__.py").read_text()))
        or ""
    )
    return text.partition("\n")[0].partition(":")[0].partition(";")[0].rstrip(".")


def draw() -> str:
    """Write the picture as SVG."""
    rows = layers()
    graph = reduced(imports(room for row in rows for room in row))
    width, height = _BOX_PX
    place = {}
    for level, row in enumerate(rows):
        left = (_WIDTH_PX - len(row) * width - (len(row) - 1) * _GAP_PX) / 2
        for k, room in enumerate(row):
            place[room] = (left + k * (width + _GAP_PX), 20 + level * _ROW_PX)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH_PX} {len(rows) * _ROW_PX}" '
        'font-family="Helvetica, Arial, sans-serif">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto"><path d="M0 0 8 4 0 8z" fill="#6b7a8f"/></marker></defs>',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    for room in sorted(graph):
        x, y = place[room][0] + width / 2, place[room][1] + height
        for target in sorted(graph[room]):
            u, v = place[target][0] + width / 2, place[target][1]
            bend = (v - y) / 2
            lines.append(
                f'<path d="M{x:.0f} {y:.0f} C{x:.0f} {y + bend:.0f} {u:.0f} {v - bend:.0f} {u:.0f} {v:.0f}" '
                'fill="none" stroke="#6b7a8f" stroke-width="1.3" marker-end="url(#tip)"/>'
            )
    for room, (x, y) in place.items():
        lines += [
            f'<g><title>{escape(summary(room))}</title><rect x="{x:.0f}" y="{y:.0f}" width="{width}" '
            f'height="{height}" rx="6" fill="#eef3f9" stroke="#2f5d8a"/>',
            f'<text x="{x + width / 2:.0f}" y="{y + height / 2 + 5:.0f}" text-anchor="middle" '
            f'font-size="16" fill="#14283d">{room}</text></g>',
        ]
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(draw())
    print(PICTURE.relative_to(ROOT))
