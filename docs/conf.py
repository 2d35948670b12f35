"""Sphinx: the pages of this folder, the gallery of examples, and the public names, room by room.

pip install -e '.[docs]' && sphinx-build -W -b html docs docs/_build/html
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import gallery  # noqa: E402
import rooms as imports  # noqa: E402
from sphinx.ext.autosummary import autosummary_toc  # noqa: E402

import pam_ocp  # noqa: E402
from pam_ocp.cli import components  # noqa: E402

project = "pam_ocp"
author = "The pam_ocp developers"
copyright = f"2026, {author}"
version = release = pam_ocp.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "_templates"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = f"pam_ocp {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_favicon = "_static/favicon.svg"
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True
copybutton_selector = "div:not(.output) > div.highlight > pre"
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # the gallery's notebooks come with what they printed
nb_merge_streams = True
autosummary_generate = True
autodoc_typehints = "none"  # the stubs have them
autodoc_default_options = {"members": True, "member-order": "bysource"}
nitpicky = True


# -- the gallery ----------------------------------------------------------------------------------

gallery.make(HERE / "gallery")
gallery.index(HERE / "gallery")
gallery.make_pages(HERE / "outputs")


# -- the list of components, from the registries --------------------------------------------------


def write_components() -> None:
    """components.md, which `pam-ocp components --markdown` prints too."""
    target, text = HERE / "components.md", components.page()
    if not target.is_file() or target.read_text("utf-8") != text:
        target.write_text(text, "utf-8")


write_components()


# -- the reference: a page for each room, a page for each name ------------------------------------


def rooms() -> dict[str, tuple[Any, list[str]]]:
    """{title: (room, its own names)}; what stands at the top, too, is shown in its room."""
    found: dict[str, tuple[Any, list[str]]] = {}
    seen: set[int] = set()

    def visit(title: str, room: Any) -> None:
        inner = {n: getattr(room, n) for n in room.__all__}
        for name, thing in inner.items():
            if inspect.ismodule(thing) and id(thing) not in seen:
                seen.add(id(thing))
                visit(f"{title}.{name}", thing)
        own = [n for n, o in inner.items() if not inspect.ismodule(o) and id(o) not in seen]
        seen.update(id(inner[n]) for n in own)
        found[title] = (room, own)

    visit("pam", pam_ocp)
    return dict(sorted(found.items()))


def write_reference() -> None:
    """api/ROOM.rst: the names of each room, with the first sentence of each."""
    folder = HERE / "api"
    folder.mkdir(exist_ok=True)
    for title, (room, names) in rooms().items():
        short = title.removeprefix("pam.") if title != "pam" else "top"
        purpose = inspect.cleandoc(room.__doc__ or "").split("\n\n")[0].replace("\n", " ")
        lines = [title, "=" * len(title), "", escaped(purpose), ""]
        lines += [f".. currentmodule:: {room.__name__}", ""]
        lines += [".. autosummary::", "   :toctree: generated", "", *(f"   {n}" for n in names), ""]
        target, text = folder / f"{short}.rst", "\n".join(lines)
        if not target.is_file() or target.read_text("utf-8") != text:
            target.write_text(text, "utf-8")


# -- docstrings: plain text with formulas, made into reStructuredText ----------------------------

CODE = re.compile(r":[a-z]+:`~?([^`]+)`|``([^`]+)``")
ENTRY = re.compile(r"\*{0,2}[\w.]+(?:, \*{0,2}[\w.]+)* : ")
HEADING = re.compile(r"(\w+)\n-+\n")


def escaped(text: str) -> str:
    """Text in which code is code, and all else stands as it is written."""
    parts, end = [], 0
    for match in CODE.finditer(text):
        parts += [re.sub(r"([\\*|`_])", r"\\\1", text[end : match.start()])]
        parts += [f"``{(match[1] or match[2]).strip()}``", r"\ "]
        end = match.end()
    return "".join([*parts, re.sub(r"([\\*|`_])", r"\\\1", text[end:])])


def block(text: str) -> list[str]:
    """A paragraph, a list of arguments, a formula or an example."""
    if text.startswith(">>> "):
        return [*text.splitlines(), ""]
    if text.startswith(" ") or re.match(r"[-*|] ", text):
        return ["::", "", *(f"   {line}" for line in inspect.cleandoc(text).splitlines()), ""]
    if not ENTRY.match(text):
        return [escaped(" ".join(text.split())).removesuffix("::").rstrip(), ""]
    entries: list[str] = []
    for line in text.splitlines():
        if ENTRY.match(line) or not entries:
            entries.append(line)
        else:
            entries[-1] += f" {line.strip()}"
    found = []
    for entry in entries:
        name, colon, meaning = entry.partition(" : ")
        found.append(f"* ``{name}``: {escaped(meaning)}" if colon else f"* {escaped(entry)}")
    return [*found, ""]


def plain(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """What autodoc finds, readable."""
    text = "\n".join(lines).strip()
    if what == "data" or text.startswith(f"{name.rpartition('.')[2]}("):
        lines[:] = []  # the description of a value's class, or what dataclass makes of a signature
        return
    made: list[str] = []
    for part in re.split(r"\n[ \t]*\n", text):
        if match := HEADING.match(part):
            made += [f".. rubric:: {match[1]}", ""]
            part = part[match.end() :]
            if match[1] == "Examples":
                made += ["*Names not made here are those of the* :doc:`/reference`.", ""]
        made += block(part) if part.strip() else []
    lines[:] = made


def to_the_gallery(app: Any, name: str, text: list[str]) -> None:
    """On the site the folder of examples, as a repository browser shows it, is the gallery."""
    text[0] = text[0].replace("](../examples/README.md)", "](gallery/index.md)")


def with_outputs(app: Any, name: str, text: list[str]) -> None:
    """What the blocks of a page printed and drew stands under them."""
    if name in gallery.PAGES:
        source = HERE / "outputs" / f"{name}.json"
        app.env.note_dependency(source)  # read again when it is run again
        found = json.loads(source.read_text("utf-8"))
        text[0] = gallery.with_shown(text[0], found["shown"])


def shown(writer: Any, node: Any) -> None:
    """Of a node of which its content alone is written."""


def with_drawing(app: Any, name: str, text: list[str]) -> None:
    """The picture of the rooms, which a forge draws by Mermaid."""
    if name == "architecture":
        graph = imports.rooms(imports.behind_the_door(imports.arrows(HERE.parent / "pam_ocp")))
        text[0] = imports.page(text[0], imports.drawing(graph))


def out_of_the_sidebar(app: Any, page: Any) -> None:
    """Single names are found on the page of their room and by the search: their 400 entries beside
    each of 470 pages took three quarters of the time of a build.
    """
    for entries in list(page.findall(autosummary_toc)):
        entries.parent.remove(entries)


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", plain)
    app.connect("source-read", with_drawing)
    app.connect("source-read", to_the_gallery)
    app.connect("source-read", with_outputs)
    if tags.has("print"):  # noqa: F821, from Sphinx: in print single names stand behind their room
        app.add_node(autosummary_toc, override=True, html=(shown, shown))
    else:
        app.connect("doctree-read", out_of_the_sidebar, priority=400)  # before they are collected


write_reference()
