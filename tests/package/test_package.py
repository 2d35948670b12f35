"""What is installed: every room, the FMU's C sources, the data; and no top-level ``fmu``."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

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


@pytest.mark.slow
def test_a_wheel_holds_all_and_no_module_named_fmu(tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--no-deps",
            "--quiet",
            "-w",
            str(tmp_path),
            str(ROOT),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    tops = {n.partition("/")[0] for n in names if not n.partition("/")[0].endswith(".dist-info")}
    assert tops == {"pam_ocp"}
    for needed in (
        "pam_ocp/py.typed",
        "pam_ocp/data/DMSP-20-300_static.csv",
        "pam_ocp/muscles/catalogue.toml",
        "pam_ocp/export/package.py",
        "pam_ocp/export/c/src/instance.c",
        "pam_ocp/export/c/include/fmi3Functions.h",
        "pam_ocp/export/c/LICENSE.fmi-headers",
    ):
        assert needed in names


def test_import_is_light():
    """No plotting, no table library, no FMI library is loaded before it is used."""
    code = (
        "import sys, pam_ocp; heavy = {'matplotlib', 'pandas', 'control', 'scipy', 'fmpy'} & "
        "set(sys.modules);"
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
    tools = {"setuptools", "mypy", "ruff", "sphinx", "myst-parser"}
    assert set(least) - tools == set(pins)
    for name, pin in pins.items():
        bound = [int(part) for part in least[name].split(".")]
        assert [int(part) for part in pin.split(".")][: len(bound)] == bound, name
