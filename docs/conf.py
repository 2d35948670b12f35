"""Sphinx: the pages of this folder and the public names, room by room.

pip install -e '.[docs]' && sphinx-build -W -b html docs docs/_build
"""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import pam_ocp  # noqa: E402

project = "pam_ocp"
author = "The pam_ocp developers"
copyright = f"2026, {author}"
version = release = pam_ocp.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"pam_ocp {release}"
myst_heading_anchors = 3
# Mermaid is drawn where the page is read on its forge; links to files above docs/ lead there, too
suppress_warnings = ["myst.xref_missing", "misc.highlighting_failure"]
autosummary_generate = True
autodoc_typehints = "none"  # the signatures have them
autodoc_default_options = {"members": True, "member-order": "bysource"}


def write_reference() -> None:
    """api.rst: the table of public names, by the room in which each is at home."""
    rooms = {
        n: getattr(pam_ocp, n) for n in pam_ocp.__all__ if inspect.ismodule(getattr(pam_ocp, n))
    }
    face = [n for n in pam_ocp.__all__ if n not in rooms]
    lines = ["Public names by room", "=" * 20, ""]
    entries = [("pam_ocp", pam_ocp, face)]
    for short, room in rooms.items():
        own = [n for n in room.__all__ if not inspect.ismodule(getattr(room, n))]
        entries.append((f"pam_ocp.{short}", room, [n for n in own if n not in face]))
    for title, module, names in entries:
        lines += [title, "-" * len(title), "", f".. currentmodule:: {module.__name__}", ""]
        lines += [".. autosummary::", "   :toctree: generated", "", *(f"   {n}" for n in names), ""]
    target, text = HERE / "api.rst", "\n".join(lines)
    if not target.is_file() or target.read_text("utf-8") != text:
        target.write_text(text, "utf-8")


write_reference()


ROLE = re.compile(r":[a-z]+:`~?([^`]+)`|``([^`]+)``")


def plain(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text, with formulas: a first paragraph, the rest as it is written."""
    if what == "data":  # what autodoc finds is the description of a value's class
        lines[:] = []
        return
    text = ROLE.sub(lambda found: found[1] or found[2], "\n".join(lines)).strip()
    first, _, rest = text.partition("\n\n")
    lines[:] = [re.sub(r"([\\*|`_])", r"\\\1", " ".join(first.split())).rstrip(":")]
    if rest.strip():
        lines += ["", "::", "", *(f"   {line}" for line in rest.splitlines())]
    lines.append("")


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", plain)
