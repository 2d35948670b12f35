"""What is installed: every room, the FMU's C sources, the data; and no top-level ``fmu``."""

import re
import subprocess
import sys
from pathlib import Path

import pam_ocp

ROOT = Path(__file__).parents[2]

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def test_every_folder_with_code_is_a_package_that_gets_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    listed = set(project["tool"]["setuptools"]["packages"])
    folders = (p.parent for p in (ROOT / "pam_ocp").rglob("__init__.py"))
    rooms = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert {"pam_ocp.export.c", *rooms} == listed


def test_an_empty_environment_can_import_the_clone(tmp_path):
    """Not even CasADi is there; nothing is installed. What a wheel holds: tests/wheel/run.py."""
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); import pam_ocp; print("
    code += "pam_ocp.__version__, len(dir(pam_ocp)) > 100)"
    command = [sys.executable, "-I", "-S", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.stdout.split() == [pam_ocp.__version__, "True"], done.stderr


def test_the_oldest_set_of_dependencies_is_what_pyproject_allows_at_least():
    """What CI pins for Python 3.10 are the lower bounds themselves, and none is left out."""
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    least = dict(re.findall(r'"([A-Za-z][\w-]*)>=([\d.]+)', text))
    pins = dict(
        re.findall(
            r"(?m)^([\w-]+)==([\d.]+)$", (ROOT / "tests/versions/oldest.txt").read_text("utf-8")
        )
    )
    tools = {"setuptools", "import-linter", "pytest-cov", "mypy", "ruff"}
    tools |= {"sphinx", "sphinx-copybutton", "sphinx-design", "myst-nb"}  # of the site
    tools |= {"ipykernel", "nbclient", "nbformat"}
    tools |= {"jax", "diffrax", "torch", "onnx", "onnxruntime", "mujoco", "gymnasium"}  # worlds
    tools |= {"cmaes", "optax"}
    assert set(least) - tools == set(pins)
    for name, pin in pins.items():
        bound = [int(part) for part in least[name].split(".")]
        assert [int(part) for part in pin.split(".")][: len(bound)] == bound, name
