"""The archive for a repository of data: what RO-Crate 1.1 asks for, digests, equal bytes."""

import hashlib
import json
import re
import zipfile
from datetime import date
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.figures import save_crate


@pytest.fixture(scope="module")
def things(static_fit, load_motion):
    return {"The fit": static_fit, "Motion, 10 kg": load_motion}


@pytest.fixture(scope="module")
def crate(things, tmp_path_factory):
    folder = tmp_path_factory.mktemp("crate")
    (folder / "my data.csv").write_text("p,k,F\n1,2,3\n", "utf-8")
    (folder / "run.py").write_text("print('ö')\n", "utf-8")
    said = {"licence": "CC-BY-4.0", "title": "A rig", "author": "M. Müller", "text": "Why & how"}
    made = {"sources": [folder / "my data.csv"], "script": folder / "run.py"}
    return save_crate(folder / "c.zip", things, **said, **made, published="2026-11-30"), said, made


def read(path):
    """({name: bytes}, {@id: entity}, context)."""
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        files = {n: archive.read(n) for n in archive.namelist()}
    words = json.loads(files["ro-crate-metadata.json"])
    assert set(words) == {"@context", "@graph"}
    ids = [e["@id"] for e in words["@graph"]]
    assert len(set(ids)) == len(ids)
    return files, {e["@id"]: e for e in words["@graph"]}, words["@context"]


def test_the_root_is_found_and_has_what_the_specification_asks_for(crate):
    _, entities, context = read(crate[0])
    assert context[0] == "https://w3id.org/ro/crate/1.1/context"
    head = entities["ro-crate-metadata.json"]
    assert head["@type"] == "CreativeWork"
    assert head["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    root = entities[head["about"]["@id"]]
    assert root["@id"] == "./"
    assert root["@type"] == "Dataset"
    assert (root["name"], root["description"]) == ("A rig", "Why & how")
    assert date.fromisoformat(root["datePublished"]) == date(2026, 11, 30)
    licence = entities[root["license"]["@id"]]
    assert licence["@id"] == "https://spdx.org/licenses/CC-BY-4.0"
    assert licence["name"] and licence["description"]  # noqa: PT018
    assert entities[root["author"]["@id"]]["name"] == "M. Müller"


def references(value):
    """Every {"@id": ...} within a value; entities are flat, so a reference holds nothing else."""
    if isinstance(value, dict):
        assert set(value) == {"@id"}
        return [value["@id"]]
    return [r for v in value for r in references(v)] if isinstance(value, list) else []


def test_every_file_is_listed_with_its_digest_and_every_reference_leads_somewhere(crate):
    files, entities, _ = read(crate[0])
    parts = {unquote(p["@id"]) for p in entities["./"]["hasPart"]}
    assert parts == set(files) - {"ro-crate-metadata.json"}
    expected = {"report.html", "data/my data.csv", "script/run.py", "results/01_the_fit.json"}
    expected |= {f"results/02_motion_10_kg.{e}" for e in ("npz", "csv")}
    assert expected < parts
    for name in parts:
        entity = entities[name.replace(" ", "%20")]
        assert "File" in entity["@type"]
        assert entity["sha256"] == hashlib.sha256(files[name]).hexdigest()
        assert int(entity["contentSize"]) == len(files[name])
        assert re.fullmatch(r"[a-z]+/[\w.+-]+", entity["encodingFormat"])
    outside = {"https://w3id.org/ro/crate/1.1"}
    for entity in entities.values():
        for key, value in entity.items():
            if key != "@id":
                assert set(references(value)) <= set(entities) | outside, key


def test_the_run_names_script_data_software_and_versions(crate):
    _, entities, _ = read(crate[0])
    run = entities[entities["./"]["mentions"]["@id"]]
    assert {unquote(o["@id"]) for o in run["object"]} == {"data/my data.csv", "script/run.py"}
    software = entities[run["instrument"]["@id"]]
    assert (software["name"], software["version"]) == ("pam_ocp", pam.__version__)
    needs = [entities[r["@id"]] for r in software["softwareRequirements"]]
    assert {"name": "numpy", "version": np.__version__}.items() <= needs[2].items()


def test_results_read_back(crate, things, tmp_path):
    with zipfile.ZipFile(crate[0]) as archive:
        archive.extractall(tmp_path)
    motion = pam.Trajectory.load(tmp_path / "results" / "02_motion_10_kg.npz")
    assert np.array_equal(motion["x"], things["Motion, 10 kg"]["x"])
    rows = (tmp_path / "results" / "01_the_fit.csv").read_text("utf-8").splitlines()
    assert float(rows[1].split(",")[1]) == things["The fit"].law.values["a1"]  # all digits


def test_the_same_content_of_one_day_gives_the_same_bytes(crate, things, tmp_path):
    path, said, made = crate
    other = save_crate(tmp_path / "other.zip", things, **said, **made, published="2026-11-30")
    assert other.read_bytes() == path.read_bytes()


def test_what_is_missing_or_twice_is_told(things, tmp_path):
    with pytest.raises(pam.InputError, match=r"licence = 'all rights'.*CC-BY-4.0"):
        save_crate(tmp_path / "c.zip", things, licence="all rights")
    with pytest.raises(pam.InputError, match="published"):
        save_crate(tmp_path / "c.zip", things, licence="MIT", published="tomorrow")
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "same.csv").write_text("1\n", "utf-8")
    twice = [tmp_path / f / "same.csv" for f in ("a", "b")]
    with pytest.raises(pam.InputError, match="two files of one name"):
        save_crate(tmp_path / "c.zip", things, licence="MIT", sources=twice)
    assert not (tmp_path / "c.zip").exists()


@pytest.mark.slow
def test_the_command_report_writes_a_crate_of_its_files(things, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    things["Motion, 10 kg"].save("motion.npz")
    assert main(["report", "motion.npz", "--crate", "c.zip", "--licence", "CC0-1.0"]) == 0
    files, _, _ = read("c.zip")
    assert files["data/motion.npz"] == (tmp_path / "motion.npz").read_bytes()
    refused = ["report", "motion.npz", "--out", "no.html", "--crate", "c.zip"]
    assert main(refused) == 2  # under which terms?
    assert not Path("no.html").exists()
