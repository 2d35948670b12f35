"""How large the house is: lines and files of each room, imports, tests, pages, public names.

Figures to look at, beside what is aimed at; nothing is asserted.

Run:  python benchmarks/house.py
"""

from __future__ import annotations

import ast
import re
import statistics
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
AIMS = {
    "planning": (8000, 40),
    "fitting": (13000, 55),
    "control": (7500, 35),
    "bench": (6000, 25),
    "plants": (7000, 38),
    "export": (5000, 28),
    "core": (3500, 20),
}
"""Lines and files of a room."""


def lines(files: Iterable[Path]) -> int:
    return sum(len(f.read_text("utf-8").splitlines()) for f in files)


def sources(folder: str) -> list[Path]:
    """Python files of a folder, without environments that tests make."""
    found = (ROOT / folder).rglob("*.py")
    return [
        f for f in found if not any(part.startswith(".") for part in f.parts[len(ROOT.parts) :])
    ]


def relative_imports(file: Path) -> int:
    """Modules that a file imports from the package."""
    tree = ast.parse(file.read_text("utf-8"))
    return len(
        {
            (node.level, node.module)
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.level
        }
    )


def longest(files: Iterable[Path]) -> list[tuple[int, str]]:
    """Functions of more than 50 lines: (lines, where)."""
    found = []
    for file in files:
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                size = (node.end_lineno or node.lineno) - node.lineno + 1
                if size > 50:
                    found.append((size, f"{file.relative_to(ROOT)}:{node.lineno} {node.name}"))
    return sorted(found, reverse=True)


def face(stub: Path) -> list[str]:
    """Public names of a stub that are no subpackages or modules."""
    text = stub.read_text("utf-8")
    names = re.findall(r"^from \.(\S*) import (?:\w+ as )?(\w+)$", text, re.M)
    homes = {name: stub.parent.joinpath(*place.split("."), name) for place, name in names}
    return [n for n, at in homes.items() if not at.is_dir() and not at.with_suffix(".py").is_file()]


def words(page: Path) -> int:
    return len(page.read_text("utf-8").split())


def main() -> None:
    rooms = sorted(f.parent.name for f in (ROOT / "pam_ocp").glob("*/__init__.py"))
    print(f"{'room':<12}{'lines':>8}{'aim':>8}{'files':>7}{'aim':>5}")
    for room in rooms:
        files = sources(f"pam_ocp/{room}")
        aim = AIMS.get(room, ("", ""))
        print(f"{room:<12}{lines(files):>8}{aim[0]:>8}{len(files):>7}{aim[1]:>5}")
    package = sources("pam_ocp")
    print(f"{'package':<12}{lines(package):>8}{65000:>8}{len(package):>7}{330:>5}")
    imports = sorted(relative_imports(f) for f in package)
    p90 = imports[int(0.9 * len(imports))]
    print(f"relative imports of a file: median {statistics.median(imports):g}, p90 {p90} (aim 8)")
    long_ones = longest(package)
    print(f"functions of more than 50 lines: {len(long_ones)}")
    for size, where in long_ones[:5]:
        print(f"    {size:>4}  {where}")
    for folder, aim in (("tests", 28000), ("benchmarks", 6000)):
        print(f"{folder}: {lines(sources(folder))} lines (aim {aim})")
    hand_written = set((ROOT / "docs").glob("*.md")) - {ROOT / "docs" / "components.md"}
    pages = sorted(hand_written, key=words, reverse=True)
    readme = words(ROOT / "README.md")
    print(f"docs: {sum(map(words, pages))} words (aim 32000); README {readme} (500)")
    print("    " + ", ".join(f"{page.stem} {words(page)}" for page in pages[:8]))
    names = face(ROOT / "pam_ocp" / "__init__.pyi")
    shown = "".join(f.read_text("utf-8") for f in [*pages, *sources("examples")])
    unseen = [name for name in names if not re.search(rf"\b{name}\b", shown)]
    print(
        f"face: {len(names)} names (aim 60), in no page or example: {', '.join(unseen) or 'none'}"
    )


if __name__ == "__main__":
    main()
