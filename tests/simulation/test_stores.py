"""Results in folders elsewhere: fsspec's memory, a local object store, pyarrow."""

import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import refused
from test_kept import SAID, masses, spring

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.core.stores import folder_of

fsspec = pytest.importorskip("fsspec")
pytest.importorskip("pyarrow")
SHORT = {"t": np.linspace(0.0, 0.02, 3), "executor": 0}


@pytest.fixture
def memory():
    fs = fsspec.filesystem("memory")
    fs.store.clear()  # it lasts as long as the process
    yield fs
    fs.store.clear()


def contents(place) -> list[bytes]:
    return [p.read_bytes() for p in sorted((place / "cases").rglob("part-*.parquet"), key=str)]


def check_kept(into, tmp_path) -> None:
    """Rows in a folder elsewhere: the same bits as here, resumed where a part is gone."""
    said = {"chunk": 50, "executor": 0, **SAID}
    pam.simulate_many(spring(), masses(120), into=tmp_path / "here", **said)
    there = pam.simulate_many(spring(), masses(120), into=into, **said)
    place, here = there.folder, folder_of("here", tmp_path / "here")
    assert contents(place) == contents(here)
    assert [p.name for p in place.iterdir()].count("study.json") == 1
    first, second, _ = sorted((place / "cases").rglob("part-*.parquet"), key=str)
    first.unlink()
    second.write_bytes(second.read_bytes()[:-20])
    seen = []
    pam.simulate_many(
        spring(), masses(120), into=into, progress=lambda done, _: seen.append(done), **said
    )
    assert contents(place) == contents(here)
    read = pam.simulation.KeptNumbers.read(into)
    assert np.array_equal(
        read["x_end"], pam.simulation.KeptNumbers.read(tmp_path / "here")["x_end"]
    )
    with pytest.raises(InputError, match="other arguments"):
        pam.simulate_many(spring(), masses(2), into=into, **{**said, "rtol": 1e-7})


def test_motions_in_memory_of_fsspec_are_those_of_a_folder(memory, tmp_path):
    cases = [*masses(5), {"parameters": {"mass": -1.0}}]
    here = pam.simulate_many(spring(), cases, into=tmp_path / "runs", chunk=2, **SHORT)
    there = pam.simulate_many(spring(), cases, into="memory://bucket/runs", chunk=2, **SHORT)
    assert [p.read_bytes() for p in there.parts] == [p.read_bytes() for p in here.parts]
    assert list(there.failures) == [5]
    for (i, a), (j, b) in zip(here, there, strict=True):
        assert i == j
        assert isinstance(a, Exception) or np.array_equal(a["x"], b["x"])
    assert len(there.frame(["x"])) == 15
    before = dict(memory.store)
    pam.simulate_many(spring(), cases, into="memory://bucket/runs", **SHORT)
    kept = {n: f for n, f in memory.store.items() if n.endswith(".parquet")}
    assert all(before[n] is f for n, f in kept.items())  # nothing was written again


def test_numbers_in_memory_of_fsspec(memory, tmp_path):
    check_kept("memory://bucket/numbers", tmp_path)


SLOW_PAIR = pytest.param("pair", marks=pytest.mark.slow)


@pytest.mark.parametrize("kind", ["dir", SLOW_PAIR, "arrow"])
def test_file_systems_are_taken_as_folders(kind, tmp_path):
    inner = tmp_path / "elsewhere"
    inner.mkdir()
    if kind == "arrow":
        from pyarrow import fs

        check_kept(fs.SubTreeFileSystem(str(inner), fs.LocalFileSystem()), tmp_path)
    elif kind == "dir":
        from fsspec.implementations.dirfs import DirFileSystem

        check_kept(DirFileSystem(str(inner), fsspec.filesystem("file")), tmp_path)
    else:
        check_kept((fsspec.filesystem("file"), str(inner / "runs")), tmp_path)
    assert not [p for p in inner.rglob("*") if "pam-part" in p.name]


@pytest.mark.parametrize(
    ("into", "match"),
    [
        ("nowhere://bucket/runs", "into = nowhere://bucket/runs"),
        (3, "into is an int"),
        ((3, "runs"), "into is an int"),
        ((fsspec.filesystem("memory"), 3), "the path is an int"),
    ],
)
def test_what_is_no_folder_is_said(into, match):
    refused(match, pam.simulate_many, spring(), masses(2), into=into, **SHORT)


def test_a_folder_elsewhere_with_other_files_is_left_alone(memory):
    memory.pipe_file("/bucket/thesis.txt", b"mine")
    with pytest.raises(InputError, match="holds other files"):
        pam.simulate_many(spring(), masses(2), into="memory://bucket", **SHORT)
    assert list(memory.store) == ["/bucket/thesis.txt"]


@pytest.fixture
def object_store(monkeypatch):
    """An S3 server on this machine."""
    pytest.importorskip("moto")
    s3fs = pytest.importorskip("s3fs")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    monkeypatch.setenv("AWS_ENDPOINT_URL", url)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    end = time.monotonic() + 60
    while time.monotonic() < end:
        try:
            socket.create_connection(("127.0.0.1", port), 0.2).close()
            break
        except OSError:
            time.sleep(0.1)
    try:
        s3fs.S3FileSystem(skip_instance_cache=True).mkdir("runs")
        yield "s3://runs"
    finally:
        server.kill()
        server.wait()


@pytest.mark.slow
def test_an_object_store_holds_numbers_as_a_folder_does(object_store, tmp_path):
    check_kept(f"{object_store}/mine", tmp_path)
    with pytest.raises(InputError, match="s3://absent/runs"):
        pam.simulate_many(spring(), masses(2), into="s3://absent/runs", **SHORT)
