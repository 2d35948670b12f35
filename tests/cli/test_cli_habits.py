"""What all commands have in common: options, JSON, silence, endings; a sentence per mistake."""

import json
import logging
import shutil
import subprocess

import pytest

import pam_ocp as pam
from pam_ocp.cli.main import _parser, main
from pam_ocp.core.progress import counted, heard, listening

TABLE = "DMSP-20-300_static.csv"
LENGTH = ("--rest-length", "300 mm")


def run(capsys, *arguments):
    code = main([str(a) for a in arguments])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_every_command_has_the_same_habits():
    (commands,) = (a for a in _parser()._actions if a.dest == "command")
    for name, command in commands.choices.items():
        options = {o for a in command._actions for o in a.option_strings}
        assert {"--quiet", "--verbose", "--time-limit"} <= options, name
        assert "--json" in options or name in ("completion", "bench"), name


@pytest.mark.parametrize(
    "arguments",
    [
        ("fit", TABLE, *LENGTH),
        ("muscles",),
        ("muscles", "show", "DMSP-20-300"),
        ("components", "load"),
        ("linearize", "HangingLoad", "--rest", "muscle.pressure=3 bar"),
        ("simulate", "HangingLoad", "--duration", "5 ms"),
        ("look", TABLE, *LENGTH),
    ],
)
def test_json_is_one_document_without_nan_and_quiet_is_silence(capsys, arguments):
    def refused(word):
        raise AssertionError(f"{word} is no JSON")

    code, out, _ = run(capsys, *arguments, "--json")
    assert code == 0
    assert json.loads(out, parse_constant=refused)
    assert run(capsys, *arguments, "--quiet")[:2] == (0, "")


def test_a_fit_in_json_is_the_fit_and_names_what_it_wrote(capsys, tmp_path):
    file = tmp_path / "muscle.toml"
    code, out, _ = run(capsys, "fit", TABLE, *LENGTH, "--json", "--out", file)
    said = json.loads(out)
    fit = pam.fit_force(pam.read_table(TABLE, rest_length=0.3))
    assert code == 0
    assert said["rmse"] == fit.rmse
    assert said["coefficients"]["a3"]["value"] == fit.law.values["a3"]
    assert said["coefficients"]["a3"]["interval"][0] is None  # open below
    assert said["written"] == [str(file)]


def test_several_tables_fitted_together_are_those_of_python(capsys, tmp_path):
    code, out, _ = run(
        capsys,
        "fit-forces",
        TABLE,
        "DMSP-10-250_static.csv",
        "--rest-length",
        "DMSP-20=300 mm",
        "DMSP-10=0.25",
        "--shared",
        "a3",
        "--out",
        tmp_path,
        "--json",
    )
    assert code == 0
    said = json.loads(out)
    lengths = {"DMSP-20-300_static": 0.3, "DMSP-10-250_static": 0.25}
    tables = {n: pam.read_table(f"{n}.csv", rest_length=length) for n, length in lengths.items()}
    joint = pam.fit_forces(tables, shared=["a3"])
    assert said["coefficients"]["a3"]["value"] == pytest.approx(joint.coefficients["a3"].value)
    muscle = pam.load_muscle(tmp_path / "DMSP-10-250_static.toml")
    assert muscle.law.values["a3"] == pytest.approx(joint.coefficients["a3"].value)


WRONG = [
    (("fit", TABLE, *LENGTH, "--plot", "a.docx"), "--plot a.docx: give a name that ends in .png"),
    (("fit", TABLE, *LENGTH, "--excel", "a.ods"), "--excel a.ods: give a name that ends in .xlsx"),
    (("fit", TABLE, *LENGTH, "--excel", "none/a.xlsx"), "the folder none does not exist"),
    (("linearize", "HangingLoad", "--plot", "a"), "--plot a: give a name that ends in .png"),
    (("muscles", "show", "DMSP-20-300", "--plot", "a.txt"), "ends in .png"),
    (("simulate", "HangingLoad", "--duration", "1 s", "--out", "a.docx"), ".xlsx"),
    (("simulate", "HangingLoad", "--duration", "3 bar"), "something else than 's'"),
    (("mpc", "--set", "mass=3 mm"), "something else than 'kg'"),
    (("mpc", "--set", "mass"), "--set mass: give NAME=VALUE"),
    (("mpc", "--duration", "2 kg"), "something else than 's'"),
    (("mpc", "--real", "masse=3"), "did you mean"),
    (("fit-forces", "none.csv"), "unknown table file 'none.csv'"),
    (("fit-forces", TABLE, TABLE, *LENGTH), "a second table of the name"),
    (("fit-forces", TABLE, *LENGTH, "--law", "six"), "unknown force law 'six'"),
    (("fit-forces", TABLE, *LENGTH, "--shared", "a9"), "give at least two"),
    (("fit-forces", TABLE, "--rest-length", "A=3 kg"), "something else than 'm'"),
    (("fit-forces", TABLE, "--rest-length", "B=0.3"), "give --rest-length"),
    (("study", "none.toml"), "none.toml"),
    (("study", "."), "."),
    (("study", "a.toml", "--scheduler", "tcp://127.0.0.1:1"), "no scheduler answers"),
    (("study", "a.toml", "--workers", "0"), "workers"),
    (("study", "a.toml", "--out", "a.toml/x"), "a.toml"),
]


@pytest.mark.parametrize(("arguments", "words"), WRONG)
def test_a_wrong_command_is_one_sentence(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text('[steps.a]\nkind = "muscle"\nname = "DMSP-20-300"\n')
    if "--scheduler" in arguments:
        pytest.importorskip("distributed")
        monkeypatch.setattr("pam_ocp.cli.study.PATIENCE", 0.5)
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
    code, out, err = run(capsys, *arguments)
    assert (code, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1
    assert "Traceback" not in err


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_is_a_script_of_its_shell_that_knows_every_command(capsys, tmp_path, shell):
    code, out, _ = run(capsys, "completion", shell)
    assert code == 0
    (commands,) = (a for a in _parser()._actions if a.dest == "command")
    assert all(name in out for name in commands.choices)
    if shutil.which(shell):
        (tmp_path / "script").write_text(out)
        subprocess.run([shell, "-n", tmp_path / "script"], check=True)


def test_verbose_tells_what_is_done_by_the_loggers_of_the_package(capsys):
    code, _, err = run(capsys, "fit", TABLE, *LENGTH, "-v")
    assert code == 0
    assert "pam_ocp.fitting" in err
    assert logging.getLogger("pam_ocp").level == logging.NOTSET
    assert run(capsys, "fit", TABLE, *LENGTH)[2] == ""


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
