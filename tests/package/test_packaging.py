"""What the package says of itself in several places is the same in all of them."""

import re
import runpy
import sys
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

import pam_ocp

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
RECIPE = yaml.safe_load((ROOT / "recipe/recipe.yaml").read_text("utf-8"))
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
PYTHONS = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
CONDA = {"matplotlib": "matplotlib-base"}
"""Other names of the same things there; the base goes without a toolkit for windows."""


def needed(*extras: str) -> list[Requirement]:
    lines = [*PROJECT["dependencies"]]
    for extra in extras:
        lines += PROJECT["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def test_pythons_that_are_named_begin_with_the_oldest_that_is_tested():
    tested = runpy.run_path(str(ROOT / "tests" / "versions" / "run.py"))  # "run" is others' name
    oldest = ".".join(map(str, tested["OLDEST_PYTHON"]))
    assert PYTHONS[0] == oldest
    assert PROJECT["requires-python"] == f">={oldest}"
    minors = [int(p.partition(".")[2]) for p in PYTHONS]
    assert minors == list(range(minors[0], minors[-1] + 1))


def test_citation_and_changelog_agree_with_the_project():
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert re.findall(r"(?m)^## \[(\d.*?)\]", changes)[0] == pam_ocp.__version__
    assert CITATION["version"] == pam_ocp.__version__
    assert CITATION["license"] == PROJECT["license"]
    assert [a["name"] for a in CITATION["authors"]] == [a["name"] for a in PROJECT["authors"]]


def test_the_conda_recipe_needs_what_the_project_needs():
    said = dict(line.split(" ", 1) for line in RECIPE["requirements"]["run"])
    wanted = {CONDA.get(r.name, r.name): str(r.specifier) for r in needed()}
    assert said == {"python": PROJECT["requires-python"], **wanted}
    assert RECIPE["context"]["version"] == pam_ocp.__version__
    assert RECIPE["about"]["license"] == PROJECT["license"]
    assert RECIPE["about"]["license_file"] == PROJECT["license-files"]
    assert RECIPE["about"]["summary"] == PROJECT["description"]


def test_the_conda_recipe_has_the_commands_of_the_project():
    entries = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert RECIPE["build"]["python"]["entry_points"] == entries


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("system", ["linux", "win32", "darwin"])
def test_the_lock_has_one_version_of_each_dependency_that_the_project_allows(python, system):
    place = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "sys_platform": system,
        "extra": "",
    }
    lines = (ROOT / "requirements" / "locked.txt").read_text("utf-8").splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    pins = [pin for pin in pins if pin.marker is None or pin.marker.evaluate(place)]
    versions = {pin.name: str(pin.specifier).removeprefix("==") for pin in pins}
    assert len(versions) == len(pins)
    for one in needed("cross", "excel"):
        if one.marker is None or one.marker.evaluate(place):
            assert one.specifier.contains(versions[one.name]), one


def test_the_lock_names_no_address():
    assert "://" not in (ROOT / "requirements" / "locked.txt").read_text("utf-8")
