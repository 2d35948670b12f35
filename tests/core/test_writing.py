"""What is written is there as a whole or not at all, whatever the system refuses."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import benchmark_slide, refused

import pam_ocp as pam
from pam_ocp.core.errors import WriteError
from pam_ocp.core.files import atomic_path, make_folder, write_json
from pam_ocp.export import export_motion, export_ssp, save_input_table
from pam_ocp.figures.canvas import save_figure
from pam_ocp.fitting.static.static import fit_force
from pam_ocp.studies.loads import LoadStudy

posix = pytest.mark.skipif(sys.platform == "win32", reason="POSIX")


def fit_of(plant: pam.Plant) -> pam.fitting.PlantFit:
    commands = {v.name: 2e5 for v in plant.inputs} | {plant.inputs[0].name: 2.5e5}
    record = pam.simulate(plant, commands, t=np.linspace(0.0, 0.2, 41))
    return pam.fit_plant(plant, record, ["mass"], outputs=["x"])


@pytest.fixture(scope="module")
def writers() -> dict[str, Callable[[Path], Any]]:
    """{ending: writer} of what people save."""
    slide = benchmark_slide()
    motion = pam.simulate(slide, t=np.linspace(0.0, 0.05, 201))
    fitted = fit_force(pam.read_table("DMSP-20-300_static.csv", rest_length=0.3))
    hold = {"muscle1.command": 2e5, "muscle2.command": 2e5}
    loop = pam.closed_loop(lambda t, y: hold, slide, duration=0.05, sample_time=5e-3)
    plan = pam.plan(slide, [{"x": -0.01}, {"x": 0.01}])
    return {
        "motion.csv": motion.save,
        "motion.npz": motion.save,
        "motion.parquet": motion.save,
        "plan.npz": plan.save,
        "loop.npz": loop.save,
        "fit.json": fitted.to_json,
        "muscle.toml": lambda f: pam.save_muscle(pam.muscle("DMSP-20-200N"), f),
        "muscle.json": lambda f: pam.save_muscle(pam.muscle("DMSP-20-200N"), f),
        "inputs_in.csv": lambda f: save_input_table(motion, f),
        "motion.fmu": lambda f: export_motion(motion, f, platforms=["native"]),
        "motion.png": lambda f: save_figure(motion.plot(), f),
        "motion.pdf": lambda f: save_figure(motion.plot(), f),
        "loads.csv": lambda f: LoadStudy("muscle", 1e5, ()).save(f),
        "plant_fit.json": fit_of(slide).save,
        "played.ssp": lambda f: export_ssp(
            {"motion": motion, "again": motion}, {}, f, platforms=["native"]
        ),
        "film.gif": lambda f: pam.figures.animate_plan(plan, f, seconds=0.2, fps=10),
    }


NAMES = (
    "motion.csv", "motion.npz", "motion.parquet", "plan.npz", "loop.npz", "fit.json",
    "muscle.toml", "muscle.json", "inputs_in.csv", "motion.fmu", "motion.png", "motion.pdf",
    "loads.csv", "film.gif", "plant_fit.json", "played.ssp",
)  # fmt: skip


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The system refuses to let any file grow further, also for libraries written in C."""
    import resource

    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


@posix
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.slow
def test_a_writer_that_runs_out_of_space_leaves_all_as_it_was(name, writers, tmp_path):
    target = tmp_path / name
    writers[name](target)
    size = target.stat().st_size
    target.write_bytes(b"old")
    compiled = name.endswith((".fmu", ".ssp"))  # a compiler writes, too
    sizes = {size - 1} if compiled else {0, size // 2, size - 1}
    for most in sorted(sizes):
        with (
            pytest.raises(WriteError, match=rf"{name} was not written") as caught,
            files_of_at_most(most),
        ):
            writers[name](target)
        assert "\n" not in str(caught.value)
        assert isinstance(caught.value, OSError)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("call", ["os.fsync", "pathlib.Path.replace"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EROFS])
@pytest.mark.parametrize("name", ["motion.csv", "motion.npz", "fit.json", "muscle.toml"])
def test_what_the_last_steps_refuse_is_one_sentence(
    call, number, name, writers, tmp_path, monkeypatch
):
    def refuse(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    target = tmp_path / name
    target.write_bytes(b"old")
    with monkeypatch.context() as patch:
        patch.setattr(call, refuse)
        with pytest.raises(WriteError, match=os.strerror(number)) as caught:
            writers[name](target)
    assert caught.value.errno == number
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == [name]


@posix
@pytest.mark.parametrize("name", NAMES)
def test_odd_targets_are_refused(name, writers, tmp_path):
    ending = Path(name).suffix
    (tmp_path / f"folder{ending}").mkdir()
    (tmp_path / f"null{ending}").symlink_to("/dev/null")
    (tmp_path / f"full{ending}").symlink_to("/dev/full")
    (tmp_path / f"loop{ending}").symlink_to(tmp_path / f"loop{ending}")
    os.mkfifo(tmp_path / f"pipe{ending}")
    (tmp_path / "file").touch()
    for target, words in (
        (f"folder{ending}", "is a folder"),
        (f"null{ending}", "is a device"),
        (f"full{ending}", "is a device"),
        (f"pipe{ending}", "is a device or a pipe"),
        (f"loop{ending}", "leads to itself"),
        (f"none/x{ending}", "does not exist"),
        (f"file/x{ending}", "a file, not a folder|Not a directory"),
        ("x" * 300 + ending, "too long.*shorter name"),
        (f"a\0{ending}", "is no name for a file"),
    ):
        refused(words, writers[name], tmp_path / target, error=WriteError)
    assert not [f for f in os.listdir(tmp_path) if f.startswith(".")]
    assert Path("/dev/null").is_char_device()


@posix
def test_a_link_is_followed(tmp_path):
    (tmp_path / "there").mkdir()
    real = tmp_path / "there" / "real.json"
    for content in ("new", "replaced"):  # the first time the link leads nowhere yet
        link = tmp_path / "link.json"
        if not link.is_symlink():
            link.symlink_to("there/real.json")
        write_json(link, {"x": content})
        assert link.is_symlink()
        assert content in real.read_text()
    assert os.listdir(tmp_path / "there") == ["real.json"]


@posix
def test_a_file_keeps_its_permissions_and_a_new_one_has_the_usual_ones(tmp_path):
    file = tmp_path / "a.json"
    (tmp_path / "usual").touch()
    write_json(file, {})
    assert file.stat().st_mode == (tmp_path / "usual").stat().st_mode
    file.chmod(0o600)
    write_json(file, {"x": 1})
    assert file.stat().st_mode & 0o777 == 0o600


AS_ANOTHER = """
import os, sys
from pam_ocp.core.files import make_folder, write_json
if os.getuid() == 0:
    os.setgid(65534); os.setuid(65534)
for path in sys.argv[1:]:
    try:
        make_folder(path) if path.endswith("/") else write_json(path, {})
        print("written")
    except OSError as error:
        print(error)
"""


@posix
def test_without_permission_nothing_is_written(tmp_path):
    for folder in (tmp_path, *tmp_path.parents):
        if Path(tempfile.gettempdir()) in folder.parents:
            folder.chmod(0o755)
    closed, open_ = tmp_path / "closed", tmp_path / "open"
    for folder in (closed, open_):
        folder.mkdir()
    (open_ / "kept.json").write_text("old")
    (open_ / "kept.json").chmod(0o444)
    open_.chmod(0o777)
    closed.chmod(0o555)
    paths = [closed / "a.json", open_ / "kept.json", f"{closed}/folder/", open_ / "b.json"]
    done = subprocess.run(
        [sys.executable, "-c", AS_ANOTHER, *map(str, paths)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    said = done.stdout.splitlines()
    closed.chmod(0o755)
    assert "Permission denied" in said[0]
    assert "is write-protected" in said[1]
    assert "cannot make this folder (Permission denied)" in said[2]
    assert said[3] == "written"
    assert (open_ / "kept.json").read_text() == "old"
    assert os.listdir(closed) == []


KILLED = """
import sys
from pam_ocp.core.files import write_json
print("ready", flush=True)
while True:
    write_json(sys.argv[1], {"x": list(range(20_000))})
"""


@posix
def test_after_kill_9_the_file_is_whole_and_the_next_write_clears_what_was_left(tmp_path):
    import json
    import random

    target, chance, left = tmp_path / "a.json", random.Random(5), 0
    other = tmp_path / ".b.json.pam-part-0123456789ab.json"
    other.touch()  # of another target
    for _ in range(8):
        process = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(target)], stdout=subprocess.PIPE
        )
        process.stdout.readline()
        time.sleep(chance.uniform(0.0, 0.05))
        process.kill()
        process.communicate()
        hidden = [f for f in os.listdir(tmp_path) if f.startswith(".a")]
        assert len(hidden) <= 1
        left += len(hidden)
        if target.exists():
            assert len(json.loads(target.read_text())["x"]) == 20_000
    assert left > 0  # at least one was killed while it wrote
    write_json(target, {})
    assert sorted(os.listdir(tmp_path)) == [other.name, "a.json"]


@posix
def test_a_write_that_still_runs_keeps_its_temporary_file(tmp_path):
    with atomic_path(tmp_path / "a.json") as first:
        first.write_text("first")
        write_json(tmp_path / "a.json", {"x": "second"})
        assert first.exists()
    assert (tmp_path / "a.json").read_text() == "first"
    assert os.listdir(tmp_path) == ["a.json"]


def test_an_error_that_is_none_of_the_system_stays_itself(tmp_path):
    with pytest.raises(KeyError), atomic_path(tmp_path / "a"):
        raise KeyError("x")
    assert os.listdir(tmp_path) == []


def test_a_figure_of_an_unknown_ending_is_refused(writers, tmp_path):
    for name in ("a.xyz", "a"):
        refused(r"end its name in \.png", writers["motion.png"], tmp_path / name)


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "a").touch()
    refused("is a file; give the name of a folder", make_folder, tmp_path / "a", error=WriteError)
