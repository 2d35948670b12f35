"""Many simulations into a folder, and workers that are killed."""

import gc
import importlib.metadata
import json
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from conftest import BAR, refused

import pam_ocp as pam
from pam_ocp import InputError, SimulationError
from pam_ocp.core.own_code import as_written
from pam_ocp.simulation.stored import StoredSimulations

pytest.importorskip("pyarrow")
SHORT = {"t": np.linspace(0.0, 0.02, 3), "rtol": 1e-6}


def quick() -> pam.Plant:
    plant = pam.Plant("decay", "x' = u - rate x")
    x, u, rate = plant.state("x", start=1.0), plant.input("u"), plant.parameter("rate", 1.0)
    plant.der(x, u - rate * x)
    return plant


def killer(t: float) -> float:
    os.kill(os.getpid(), signal.SIGKILL)
    return t


def once(t: float) -> float:
    """Kills the first worker that comes here."""
    if not os.path.exists(os.environ["PAM_ONCE"]):
        open(os.environ["PAM_ONCE"], "w").close()
        killer(t)
    return 0.0


def exact(rate: float) -> float:
    return float(np.exp(-rate * SHORT["t"][-1]))


def rates(count: int):
    return ({"parameters": {"rate": 0.1 * (i + 1)}} for i in range(count))


@pytest.mark.parametrize("workers", [None, 2])
def test_a_folder_gives_back_the_simulations_of_a_generator(tmp_path, workers):
    stored = pam.simulate_many(
        quick(), rates(250), into=tmp_path / "runs", chunk=40, workers=workers, **SHORT
    )
    assert len(stored) == 250
    assert len(stored.parts) == 7
    numbers = []
    for number, trajectory in stored:
        numbers.append(number)
        assert trajectory["x"][-1] == pytest.approx(exact(0.1 * (number + 1)), rel=1e-5)
    assert numbers == list(range(250))
    frame = stored.frame(["x"])
    assert list(frame.columns) == ["case", "time", "x"]
    assert len(frame) == 750
    assert dict(stored.parameters)[249]["rate"] == pytest.approx(25.0)


def test_what_a_folder_holds_is_not_computed_again(tmp_path):
    into = tmp_path / "runs"
    first = pam.simulate_many(quick(), rates(60), into=into, chunk=10, **SHORT)
    before = {p: p.stat().st_mtime_ns for p in first.parts}
    first.parts[2].unlink()
    first.parts[4].write_bytes(first.parts[4].read_bytes()[:-50])  # cut short
    seen = []
    again = pam.simulate_many(
        quick(),
        rates(65),
        into=into,
        progress=lambda done, count: seen.append((done, count)),
        **SHORT,
    )
    assert len(again) == 65
    assert seen[-1] == (65, None)
    new = {p for p in again.parts if p.stat().st_mtime_ns != before.get(p)}
    assert new == {again.parts[i] for i in (2, 4, 6)}
    assert [n for n, _ in again] == list(range(65))


def test_other_cases_in_a_part_are_computed_other_arguments_are_refused(tmp_path):
    into = tmp_path / "runs"
    pam.simulate_many(quick(), rates(4), into=into, chunk=2, **SHORT)
    other = [*list(rates(3)), {"parameters": {"rate": 7.0}}]
    changed = dict(pam.simulate_many(quick(), other, into=into, **SHORT))
    assert changed[3]["x"][-1] == pytest.approx(exact(7.0), rel=1e-5)
    for plant, arguments in (
        (quick(), {**SHORT, "rtol": 1e-7}),
        (quick().with_values(x=2.0), SHORT),
        (quick(), {**SHORT, "inputs": {"u": lambda t: 2 * t}}),
    ):
        with pytest.raises(InputError, match="another plant or with other arguments"):
            pam.simulate_many(plant, rates(4), into=into, **arguments)


def test_a_function_is_told_from_another_by_what_it_does(tmp_path):
    def run(slope):
        return pam.simulate_many(
            quick(), rates(1), into=tmp_path, inputs={"u": lambda t: slope * t}, **SHORT
        )

    run(1.0)
    run(1.0)
    refused("other arguments", run, 2.0)


def test_a_folder_with_other_files_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    refused("holds other files", pam.simulate_many, quick(), rates(1), into=tmp_path, **SHORT)
    refused("into =", pam.simulate_many, quick(), rates(1), into=tmp_path / "thesis.txt", **SHORT)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study with a part in which no case has a simulation."""
    cases = [*rates(5), *({"parameters": {"speed": 1.0}} for _ in range(3)), *rates(2)]
    into = tmp_path_factory.mktemp("stored") / "runs"
    stored = pam.simulate_many(quick(), cases, into=into, chunk=3, executor=0, **SHORT)
    assert list(stored.failures) == [5, 6, 7]
    return stored


@pytest.mark.parametrize("reader", ["pandas", "polars", "dask.dataframe"])
def test_others_read_the_folder_as_one_table(folder, reader):
    library = pytest.importorskip(reader)
    if reader == "polars":
        frame = library.scan_parquet(folder.files).collect()
        found = frame.select("case", "time", "x", "u").rows()
    else:
        frame = library.read_parquet(folder.files)
        frame = frame.compute() if hasattr(frame, "compute") else frame
        found = list(frame[["case", "time", "x", "u"]].itertuples(index=False, name=None))
    expected = [
        (number, time, x, 0.0)
        for number, run in folder
        if not isinstance(run, Exception)
        for time, x in zip(run.t.tolist(), run["x"].tolist(), strict=True)
    ]
    assert sorted(found) == expected
    assert len(found) == 21


def test_a_run_that_was_killed_goes_on_where_it_stood(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(KILLED)
    into = tmp_path / "runs"
    run = [sys.executable, str(script), str(into)]
    assert subprocess.run([*run, "30"]).returncode == -signal.SIGKILL
    there = {p: p.stat().st_mtime_ns for p in into.rglob("part-*.parquet")}
    assert 1 <= len(there) < 10
    assert len(StoredSimulations(into)) == 5 * len(there)  # what is there can be read
    assert subprocess.run([*run, "0"]).returncode == 0
    stored = StoredSimulations(into)
    assert [n for n, _ in stored] == list(range(50))
    assert all(p.stat().st_mtime_ns == time for p, time in there.items())
    assert dict(stored)[49]["x"][-1] == pytest.approx(exact(5.0), rel=1e-5)


KILLED = """
import os, signal, sys
import numpy as np
import pam_ocp as pam

plant = pam.Plant("decay", "x' = u - rate x")
x, u, rate = plant.state("x", start=1.0), plant.input("u"), plant.parameter("rate", 1.0)
plant.der(x, u - rate * x)

def progress(done, count):
    if done == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)

cases = ({"parameters": {"rate": 0.1 * (i + 1)}} for i in range(50))
times = np.linspace(0.0, 0.02, 3)
pam.simulate_many(
    plant, cases, executor=2, into=sys.argv[1], chunk=5, progress=progress, t=times, rtol=1e-6
)
"""


WRITES = """
import sys
import pam_ocp as pam
plant = pam.Plant("decay", "x' = -rate x")
x, rate = plant.state("x", start=1.0), plant.parameter("rate", 1.0)
plant.der(x, -rate * x)
cases = pam.simulation.sweep(rate=[1.0, 2.0])
print(len(pam.simulate_many(plant, cases, into=sys.argv[1], executor=0, duration=0.01)))
print("pandas" in sys.modules)
"""


def test_writing_does_not_load_pandas(tmp_path):
    """Which each worker would do anew, for as long as a dozen simulations take."""
    pytest.importorskip("pandas")
    command = [sys.executable, "-c", WRITES, str(tmp_path / "runs")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["2", "False"]


def test_failures_are_kept_with_their_sentence(tmp_path, hanging):
    cases = [{}, {"parameters": {"mass": -1.0}}]
    arguments = {"inputs": {"muscle.command": 4 * BAR}, "duration": 0.01}
    pam.simulate_many(hanging, cases, into=tmp_path, **arguments)
    stored = StoredSimulations(tmp_path)
    assert list(stored.failures) == [1]
    assert isinstance(stored.failures[1], InputError)
    assert "mass: start = -1 kg is outside" in str(stored)
    assert np.array_equal(dict(stored)[0]["x"], pam.simulate(hanging, **arguments)["x"])


@pytest.mark.parametrize("pool", [False, True])
def test_a_killed_worker_costs_its_own_case_only(pool):
    cases = list(rates(120))
    cases[57] = {"inputs": {"u": killer}}
    if pool:
        with ProcessPoolExecutor(2) as executor:
            many = pam.simulate_many(quick(), cases, executor=executor, chunk=10, **SHORT)
    else:
        many = pam.simulate_many(quick(), cases, workers=2, chunk=10, **SHORT)
    assert list(many.failures) == [57]
    assert isinstance(many.failures[57], SimulationError)
    assert "case 57 ended its worker process 2 times (SIGKILL)" in str(many.failures[57])
    for i, trajectory in many.trajectories.items():
        assert trajectory["x"][-1] == pytest.approx(exact(0.1 * (i + 1)), rel=1e-5)


def test_a_case_whose_worker_was_killed_by_chance_is_tried_again(tmp_path, monkeypatch):
    monkeypatch.setenv("PAM_ONCE", str(tmp_path / "once"))
    cases = [*rates(5), {"inputs": {"u": once}}, *rates(5)]
    many = pam.simulate_many(quick(), cases, workers=1, chunk=11, **SHORT)
    assert len(many.trajectories) == 11
    assert (tmp_path / "once").exists()


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_cases(tmp_path):
    def peak(count, **place):
        tracemalloc.start()
        # here: a slow machine would start workers, whose answers on their way count, too
        # and how soon garbage is collected depends on what else there is in this process,
        # which is frozen: to look through all that thousands of tests left behind takes minutes
        more = {"executor": 0, "progress": lambda done, count: gc.collect(), **place}
        gc.freeze()
        pam.simulate_many(quick(), rates(count), chunk=20, **more, **SHORT)
        gc.unfreeze()
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    peak(20, into=tmp_path / "imports")
    few, many = (peak(n, into=tmp_path / str(n)) for n in (40, 200))
    kept = peak(200) - peak(40)
    assert many - few < 0.1 * kept  # of what 160 more results take when they are kept


SCRIPT = """
import os, time
import pam_ocp as pam

def slow(t):
    print("at work", flush=True)
    time.sleep(0.05)
    return 0.0

if __name__ == "__main__":
    print(os.getpid(), flush=True)
    plant = pam.HangingLoad("DMSP-20-400N")
    cases = [{"inputs": {"muscle.command": slow}}] * 8
    pam.simulate_many(plant, cases, workers=2, chunk=1, duration=1.0)
"""


def children(pid: int) -> list[int]:
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(line) for line in found.stdout.split()]


def gone(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_end_with_their_parent(tmp_path, blow):
    script = tmp_path / "long.py"
    script.write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    assert parent.stdout.readline().startswith("at work")  # of several workers at once
    workers = children(pid)
    assert workers
    os.kill(pid, blow)
    limit = time.monotonic() + 10
    while not all(map(gone, workers)) and time.monotonic() < limit:
        time.sleep(0.05)
    left = [w for w in workers if not gone(w)]
    for worker in left:
        os.kill(worker, signal.SIGKILL)
    parent.stdout.close()
    assert parent.wait(10) != 0
    assert left == []


# ---- results of another program ------------------------------------------------------------------
def pushed(tmp_path, gain: float, into: str = "runs") -> float:
    """x at the end of one case, driven by a function that calls one of another module."""
    (tmp_path / "helper_of_push.py").write_text(f"def gain():\n    return {gain}\n")
    (tmp_path / "push.py").write_text(
        "import helper_of_push\ndef push(t):\n    return helper_of_push.gain()\n"
    )
    with as_written():
        import push

        cases = [{"inputs": {"u": push.push}, "parameters": {"rate": 1.0}}]
        stored = pam.simulate_many(quick(), cases, into=tmp_path / into, executor=0, **SHORT)
    return float(dict(stored)[0]["x"][-1])


def test_a_change_in_what_an_input_calls_is_computed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    decay = np.exp(-SHORT["t"][-1])
    for gain in (2.0, 5.0, 2.0):  # x' = u - x from 1
        assert pushed(tmp_path, gain) == pytest.approx(gain + (1 - gain) * decay, rel=1e-5)


def test_what_cannot_be_told_is_computed_anew_and_said(tmp_path):
    def push(t):
        with open(f"{tmp_path}/gain") as file:
            return float(file.read())

    def last(gain):
        (tmp_path / "gain").write_text(str(gain))
        cases = [{"inputs": {"u": push}}, {"inputs": {"u": 1.0}}]
        return dict(
            pam.simulate_many(quick(), cases, into=tmp_path / "runs", executor=0, chunk=1, **SHORT)
        )[0]["x"][-1]

    decay = np.exp(-SHORT["t"][-1])
    with pytest.warns(UserWarning, match=r"into = .*push reads a file that is named as it runs"):
        assert last(2.0) == pytest.approx(2.0 - decay, rel=1e-5)
    kept = tmp_path / "runs" / "cases" / "block-0000" / "part-000001.parquet"
    stamp = kept.stat().st_mtime_ns
    with pytest.warns(UserWarning, match="was computed anew, and will be again"):
        assert last(5.0) == pytest.approx(5.0 - 4.0 * decay, rel=1e-5)
    assert kept.stat().st_mtime_ns == stamp


def test_a_folder_of_another_version_is_refused_by_name(tmp_path):
    stored = pam.simulate_many(quick(), rates(2), into=tmp_path, executor=0, **SHORT)
    path = stored.folder / "study.json"
    content = json.loads(path.read_text())
    assert content["program"]["casadi"] == importlib.metadata.version("casadi")
    content["program"]["casadi"] = "3.6.0"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"another program \(casadi 3\.6\.0, not "):
        pam.simulate_many(quick(), rates(2), into=tmp_path, executor=0, **SHORT)
    assert len(StoredSimulations(tmp_path)) == 2  # and read as before
