"""The arrows between rooms, read off the imports; ``python docs/rooms.py`` draws them anew.

Every import statement of pam_ocp counts: at the top of a module, inside a function, and under
``TYPE_CHECKING``. The picture in docs/architecture.md is drawn by this script and compared with
it by tests/package/test_architecture.py.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- rooms: drawn by docs/rooms.py -->", "<!-- /rooms -->"
DOOR = "pam_ocp.courtesy"

Graph = dict[str, set[str]]


def modules(package: Path) -> dict[str, Path]:
    """{dotted name: file} of a package and all below it."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name: str, path: Path, known: Mapping[str, Path]) -> Iterator[str]:
    """The modules among ``known`` that a module names in any of its import statements."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*(above if node.level else ()), *([node.module or ""])]).strip(".")
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                if inner in known or base in known:
                    yield inner if inner in known else base


def arrows(package: Path) -> Graph:
    """{module: the modules that it imports}, itself left out."""
    known = modules(package)
    return {name: set(imported(name, path, known)) - {name} for name, path in known.items()}


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Groups of more than one node in which each leads to every other (R. Tarjan, 1972)."""
    number: dict[str, int] = {}
    least: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        number[node] = least[node] = len(number)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in number:
                visit(other)
                least[node] = min(least[node], least[other])
            elif other in stack:
                least[node] = min(least[node], number[other])
        if least[node] == number[node]:
            group = stack[stack.index(node) :]
            del stack[-len(group) :]
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(graph):
        if node not in number:
            visit(node)
    return found


def behind_the_door(graph: Graph) -> Graph:
    """The graph without what the door leads to."""
    return {name: set() if name == DOOR else others for name, others in graph.items()}


def rooms(graph: Mapping[str, set[str]]) -> Graph:
    """The same between rooms: the folders of pam_ocp that import, or are imported."""

    def room(name: str) -> str:
        return name.split(".")[1] if "." in name else ""

    outside = {"", "__main__", "courtesy", "data"}
    found: Graph = {room(name): set() for name in graph if room(name) not in outside}
    for name, others in graph.items():
        if room(name) in found:
            found[room(name)] |= {room(o) for o in others} - outside - {room(name)}
    return found


def reachable(graph: Mapping[str, set[str]], start: str) -> set[str]:
    """All nodes that arrows lead to from one, itself left out unless on a circle."""
    found: set[str] = set()
    new = set(graph[start])
    while new:
        found |= new
        new = {o for n in new for o in graph[n]} - found
    return found


def floors(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Rooms by the length of the longest way down from them, the highest first."""
    depth: dict[str, int] = {}

    def height(room: str) -> int:
        if room not in depth:
            depth[room] = 1 + max((height(o) for o in graph[room]), default=-1)
        return depth[room]

    top = max(height(room) for room in graph)
    return [sorted(r for r in graph if depth[r] == level) for level in range(top, -1, -1)]


def direct(graph: Mapping[str, set[str]]) -> list[tuple[str, str]]:
    """(room, room below) of the arrows that do not follow from others, the highest first."""
    return [
        (room, other)
        for room in (r for level in floors(graph) for r in level)
        for other in sorted(graph[room])
        if not any(other in reachable(graph, via) for via in graph[room] - {other})
    ]


def drawn(graph: Mapping[str, set[str]]) -> str:
    """A Mermaid picture without the arrows that follow from others."""
    lines = ["```mermaid", "flowchart TD", *(f"    {a} --> {b}" for a, b in direct(graph))]
    return "\n".join([*lines, "```"])


def drawing(graph: Mapping[str, set[str]]) -> str:
    """The same as an SVG in the colours of the page around it, for the site."""
    levels, box, step = floors(graph), (96, 26), 52
    width = 120 * max(map(len, levels))
    at = {
        room: (width / 2 + 120 * (i - (len(level) - 1) / 2), step * row + 20)
        for row, level in enumerate(levels)
        for i, room in enumerate(level)
    }
    lines = []
    for a, b in direct(graph):
        (x, y), (u, v) = at[a], at[b]
        y, v = y + box[1] / 2, v - box[1] / 2
        lines += [f'<path d="M{x:g} {y:g}C{x:g} {y + 26:g} {u:g} {v - 26:g} {u:g} {v:g}"/>']
    rooms = []
    for room, (x, y) in at.items():
        corner = f'x="{x - box[0] / 2:g}" y="{y - box[1] / 2:g}"'
        rooms += [f'<rect {corner} width="{box[0]}" height="{box[1]}" rx="4"/>']
        rooms += [f'<text x="{x:g}" y="{y + 4:g}">{room}</text>']
    size = f'viewBox="0 0 {width} {step * len(levels)}"'
    said = "; ".join(f"{a} imports {b}" for a, b in direct(graph))
    return "\n".join(
        [
            "```{raw} html",
            f'<svg class="rooms" role="img" aria-label="{said}" {size}>',
            *lines,
            *rooms,
            "</svg>",
            "```",
        ]
    )


def page(text: str, picture: str) -> str:
    """The page with the picture between its marks."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{picture}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    graph = rooms(behind_the_door(arrows(ROOT / "pam_ocp")))
    PAGE.write_text(page(PAGE.read_text("utf-8"), drawn(graph)), "utf-8")
