"""What all commands have in common: options, JSON, silence, endings; a sentence per mistake."""

import json
import logging
import shutil
import signal
import subprocess

import pytest
from cli_tools import run

import pam_ocp as pam
from pam_ocp.cli import main
from pam_ocp.core.progress import counted, heard, listening

TABLE = "DMSP-20-300_static.csv"
FIT = f"fit {TABLE} --rest-length '300 mm'"


def test_every_command_has_the_same_habits():
    (commands,) = (a for a in main._parser()._actions if a.dest == "command")
    for name, command in commands.choices.items():
        options = {o for a in command._actions for o in a.option_strings}
        assert {"--quiet", "--verbose", "--time-limit"} <= options, name
        assert "--json" in options or name in ("completion", "bench"), name


@pytest.mark.parametrize(
    "arguments",
    [
        FIT,
        "muscles",
        "muscles show DMSP-20-300",
        "components load",
        "linearize HangingLoad --rest 'muscle.pressure=3 bar'",
        "simulate HangingLoad --duration '5 ms'",
        f"look {TABLE} --rest-length 0.3",
    ],
)
def test_json_is_one_document_without_nan_and_quiet_is_silence(capsys, arguments):
    def refused(word):
        raise AssertionError(f"{word} is no JSON")

    code, out, _ = run(capsys, arguments, "--json")
    assert code == 0
    assert json.loads(out, parse_constant=refused)
    assert run(capsys, arguments, "--quiet")[:2] == (0, "")


def test_a_fit_in_json_is_the_fit_and_names_what_it_wrote(capsys, tmp_path):
    file = tmp_path / "muscle.toml"
    code, out, _ = run(capsys, f"{FIT} --json --out", file)
    said = json.loads(out)
    fit = pam.fit_force(pam.read_table(TABLE, rest_length=0.3))
    assert code == 0
    assert said["rmse"] == fit.rmse
    assert said["coefficients"]["a3"]["value"] == fit.law.values["a3"]
    assert said["coefficients"]["a3"]["interval"][0] is None  # open below
    assert said["written"] == [str(file)]


def test_an_option_of_several_values_may_be_repeated(capsys):
    both = json.loads(run(capsys, f"{FIT} --fixed a3=-40 --fixed a6=-300 --json")[1])
    assert both["coefficients"]["a3"]["value"] == -40.0
    assert both["coefficients"]["a6"]["value"] == -300.0


def test_a_ranking_in_json_has_every_law_the_best_first(capsys):
    said = json.loads(run(capsys, f"{FIT} --law six-parameter --law five-parameter --json")[1])
    assert [law["name"] for law in said["ranking"]] == ["five-parameter", "six-parameter"]
    assert said["law"] == said["ranking"][0]["name"]
    assert said["rmse"] == said["ranking"][0]["rmse"]


def test_ctrl_c_before_a_command_has_begun_is_no_traceback(capsys, monkeypatch):
    monkeypatch.setattr(main, "_parser", lambda: signal.raise_signal(signal.SIGINT))
    assert main.main(["muscles"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_several_tables_fitted_together_are_those_of_python(capsys, tmp_path):
    given = f"fit-forces {TABLE} DMSP-10-250_static.csv --shared a3 --json"
    lengths = ("--rest-length", "DMSP-20=300 mm", "DMSP-10=0.25")
    code, out, _ = run(capsys, given, *lengths, "--out", tmp_path)
    assert code == 0
    said = json.loads(out)
    lengths = {"DMSP-20-300_static": 0.3, "DMSP-10-250_static": 0.25}
    tables = {n: pam.read_table(f"{n}.csv", rest_length=length) for n, length in lengths.items()}
    joint = pam.fit_forces(tables, shared=["a3"])
    assert said["coefficients"]["a3"]["value"] == pytest.approx(joint.coefficients["a3"].value)
    muscle = pam.load_muscle(tmp_path / "DMSP-10-250_static.toml")
    assert muscle.law.values["a3"] == pytest.approx(joint.coefficients["a3"].value)


def test_a_scheduler_that_does_not_answer_is_one_sentence(capsys, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text('[steps.a]\nkind = "muscle"\nname = "DMSP-20-300"\n')
    monkeypatch.setattr("pam_ocp.cli.study.PATIENCE", 0.5)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    code, out, err = run(capsys, "study a.toml --scheduler tcp://127.0.0.1:1")
    assert (code, out) == (2, "")
    assert "no scheduler answers" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_is_a_script_of_its_shell_that_knows_every_command(capsys, tmp_path, shell):
    code, out, _ = run(capsys, "completion", shell)
    assert code == 0
    (commands,) = (a for a in main._parser()._actions if a.dest == "command")
    assert all(name in out for name in commands.choices)
    if shutil.which(shell):
        (tmp_path / "script").write_text(out)
        subprocess.run([shell, "-n", tmp_path / "script"], check=True)


def test_verbose_tells_what_is_done_by_the_loggers_of_the_package(capsys):
    code, _, err = run(capsys, f"{FIT} -v")
    assert code == 0
    assert "pam_ocp.fitting" in err
    assert logging.getLogger("pam_ocp").level == logging.NOTSET
    assert run(capsys, FIT)[2] == ""


class Heard:
    """A listener that keeps what it hears."""

    made: list = []  # noqa: RUF012

    def __init__(self, what, total):
        self.what, self.total, self.done, self.closed = what, total, 0, False
        Heard.made.append(self)

    def step(self, more=1, note=""):
        self.done += more

    def close(self):
        self.closed = True


def test_long_work_tells_how_far_it_is_and_only_the_outermost():
    Heard.made = []
    fit = pam.fit_force(pam.read_table(TABLE, rest_length=0.3), "three-element")
    with listening(Heard):
        fit.bootstrap(12)
        for _ in counted(range(2), "outer"):
            assert not heard()
            list(counted(range(5), "inner"))
    met = [(h.what, h.total, h.done, h.closed) for h in Heard.made]
    assert met == [("bootstrap", 12, 12, True), ("outer", 2, 2, True)]
    assert not heard()


PLANT_FILE = """
[plant]
arrangement = "HangingLoad"
muscle = "DMSP-20-300"
"""
SYSTEM_FILE = """
[components.plant]
arrangement = "HangingLoad"
muscle = "DMSP-20-300"
[connections]
"""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("simulate plant.toml --muscle DMSP-20-400N --duration 0.1", "--muscle DMSP-20-400N: "),
        ("linearize run.npz --muscle DMSP-20-400N", "run.npz has its own muscle"),
        ("mpc run.npz --muscle DMSP-20-400N", "run.npz has its own muscle"),
        ("export system.toml --set mass=3kg", "--set: system.toml says"),
        ("export system.toml --output x", "--output: system.toml says"),
        ("muscles --plot force.png", "--plot: of one muscle; give show NAME"),
        ("muscles --rest-length 0.25", "--rest-length: of one muscle; give show NAME"),
        ("muscles show mine.toml --rest-length 0.25", "mine.toml has its own rest length"),
        ("simulate HangingLoad --duration 0.1 --samples 0", "--samples = 0: give a whole number"),
    ],
)
def test_an_option_without_effect_is_refused(capsys, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plant.toml").write_text(PLANT_FILE)
    (tmp_path / "system.toml").write_text(SYSTEM_FILE)
    pam.save_muscle(pam.muscle("DMSP-20-300"), "mine.toml")
    assert run(capsys, "simulate HangingLoad --duration 0.01 --out run.npz")[0] == 0
    code, out, err = run(capsys, arguments)
    assert (code, out) == (2, "")
    assert said in err


def test_recorded_inputs_are_simulated_at_as_many_samples_as_asked_for(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    run(capsys, "simulate HangingLoad --duration 0.1 --samples 5 --out a.npz")
    code, _, _ = run(capsys, "simulate HangingLoad --inputs a.npz --samples 11 --out b.npz")
    assert code == 0
    assert pam.Trajectory.load("b.npz").t == pytest.approx([0.01 * k for k in range(11)])


def test_mpc_takes_the_muscle_of_the_command_line_before_that_of_its_file(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    table = '[plant]\narrangement = "AntagonisticSlide"\nmuscle = "{}"\nmass = 2.0\n'
    (tmp_path / "one.toml").write_text(table.format("DMSP-20-300"))
    (tmp_path / "two.toml").write_text(table.format("DMSP-20-200N"))
    loop = "--duration 0.02 --json"
    said = run(capsys, f"mpc one.toml --muscle DMSP-20-200N {loop}")
    assert said[0] == 0
    assert said == run(capsys, f"mpc two.toml {loop}")
