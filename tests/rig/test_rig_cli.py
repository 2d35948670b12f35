"""``pam-ocp twin`` and ``pam-ocp rig``, in processes of their own."""

import json
import subprocess
import sys

import pytest
from rig_fixtures import made, plant  # noqa: F401 - fixtures

import pam_ocp as pam
from pam_ocp.cli.main import main

PLANT = """
[plant]
arrangement = "HangingLoad"
muscle = "DMSP-20-300"
mass = 10.0
damping = 100.0
"""
BENCH = """
sample_time = "10 ms"
record = "runs"
driver = {{ kind = "udp", host = "127.0.0.1", port = {port}, timeout = "100 ms" }}
plant = "plant.toml"

[readings.x]
low = "-20 mm"
high = "90 mm"
[readings."muscle.pressure"]
low = "-0.5 bar"
high = "7 bar"
[commands."muscle.command"]
high = "5 bar"
[guard]
max_age = "1 s"
late = "1 s"
heartbeat = "0.5 s"
"""


@pytest.fixture
def bench(tmp_path):
    """A rig's file, and the twin's process behind it."""
    (tmp_path / "plant.toml").write_text(PLANT)
    (tmp_path / "faults.toml").write_text(
        '[[fault]]\nkind = "bias"\nchannel = "muscle.pressure"\nvalue = "0.02 bar"\n'
        '[sensors.x]\nresolution = "0.01 mm"\n[plant]\nlosses = [{ kind = "CoulombFriction" }]\n'
    )
    arguments = ["twin", "plant.toml", "--udp", "0", "--json", "--scale", "1.1", "--noise"]
    more = [
        "muscle.pressure=0.003 bar",
        "--delay",
        "2 ms",
        "--faults",
        "faults.toml",
        "--timeout",
        "2 s",
    ]
    twin = subprocess.Popen(
        [sys.executable, "-m", "pam_ocp", *arguments, *more, "--duration", "120"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        port = json.loads(twin.stdout.readline())["port"]
        (tmp_path / "bench.toml").write_text(BENCH.format(port=port))
        yield tmp_path / "bench.toml"
    finally:
        twin.kill()
        twin.wait()


@pytest.mark.slow
def test_a_rig_is_checked_run_and_vented_from_the_command_line(bench, capsys, monkeypatch):
    monkeypatch.chdir(bench.parent)
    assert main(["rig", "check", str(bench), "--duration", "0.3", "--json"]) == 0
    seen = json.loads(capsys.readouterr().out)
    assert seen["readings"]["muscle.pressure"]["mean"] == pytest.approx(2000.0, abs=400.0)
    steps = abs(seen["readings"]["x"]["lowest"] / 1e-5)
    assert abs(steps - round(steps)) < 1e-3
    muscle = pam.muscle("DMSP-20-300")
    plant = pam.HangingLoad(muscle, mass=10.0, damping=100.0)
    pam.simulate(plant, {"muscle.command": 2e5}, duration=0.5).save("motion.npz")
    assert main(["rig", "run", str(bench), "--motion", "motion.npz"]) == 2
    assert "--arm" in capsys.readouterr().err
    assert not (bench.parent / "runs").exists()
    words = ["rig", "run", str(bench), "--motion", "motion.npz", "--arm", "--out", "run.npz"]
    assert main(words) == 0
    run = pam.Trajectory.load("run.npz")
    assert run["muscle.command"][-2] == pytest.approx(2e5)
    assert run["muscle.pressure"][-1] == pytest.approx(2e5, abs=1.5e4)
    assert len(list((bench.parent / "runs").glob("run_*.csv"))) == 1
    assert main(["rig", "vent", str(bench)]) == 0
    assert "vented" in capsys.readouterr().out


def test_what_a_file_of_a_rig_lacks_is_named(tmp_path, capsys):
    (tmp_path / "plant.toml").write_text(PLANT)
    for text, words in (
        ('plant = "plant.toml"', "driver"),
        ('plant = "plant.toml"\ndriver = { kind = "udb" }', "udp"),
        ('plant = "plant.toml"\ndrivers = { kind = "udp" }', "driver"),
        ('driver = { kind = "udp", host = "127.0.0.1", port = 9 }', "readings and commands"),
        (BENCH.format(port=9).replace("max_age", "max_aged"), "max_age"),
        (BENCH.format(port=9).replace('high = "5 bar"', 'high = "5 mm"'), "muscle.command"),
    ):
        file = tmp_path / "bench.toml"
        file.write_text(text)
        assert main(["rig", "check", str(file)]) == 2
        assert words in capsys.readouterr().err
    assert main(["rig", "home", str(file)]) == 2
    assert "--arm" in capsys.readouterr().err


def test_a_rig_that_does_not_answer_is_said_so(tmp_path, capsys):
    (tmp_path / "plant.toml").write_text(PLANT)
    (tmp_path / "bench.toml").write_text(BENCH.format(port=9).replace("100 ms", "5 ms"))
    file = str(tmp_path / "bench.toml")
    assert main(["rig", "check", file, "--duration", "0.05"]) == 1
    assert main(["rig", "vent", file]) == 1
    assert "emergency stop" in capsys.readouterr().out
    assert main(["rig", "home", file, "--arm"]) == 1
