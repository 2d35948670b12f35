"""Commands where the surroundings are against them: full disks, bare environments, odd names."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.cli.main import main

SHORT = ("simulate", "HangingLoad", "--duration", "5 ms", "--samples", "2")
HUGE = "1" + 400 * "0"
"""10**400 is no float."""


def run(capsys, *arguments):
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as ended:
        code = ended.code
    said = capsys.readouterr()
    return code, said.out, said.err


def command(*arguments, cwd, stdout=subprocess.PIPE, before="", **environment):
    """The command in a process of its own, with an environment of its own."""
    script = f"{before}\nimport sys\nfrom pam_ocp.cli.main import main\nsys.exit(main())"
    whole = {n: v for n, v in os.environ.items() if n not in ("HOME", "MPLCONFIGDIR")}
    return subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env={**whole, **environment},
        cwd=cwd,
        stdout=stdout,
        stderr=subprocess.PIPE,
        timeout=120,
    )


# ---- outputs -------------------------------------------------------------------------------------
FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    "arguments",
    [("muscles",), ("components", "load", "--json"), ("completion", "bash"), ("--help",), SHORT],
    ids=lambda a: a[0],
)
def test_a_full_device_ends_a_command_by_one_sentence(tmp_path, arguments, unbuffered):
    with FULL.open("w") as full:
        done = command(*arguments, cwd=tmp_path, stdout=full, PYTHONUNBUFFERED=unbuffered)
    assert done.returncode == 2
    assert done.stderr.decode().splitlines() == [
        "pam-ocp: the output was not written: No space left on device"
    ]


def outputs(folder):
    """Every option by which a command writes a file, before the work that would fill it."""
    pam.simulate(pam.HangingLoad("DMSP-20-300"), duration=0.01).save(folder / "run.npz")
    (folder / "problem.toml").write_text(
        'duration = "0.3 s"\nstops = [{ x = "10 mm" }, { x = "20 mm" }]\n'
        '[plant]\narrangement = "HangingLoad"\nmuscle = "DMSP-20-300"\n'
    )
    fit = ("fit", "DMSP-20-300_static.csv", "--rest-length", "300 mm")
    yield from ((SHORT, "--out", e) for e in (".csv", ".npz", ".xlsx"))
    yield SHORT, "--plot", ".png"
    yield from (
        (fit, o, e) for o, e in (("--out", ".toml"), ("--ssv", ".ssv"), ("--excel", ".xlsx"))
    )
    yield ("linearize", "HangingLoad", "--rest", "muscle.pressure=3 bar"), "--out", ".json"
    yield ("export", "HangingLoad"), "--out", ".fmu"
    yield ("report", "run.npz"), "--out", ".html"
    yield ("compare", "run.npz", "run.npz"), "--plot", ".png"
    yield ("mpc",), "--out", ".npz"
    yield from (
        (("plan", "problem.toml"), option, ending)
        for option, ending in (
            ("--out", ".npz"),
            ("--csv", ".csv"),
            ("--excel", ".xlsx"),
            ("--animate", ".gif"),
            ("--fmu-inputs", ".csv"),
        )
    )
    yield ("loads",), "--out", ""
    yield ("tour",), "--out", ""


def test_outputs_that_are_no_files_are_refused_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for given, option, ending in list(outputs(tmp_path)):
        folder = tmp_path / f"folder{ending}"
        folder.mkdir(exist_ok=True)
        targets = {f"s3://bucket/x{ending}": f"s3://bucket/x{ending} is a URL; "}
        if ending:
            targets[str(folder)] = f"{folder} is a folder; "
            targets[str(tmp_path / "no" / f"x{ending}")] = "does not exist; create it first"
        if FULL.exists():
            targets[f"/dev/full/x{ending}"] = "/dev/full"
        for target, words in targets.items():
            before = sorted(tmp_path.rglob("*"))
            code, out, err = run(capsys, *given, option, target)
            assert (code, out) == (2, ""), (given, target)
            assert words in err
            assert len(err.splitlines()) == 1
            assert sorted(tmp_path.rglob("*")) == before


def test_what_is_read_is_no_url(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for given in (
        ("look", "https://example.org/rig.csv"),
        ("fit", "s3://bucket/rig.csv", "--rest-length", "300 mm"),
        ("compare", "s3://bucket/a.npz", "s3://bucket/b.npz"),
        ("plan", "https://example.org/problem.toml"),
        ("study", "gs://bucket/study.toml"),
        ("check", "https://example.org/unit.fmu"),
        ("campaign", "s3://bucket/rigs"),
        ("fit-plant", "s3://bucket/*.csv", "--plant", "HangingLoad", "--free", "mass"),
    ):
        code, out, err = run(capsys, *given)
        assert (code, out) == (2, "")
        assert f"{given[1]} is a URL; give the path of a file or folder of this machine" in err


def test_a_write_protected_folder_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shut = tmp_path / "shut"
    shut.mkdir(mode=0o500)
    if os.geteuid() == 0:  # whom permissions do not stop
        allowed = os.access
        monkeypatch.setattr(os, "access", lambda p, m, **k: Path(p) != shut and allowed(p, m, **k))
        monkeypatch.setattr(os, "supports_effective_ids", {os.access})
    code, out, err = run(capsys, *SHORT, "--out", shut / "x.csv")
    assert (code, out) == (2, "")
    assert err == (
        f"pam-ocp simulate: {shut / 'x.csv'} was not written (Permission denied); give yourself "
        "the right to write there, or write elsewhere\n"
    )


# ---- names and terminals -------------------------------------------------------------------------
def test_a_name_with_a_line_in_it_stays_on_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(capsys, *SHORT, "--out", "two\nlines.csv")
    assert code == 0
    assert out.splitlines()[-1] == r"-> 'two\nlines.csv'"
    assert (tmp_path / "two\nlines.csv").is_file()
    for given in (("look", "no\nfile.csv"), ("compare", "no\nfile.npz", "b.npz")):
        code, out, err = run(capsys, *given)
        assert (code, len(err.splitlines())) == (2, 1)
        assert r"no\nfile" in err


@pytest.mark.skipif(sys.platform != "linux", reason="names there are bytes")
def test_an_ascii_terminal_shows_names_escaped_and_files_keep_theirs(tmp_path):
    bare = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    name = "Größe.csv".encode()
    done = command(*SHORT, "--out", name, cwd=tmp_path, **bare)
    assert (done.returncode, done.stderr) == (0, b"")
    assert os.listdir(os.fsencode(tmp_path)) == [name]
    assert pam.Trajectory.load(tmp_path / "Größe.csv")["x"].size == 2
    assert done.stdout.splitlines()[-1] == rb"-> 'Gr\udcc3\udcb6\udcc3\udc9fe.csv'"
    done = command("muscles", "--json", cwd=tmp_path, **bare)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.isascii()
    assert json.loads(done.stdout)["muscles"]
    assert command("muscles", cwd=tmp_path, **bare).returncode == 0


@pytest.mark.skipif(sys.platform == "win32", reason="homes there are no variable")
@pytest.mark.slow
def test_a_user_without_a_home_gets_files_and_no_complaint(tmp_path):
    nobody = "import pwd\ndef nobody(uid): raise KeyError(uid)\npwd.getpwuid = nobody\n"
    for home in ({}, {"HOME": str(tmp_path / "gone")}):
        done = command(*SHORT, "--plot", "motion.png", "-q", cwd=tmp_path, before=nobody, **home)
        assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
        (tmp_path / "motion.png").unlink()
        assert os.listdir(tmp_path) == []


# ---- numbers -------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--duration", HUGE), "duration is larger than any float"),
        (("--duration", "1e400 s"), "duration is larger than any float"),
        (("--samples", HUGE), "argument --samples: 401 digits are more than"),
        (("--samples", "999999999"), "--samples = 999999999: give a whole number from 2 to"),
        (("--set", f"mass={HUGE}"), "mass: "),
        (("--input", f"muscle.command={HUGE}"), "muscle.command: --input is larger than any float"),
        (("--rtol", HUGE), "rtol = inf must be a finite number"),
        (("--time-limit", HUGE), "time_limit = inf must be a finite number"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_number_beyond_all_range_is_named(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *SHORT, *arguments)
    assert (code, out) == (2, "")
    assert words in err
    assert "Traceback" not in err


def test_a_whole_number_beyond_all_range_in_a_file_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    plant = f'[plant]\narrangement = "HangingLoad"\nmuscle = "DMSP-20-300"\nmass = {HUGE}\n'
    (tmp_path / "plant.toml").write_text(plant)
    code, _, err = run(capsys, "simulate", "plant.toml", "--duration", "5 ms")
    assert code == 2
    assert "plant.mass is larger than any" in err
    plant = pam.HangingLoad("DMSP-20-300")
    for call in (
        lambda: plant.with_values(mass=10**400),
        lambda: pam.simulate(plant, {"muscle.command": 10**400}, duration=0.01),
        lambda: pam.simulate(plant, t=[0, 10**400]),
        lambda: pam.HangingLoad("DMSP-20-300", mass=10**400),
    ):
        refused(r"larger than any|must be a finite number", call)


# ---- own plants ----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("plant = None", "mine.py:plant is None; give a Plant, or a function that takes a muscle"),
        ("plant = 3.0", "mine.py:plant is a float; give a Plant"),
        ("plant = int", "mine.py:plant is the class int; give a Plant"),
        ("def plant(): return 3", "mine.py:plant cannot take a muscle (too many positional"),
        ("def plant(*, body): return 3", "mine.py:plant cannot take a muscle (too many positional"),
        ("def plant(muscle): return None", "mine.py:plant returns None; give a Plant"),
        ("def plant(muscle): return 'x'", "mine.py:plant returns a str; give a Plant"),
    ],
)
def test_what_is_no_plant_is_named(tmp_path, monkeypatch, capsys, lines, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(lines + "\n")
    code, out, err = run(capsys, "simulate", "mine.py:plant", "--muscle", "DMSP-20-300")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert words in err


@pytest.mark.slow
def test_equations_in_excess_are_said_by_the_error_alone(tmp_path, monkeypatch, capfd):
    """CasADi would print a line of its own at each of some twenty solves."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "problem.toml").write_text(
        'duration = "0.3 s"\nmethod = { intervals = 10 }\n'
        'stops = [{ x = "10 mm" }, { x = "20 mm" }]\n'
        '[plant]\narrangement = "HangingLoad"\nmuscle = "DMSP-20-300"\n'
        "[bounds]\nv = [0.0, 0.0]\n"
    )
    code = main(["plan", "problem.toml"])
    said = capfd.readouterr()
    assert code in (1, 2)
    assert "overconstrained" not in said.out + said.err
    assert "no plan found" in said.out + said.err
