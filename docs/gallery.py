"""The gallery: every example as a notebook, run by a kernel of its own, and its picture.

python docs/gallery.py [FOLDER] [NAME ...] [--anew]

A script becomes a notebook so: its docstring is the title and the text, ``# %%`` begins a cell,
comments behind it are text, and what it saves as a picture is shown instead. Pages whose blocks
run are run in the same way; under each block stands what it printed and drew.

What ran stands in the repository with the hash of what was run: so the site is built in a minute
where nothing changed, and on hosts that have not all that examples use. ``--anew`` runs all of it
again (seven minutes of the processor), as CI does.
"""

from __future__ import annotations

import ast
import base64
import hashlib
import io
import json
import re
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parent / "examples"
TITLE = re.compile(r"(.+?)[:.](?:\s|$)", re.S)
SHORT = r"""
import warnings

warnings.formatwarning = lambda message, kind, *_: f"{kind.__name__}: {message}\n"
"""
"""Warnings without the place in a kernel's file."""


def groups() -> dict[str, list[str]]:
    """{heading: names of examples}, as the folder's own page lists them."""
    found: dict[str, list[str]] = {}
    for line in (EXAMPLES / "README.md").read_text("utf-8").splitlines():
        if line.startswith("## "):
            heading = found.setdefault(line[3:], [])
        elif match := re.fullmatch(r"- \[(\w+)\]\(\1\.py\)", line):
            heading.append(match[1])
    return found


def words(source: str) -> tuple[str, str]:
    """Title and text of an example, from its docstring."""
    text = ast.get_docstring(ast.parse(source)) or ""
    text = re.sub(r"\n*^(Run|Usage): .*", "", text, flags=re.M).strip()
    match = TITLE.match(text)
    assert match, "an example begins with a docstring"
    return " ".join(match[1].split()), text


def shown(code: str) -> str:
    """The code with ``display(figure)`` in place of ``figure.savefig(...)``."""
    spots = [
        node
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "savefig"
    ]
    for node in sorted(spots, key=lambda n: (n.lineno, n.col_offset), reverse=True):
        whole = ast.get_source_segment(code, node)
        figure = ast.get_source_segment(code, node.func.value)  # type: ignore[attr-defined]
        assert whole is not None
        code = code.replace(whole, f"display({figure})")
    last = ast.parse(code).body[-1:]
    if (
        last
        and isinstance(last[0], ast.Expr)
        and not re.match(r"print|display", ast.unparse(last[0]))
    ):
        return f"{code.rstrip()};\n"  # a legend that was made, say, is no result
    return code


def notebook(path: Path) -> Any:
    """An example as a notebook that has not run yet."""
    from nbformat import v4

    source = path.read_text("utf-8")
    title, text = words(source)
    docstring = ast.parse(source).body[0]
    code = "".join(source.splitlines(keepends=True)[docstring.end_lineno :])
    first, *others = re.split(r"^# %%.*\n", code, flags=re.M)
    said = f"# {title}\n\n{text}\n\nAs a script: `examples/{path.name}`."
    cells = [v4.new_markdown_cell(said)]
    ready = f"%matplotlib inline\n{SHORT}\nimport sys\n\nsys.argv[1:] = ['.']  # results go here"
    cells.append(v4.new_code_cell(ready, metadata={"tags": ["remove-cell"]}))
    for part in (first, *others):
        comment = re.match(r"(?:#.*\n)*", part)[0] if part is not first else ""  # type: ignore[index]
        if comment.strip():
            cells.append(v4.new_markdown_cell(re.sub(r"^# ?", "", comment, flags=re.M).strip()))
        if body := shown(part[len(comment) :]).strip():
            cells.append(v4.new_code_cell(body))
    for number, cell in enumerate(cells):
        cell.id = f"{path.stem.replace('_', '-')}-{number}"
    made = v4.new_notebook(cells=cells)
    made.metadata.kernelspec = {"name": "python3", "display_name": "Python 3", "language": "python"}
    made.metadata.source = hashlib.sha256(source.encode()).hexdigest()
    return made


def run(name: str, made: Any, folder: Path, anew: bool = False) -> Path:
    """``folder/NAME.ipynb`` with its outputs, and ``NAME.png``; kept while the example stays, but
    for ``anew``.
    """
    import nbformat
    from nbclient import NotebookClient

    target, picture = folder / f"{name}.ipynb", folder / f"{name}.png"
    before = nbformat.read(target, as_version=4) if target.is_file() else None
    if anew or before is None or before.metadata.get("source") != made.metadata.source:
        with tempfile.TemporaryDirectory() as place:
            NotebookClient(made, timeout=1800, resources={"metadata": {"path": place}}).execute()
        for cell in made.cells:
            cell.metadata.pop("execution", None)  # times of day
        for data in pictures(made):
            data["image/png"] = base64.b64encode(
                small(base64.b64decode(data["image/png"]))
            ).decode()
        assert pictures(made), f"{name} shows no picture"
        nbformat.write(made, target)
        before = made
        picture.unlink(missing_ok=True)
    if not picture.is_file():
        picture.write_bytes(base64.b64decode(pictures(before)[0]["image/png"]))
    return target


def pictures(made: Any) -> list[Any]:
    """Data of a notebook's outputs that are pictures."""
    outputs = [o for cell in made.cells if cell.cell_type == "code" for o in cell.outputs]
    return [o.data for o in outputs if "image/png" in o.get("data", {})]


def small(png: bytes) -> bytes:
    """A picture in 128 colours, which is a third of its size and looks the same in a plot."""
    from PIL import Image

    made = io.BytesIO()
    image = Image.open(io.BytesIO(png)).convert("RGB").quantize(128, dither=Image.Dither.NONE)
    image.save(made, "PNG", optimize=True)
    return min(png, made.getvalue(), key=len)


def make(folder: Path, names: list[str] | None = None, anew: bool = False) -> list[Path]:
    """Run examples, two at a time."""
    known = [name for group in groups().values() for name in group]
    chosen = names or known
    if unknown := set(chosen) - {*known}:
        raise SystemExit(f"unknown examples {sorted(unknown)}; known: {', '.join(known)}")
    folder.mkdir(parents=True, exist_ok=True)
    # before the threads: Python 3.11 parses in one alone
    made = [notebook(EXAMPLES / f"{name}.py") for name in chosen]
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(partial(run, folder=folder, anew=anew), chosen, made))


def index(folder: Path) -> None:
    """``folder/index.md``: a card for each example."""
    lines = [
        "# Gallery",
        "",
        "Each was run for this page, by a kernel of its own: what it printed and drew is shown.",
        "",
    ]
    names = []
    for heading, group in groups().items():
        lines += [f"## {heading}", "", "::::{grid} 1 2 3 3", ":gutter: 2", ""]
        for name in group:
            title, _ = words((EXAMPLES / f"{name}.py").read_text("utf-8"))
            lines += [
                f":::{{grid-item-card}} {title}",
                f":img-top: {name}.png",
                f":link: {name}",
                ":link-type: doc",
                ":::",
                "",
            ]
            names.append(name)
        lines += ["::::", ""]
    lines += ["```{toctree}", ":hidden:", "", *names, "```", ""]
    text, target = "\n".join(lines), folder / "index.md"
    if not target.is_file() or target.read_text("utf-8") != text:
        target.write_text(text, "utf-8")


# -- pages: under each block what it printed and drew ---------------------------------------------

PAGES = (
    "planning",
    "tutorial",
    "dynamic_fits",
    "vibration",
    "howto",
    "ladder",
    "command_line",
    "control",
    "fitting",
    "fmu",
    "index",
    "problem_files",
)
"""Run for the site, the long ones first; fragments (``<!-- a fragment -->``) are left out."""
BLOCK = re.compile(r"(<!-- a fragment -->\n)?^```(python|sh|toml)\n(.*?)^```\n", re.S | re.M)
READY = f"""
import matplotlib

matplotlib.use("agg")
{SHORT}
"""
BASH = f"""%%bash
set -e
pam-ocp() {{ "{sys.executable}" -m pam_ocp "$@"; }}
"""
PICTURES = {".png", ".gif"}


def blocks(page: str) -> list[tuple[int, str, str]]:
    """(end, kind, code for a kernel) of each block of a page that runs."""
    found = []
    for match in BLOCK.finditer(page):
        fragment, kind, code = match.groups()
        file = re.match(r"# (\S+\.toml)\n", code)
        if fragment or (kind == "toml" and not file):
            continue
        if file:
            code = f"%%writefile {file[1]}\n{code}"
        found.append((match.end(), kind, BASH + code if kind == "sh" else code))
    return found


def blocks_of(name: str) -> list[tuple[str, str]]:
    """(kind, code for a kernel) of each block of a page that runs."""
    return [(kind, code) for _, kind, code in blocks((HERE / f"{name}.md").read_text("utf-8"))]


def source_of(codes: list[tuple[str, str]]) -> str:
    """A hash of what is run, whoever runs it."""
    plain = [(kind, code.removeprefix(BASH)) for kind, code in codes]
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()


def run_page(name: str, folder: Path, anew: bool = False) -> Path:
    """``folder/NAME.json``: what each block printed, and its pictures; kept while blocks stay, but
    for ``anew``.
    """
    from nbclient import NotebookClient
    from nbformat import v4

    codes = blocks_of(name)
    source = source_of(codes)
    target = folder / f"{name}.json"
    if not anew and target.is_file() and json.loads(target.read_text("utf-8"))["source"] == source:
        return target
    made = v4.new_notebook(
        cells=[v4.new_code_cell(code) for code in (READY, *(c for _, c in codes))]
    )
    shown = []
    with tempfile.TemporaryDirectory() as place:
        shutil.copy(HERE / "rig.xlsx", place)
        client = NotebookClient(made, timeout=1800, resources={"metadata": {"path": place}})
        with client.setup_kernel():
            client.execute_cell(made.cells[0], 0)
            for number, (kind, _) in enumerate(codes, start=1):
                before = drawn(Path(place))
                cell = client.execute_cell(made.cells[number], number)
                text = "" if kind == "toml" else printed(cell).replace(f"{place}/", "")
                fresh = [
                    path for path, time in drawn(Path(place)).items() if before.get(path) != time
                ]
                copies = [f"{name}-{number}-{path.name}" for path in fresh]
                for path, copy in zip(fresh, copies, strict=True):
                    data = path.read_bytes()
                    (folder / copy).write_bytes(small(data) if path.suffix == ".png" else data)
                shown.append({"text": text, "pictures": copies})
    target.write_text(json.dumps({"source": source, "shown": shown}, indent=1), "utf-8")
    return target


def drawn(place: Path) -> dict[Path, int]:
    """{picture: when it was written}, in this order."""
    found = {p: p.stat().st_mtime_ns for p in place.rglob("*") if p.suffix in PICTURES}
    return dict(sorted(found.items(), key=lambda one: one[1]))


def printed(cell: Any) -> str:
    """What a cell wrote, as a terminal shows it."""
    return "".join(output.text for output in cell.outputs if output.output_type == "stream").strip()


def with_shown(page: str, shown: list[dict[str, Any]]) -> str:
    """A page with text and pictures under its blocks."""
    parts, end = [], 0
    for (at, _, _), block in zip(blocks(page), shown, strict=True):
        parts.append(page[end:at])
        end = at
        if block["text"]:
            parts.append(f"\n`````{{code-block}} text\n:class: output\n\n{block['text']}\n`````\n")
        for picture in block["pictures"]:
            file = picture.split("-", 2)[2]
            parts.append(f"\n![{file}, drawn by the block above](outputs/{picture})\n")
    return "".join([*parts, page[end:]])


def make_pages(folder: Path, anew: bool = False) -> None:
    """Run pages, two at a time."""
    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(partial(run_page, folder=folder, anew=anew), PAGES))


if __name__ == "__main__":
    where, *chosen = [a for a in sys.argv[1:] if a != "--anew"] or [HERE / "gallery"]
    again = "--anew" in sys.argv
    if not chosen:
        make_pages(HERE / "outputs", again)
    for path in make(Path(where), chosen, again):
        print(path)
