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
    listed = set(
        tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"][
            "packages"
        ]
    )
    folders = (p.parent for p in (ROOT / "pam_ocp").rglob("__init__.py"))
    rooms = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert {"pam_ocp.export.c", *rooms} == listed


def test_an_empty_environment_can_import_the_clone(tmp_path):
    """Not even CasADi is there; nothing is installed. What a wheel holds: tests/wheel/run.py."""
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); import pam_ocp; print("
    code += "pam_ocp.__version__, len(dir(pam_ocp)) > 100)"
    done = subprocess.run(
        [
            sys.executable,
            "-I",
            "-S",
            "-c",
            f"import sys; sys.path.insert(0, {str(ROOT)!r}); {code}",
        ],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.stdout.split() == [pam_ocp.__version__, "True"], done.stderr


def test_citation_and_changelog_know_the_version():
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.search(r"(?m)^version: (.*)$", citation)[1] == pam_ocp.__version__
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert re.findall(r"(?m)^## \[(\d.*?)\]", changes)[0] == pam_ocp.__version__


def test_import_is_light():
    """No plotting, no table library, no FMI library is loaded before it is used."""
    code = (
        "import sys, pam_ocp; heavy = {'matplotlib', 'pandas', 'control', 'scipy', 'fmpy'} & "
        "set(sys.modules);print(sorted(heavy)); sys.exit(bool(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_plan_loads_no_library_that_it_does_not_use():
    """SciPy alone takes as long as a plan; plotting, tables and python-control have no part."""
    code = (
        "import sys, pam_ocp as pam; plant = pam.HangingLoad('DMSP-20-400N', 10.0);"
        "plan = pam.plan(plant, [{'x': 0.05}, {'x': 0.08}]); assert plan.verified; heavy = "
        "{'matplotlib', 'pandas', 'control', 'scipy', 'fmpy'} & set(sys.modules);"
        "print(sorted(heavy)); sys.exit(bool(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


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
