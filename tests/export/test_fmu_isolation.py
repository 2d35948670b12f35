"""A unit under check may crash, leave or hang: the caller lives, and learns where it happened."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import BAR, benchmark_slide, refused
from hostile import contents, hostile_unit, packed

import pam_ocp as pam
from pam_ocp import check_fmu
from pam_ocp.cli.main import main
from pam_ocp.core.errors import ExportError
from pam_ocp.export.check import check_fmus
from pam_ocp.export.isolation import run_alone

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.fixture(scope="session")
def units(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The hostile unit in both versions, compiled once."""
    folder = tmp_path_factory.mktemp("hostile")
    try:
        return {fmi: hostile_unit(folder, fmi) for fmi in ("2.0", "3.0")}
    except ExportError as error:
        pytest.skip(f"no compiler: {error}")


@pytest.fixture
def harm(units, monkeypatch, tmp_path):
    """harm(what, fmi): the hostile unit, which does that from now on."""

    def told(what, fmi="2.0"):
        monkeypatch.setenv("HOSTILE", what)
        monkeypatch.setenv("HOSTILE_PID", str(tmp_path / "pid"))
        return units[fmi]

    return told


def only_finding(path: Path, time_limit: float = 60.0) -> str:
    checked = check_fmu(path, time_limit=time_limit)
    assert not checked.ok
    (finding,) = checked.findings
    return finding


# ---- what a unit may do --------------------------------------------------------------------------


@posix
@pytest.mark.parametrize(
    ("what", "fmi", "sentence"),
    [
        ("segfault DoStep", "3.0", "crashed (segmentation fault) in fmi3DoStep (CoSimulation)"),
        ("stack DoStep", "2.0", "crashed (segmentation fault) in fmi2DoStep"),
        ("abort FreeInstance", "2.0", "aborted in fmi2FreeInstance"),
        ("exit0 DoStep", "2.0", "ended its process with exit code 0 in fmi2DoStep"),
        ("_exit0 FreeInstance", "3.0", "ended its process with exit code 0 in fmi3FreeInstance"),
        ("exit3 ExitInitializationMode", "2.0", "exit code 3 in fmi2ExitInitializationMode"),
        ("killed DoStep", "2.0", "was killed"),
        ("segfault loading", "2.0", "crashed (segmentation fault) in the loading of its library"),
        ("exit0 unloading", "3.0", "exit code 0 in the unloading of its library"),
        ("close DoStep", "2.0", "ended its process with exit code"),
    ],
)
def test_a_unit_that_dies_is_a_finding_that_names_the_call(harm, what, fmi, sentence):
    assert sentence in only_finding(harm(what, fmi))


@posix
@pytest.mark.slow
def test_a_unit_that_dies_leaves_the_checks_beside_it(harm, tmp_path):
    plant = benchmark_slide()
    well = pam.export_fmu(plant, tmp_path / "well.fmu", platforms="native")
    motion = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=np.linspace(0, 0.02, 5))
    hostile = harm("segfault DoStep")
    refused(r"well\.fmu' is one file; give a list", check_fmus, well)
    one, dead, other = check_fmus([well, hostile, well], against=motion)
    assert one.ok
    assert other.ok
    (finding,) = dead.findings
    assert "crashed (segmentation fault) in fmi2DoStep (CoSimulation)" in finding
    assert one.deviations == other.deviations == check_fmu(well, against=motion).deviations
    for kind, played in one.trajectories.items():
        assert np.array_equal(played["x"], other.trajectories[kind]["x"])
        assert played["x"][-1] == pytest.approx(motion["x"][-1], abs=1e-8)


@posix
@pytest.mark.parametrize(
    ("what", "fmi"), [("spin DoStep", "2.0"), ("hang DoStep", "3.0"), ("hang FreeInstance", "2.0")]
)
def test_a_unit_that_hangs_is_stopped(harm, what, fmi):
    finding = only_finding(harm(what, fmi), time_limit=2.0)
    assert f"was stopped after 2 s (time_limit) in fmi{fmi[0]}{what.split()[1]}" in finding


@linux
def test_a_unit_cannot_take_all_memory(harm):
    finding = only_finding(harm("memory DoStep"))
    assert "crashed (segmentation fault) in fmi2DoStep" in finding


def test_what_a_unit_prints_does_no_harm(harm, capfd):
    assert check_fmu(harm("print DoStep", "3.0")).ok
    assert capfd.readouterr() == ("", "")


@linux
def test_what_a_unit_has_started_ends_with_the_check(harm, tmp_path):
    assert check_fmu(harm("fork DoStep")).ok
    assert gone(int((tmp_path / "pid").read_text()))


@linux
@pytest.mark.parametrize(
    ("what", "limit", "sentence"),
    [
        ("escape DoStep", 2.0, "was stopped after 2 s (time_limit) in fmi2DoStep"),
        ("escape_and_die DoStep", 30.0, "ended its process with exit code 0 in fmi2DoStep"),
    ],
)
def test_a_unit_that_forks_into_a_session_of_its_own_is_stopped_with_its_fork(
    harm, tmp_path, what, limit, sentence
):
    """The fork's own parent has ended, and the fork holds all pipes open."""
    assert sentence in only_finding(harm(what), time_limit=limit)
    assert gone(int((tmp_path / "pid").read_text()), 0.0)


@posix
def test_what_was_found_before_a_crash_is_kept(harm, tmp_path):
    content = contents(harm("segfault DoStep"))
    text = content["modelDescription.xml"].decode()
    content["modelDescription.xml"] = text.replace('unit="Pa"', 'unit="Pq"').encode()
    checked = check_fmu(packed(tmp_path / "wrong.fmu", content))
    assert checked.fmi == "2.0"
    assert len(checked.platforms) == 1
    assert len(checked.findings) > 1
    assert "segmentation fault" in checked.findings[-1]
    assert "Pq" in checked.findings[0]


@posix
def test_the_command_answers_with_an_exit_code_of_its_own(harm, capsys):
    assert main(["check", str(harm("exit0 DoStep"))]) == 1
    assert "NOT well" in capsys.readouterr().out


@pytest.mark.parametrize("share", [0.02, 0.99])
def test_a_library_that_is_cut_is_a_finding(units, tmp_path, share):
    content = contents(units["2.0"])
    (binary,) = (n for n in content if n.startswith("binaries/"))
    content[binary] = content[binary][: int(share * len(content[binary]))]
    assert check_fmu(packed(tmp_path / "cut.fmu", content)).findings


@pytest.mark.slow
def test_damage_anywhere_in_the_library_leaves_the_caller_alive(units, tmp_path):
    rng = np.random.default_rng(15)
    for _ in range(2):
        content = contents(units["3.0"])
        (binary,) = (n for n in content if n.startswith("binaries/"))
        damaged = bytearray(content[binary])
        start = int(rng.integers(64, len(damaged) - 1000))
        damaged[start : start + 1000] = rng.bytes(1000)
        content[binary] = bytes(damaged)
        check_fmu(packed(tmp_path / "damaged.fmu", content), time_limit=5.0)


# ---- the caller ----------------------------------------------------------------------------------


def test_the_figures_cross_the_border_unchanged(tmp_path):
    """The motion that comes back is the one compared, with the record's inputs and times."""
    plant = benchmark_slide()
    path = pam.export_fmu(plant, tmp_path / "slide.fmu", platforms="native")
    t = np.linspace(0.0, 0.05, 6)
    motion = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=t)
    checked = check_fmu(path, motion)
    assert set(checked.trajectories) == {"CoSimulation", "ModelExchange"}
    for mode, run in checked.trajectories.items():
        assert list(run.t) == list(t)
        assert list(run["muscle1.command"]) == [4 * BAR] * 6
        nominal = motion.variable("x").nominal
        found = float(np.max(np.abs(run["x"] - motion["x"]))) / nominal
        assert found == pytest.approx(checked.deviations[mode]["x"], rel=1e-6, abs=1e-15)


def test_wrong_arguments_are_refused_here(units):
    refused("time_limit", check_fmu, units["2.0"], time_limit=0.0)
    refused("against is a str", check_fmu, units["2.0"], "slide.npz")
    refused("mass", check_fmu, units["2.0"], parameters={"mass": float("nan")})
    refused("did you mean 'mass'", check_fmu, units["2.0"], parameters={"masss": 1.0})
    with pytest.raises(pam.InputError, match="no column that is an output"):
        check_fmu(units["2.0"], pam.Trajectory([0.0, 0.1], {"other": [0.0, 0.0]}))


@pytest.mark.slow
def test_a_script_without_a_guard_can_check(units, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(f"import pam_ocp\nprint(pam_ocp.check_fmu({str(units['2.0'])!r}).ok)\n")
    how = {"env": surroundings(), "cwd": tmp_path, "capture_output": True, "text": True}
    for argument, text in ((str(script), None), ("-", script.read_text())):
        done = subprocess.run([sys.executable, argument], input=text, check=False, **how)
        assert (done.stdout, done.stderr) == ("True\n", "")


def test_names_of_modules_beside_the_caller_are_not_taken(units, tmp_path, monkeypatch):
    for name in ("pickle", "numpy", "json"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not this one')")
    monkeypatch.chdir(tmp_path)
    assert check_fmu(units["2.0"]).ok


def test_checks_from_several_threads_do_not_disturb_each_other(units):
    """And the hostile units are well as long as they are not told to harm."""
    seen: list[bool] = []
    threads = [
        threading.Thread(target=lambda p=path: seen.append(check_fmu(p).ok))
        for path in units.values()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [True, True]


def test_a_worker_that_cannot_be_loaded_is_said_so(tmp_path):
    with pytest.raises(pam.SimulationError, match=r"did not start: .*no_such_module"):
        run_alone("no_such_module:f", {}, tmp_path, 1.0, lambda **_: None)


@linux
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_the_process_of_a_hanging_unit_ends_with_the_caller(units, tmp_path, end):
    script = f"import pam_ocp\npam_ocp.check_fmu({str(units['2.0'])!r})\n"
    (tmp_path / "tmp").mkdir()
    environment = hanging(tmp_path) | {"TMPDIR": str(tmp_path / "tmp")}
    heard = {"stderr": subprocess.PIPE, "text": True}
    caller = subprocess.Popen([sys.executable, "-c", script], env=environment, **heard)
    unit = pid_in(tmp_path / "pid")
    assert not gone(unit, 0.0)
    caller.send_signal(end)
    words = caller.communicate(timeout=10)[1]
    assert caller.returncode != 0
    assert ("KeyboardInterrupt" in words) == (end == signal.SIGINT)
    assert gone(unit)
    assert list((tmp_path / "tmp").iterdir()) == []


@linux
def test_a_caller_that_has_forked_is_missed_all_the_same(units, tmp_path):
    """Its child holds copies of all pipes, and lives on."""
    script = (
        "import os, threading, time, pam_ocp\n"
        f"check = lambda: pam_ocp.check_fmu({str(units['3.0'])!r})\n"
        "threading.Thread(target=check).start()\n"
        f"while not os.path.exists({str(tmp_path / 'pid')!r}): time.sleep(0.02)\n"
        "child = os.fork()\n"
        "time.sleep(0.2 if child else 20)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", script]
    caller = subprocess.Popen(command, env=hanging(tmp_path), start_new_session=True)
    unit = pid_in(tmp_path / "pid")
    assert caller.wait(timeout=10) == -signal.SIGKILL
    assert gone(unit)
    os.killpg(caller.pid, signal.SIGKILL)  # the fork


def surroundings(**more: str) -> dict[str, str]:
    """Of a process that imports what this one does."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **more}


def hanging(folder: Path) -> dict[str, str]:
    """Of a process in which hostile units hang, and write their number into a file."""
    return surroundings(HOSTILE="hang DoStep", HOSTILE_PID=str(folder / "pid"))


def pid_in(path: Path) -> int:
    """The number that a unit writes once it hangs."""
    end = time.monotonic() + 30
    while time.monotonic() < end:
        if path.is_file() and path.read_text().endswith("\n"):
            return int(path.read_text())
        time.sleep(0.02)
    raise AssertionError("the unit was never called")


def gone(pid: int, within: float = 60.0) -> bool:
    """Whether a process has ended, be it still listed for a parent that does not ask."""
    end = time.monotonic() + within
    while True:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state in "ZX":
            return True
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
