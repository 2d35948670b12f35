"""The examples as they stand: titles, imports, pictures, their list, their notebooks.

They are run by docs/gallery.py, each by a kernel of its own, and in CI all of them anew (.ci/run).
"""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
ALLOWED = {"pam_ocp", "casadi", "control", "distributed", "fmpy", "matplotlib", "numpy", "scipy"}
ALLOWED |= {
    "cmaes",
    "gymnasium",
    "jax",
    "mujoco",
    "onnxruntime",
    "torch",
}  # where they are installed
each = pytest.mark.parametrize("example", EXAMPLES, ids=lambda p: p.stem)


@pytest.fixture
def gallery(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import gallery

    return gallery


@each
def test_an_example_needs_pam_ocp_and_what_comes_with_it(example):
    tree = ast.parse(example.read_text("utf-8"))
    names = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (
            [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else [a.name for a in node.names]
        )
    }
    assert names - set(sys.stdlib_module_names) <= ALLOWED


@each
def test_an_example_has_a_title_a_text_and_a_picture(example, gallery):
    source = example.read_text("utf-8")
    title, text = gallery.words(source)
    assert 8 < len(title) < 100
    assert len(text) > len(title)
    assert ".savefig(" in source


def test_every_example_is_listed_once(gallery):
    listed = [name for names in gallery.groups().values() for name in names]
    assert sorted(listed) == [path.stem for path in EXAMPLES]


@each
def test_an_example_becomes_a_notebook_that_shows_its_pictures(example, gallery):
    pytest.importorskip("nbformat", reason="needs the extra 'docs'")
    made = gallery.notebook(example)
    code = "\n".join(c.source for c in made.cells if c.cell_type == "code")
    ast.parse(code.replace("%matplotlib inline", ""))
    assert "display(" in code
    assert "savefig" not in code


def test_a_picture_that_is_saved_is_shown_in_the_notebook(gallery):
    code = 'plan.plot().savefig(\n    folder / "plan.png",\n    dpi=120,\n)\n'
    assert gallery.shown(code) == "display(plan.plot())\n"
    assert gallery.shown("ax.legend()\n") == "ax.legend();\n"
