"""A file that names Python code runs it with --allow-code only, in every command that reads one."""

import pytest

from pam_ocp.cli.main import _parser, main

CODE = """
import pathlib
import pam_ocp
pathlib.Path(__file__).with_name("ran").touch()
def load(muscle, **parts):
    raise pam_ocp.InputError("here it ends")
"""
TABLE = '[plant]\narrangement = "mine.py:load"\nmuscle = "DMSP-20-300"\n'
STUDY = '[steps.a]\nkind = "plant"\narrangement = "mine.py:load"\nmuscle = "DMSP-20-300"\n'
RIG = 'driver = { kind = "udp", host = "127.0.0.1", port = 9 }\n'
NAMED = 'plant = "mine.py:load"\n'
STOPS = '[[stops]]\nx = "-10 mm"\n[[stops]]\nx = "10 mm"\n'
COMMANDS = {
    "plan": [TABLE + STOPS],
    "export": [TABLE],
    "simulate": [TABLE],
    "linearize": [TABLE],
    "fit-holds": [TABLE],
    "ladder": [TABLE],
    "mpc": [TABLE, NAMED],
    "study": [STUDY],
    "rig": [RIG + TABLE],
    "twin": [RIG + TABLE],
    "fit-plant": ['free = ["mass"]\n' + TABLE, 'free = ["mass"]\n' + NAMED],
}


def test_no_command_that_takes_consent_is_left_out():
    (commands,) = (a for a in _parser()._actions if a.dest == "command")
    asks = {n for n, c in commands.choices.items() if "--allow-code" in c.format_help()}
    assert asks - {"bench"} == set(COMMANDS)  # bench reads files later, in the browser


@pytest.mark.parametrize(
    ("command", "content"), [(c, text) for c, texts in COMMANDS.items() for text in texts]
)
def test_code_named_in_a_file_runs_with_consent_only(command, content, tmp_path, capsys):
    (tmp_path / "mine.py").write_text(CODE)
    file = tmp_path / "file.toml"
    file.write_text(content)
    words = [command, str(file)]
    if command.startswith("fit-"):
        words = [command, "--plant", str(file)]
    if command == "fit-holds":
        words += ["holds.csv", "--estimate", "mass"]
    if command == "study":
        words += ["--out", str(tmp_path / "out"), "--cache", str(tmp_path / "cache")]
    if command == "rig":
        words = ["rig", "check", str(file)]
    if command == "twin":
        words += ["--udp", "9755"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "would run the Python file" in said
    assert "--allow-code" in said
    assert not (tmp_path / "ran").exists()
    assert main([*words, "--allow-code"]) == 2
    assert "here it ends" in capsys.readouterr().err
    assert (tmp_path / "ran").exists()


def test_an_fmu_named_in_a_file_runs_with_consent_only(tmp_path, capsys):
    file = tmp_path / "file.toml"
    file.write_text('against = "none.fmu"\n')
    assert main(["mpc", str(file)]) == 2
    assert "--allow-code" in capsys.readouterr().err
    assert main(["mpc", str(file), "--allow-code"]) == 2
    assert "--allow-code" not in capsys.readouterr().err


def test_a_plant_that_takes_no_feed_has_no_ladder(tmp_path, capsys):
    (tmp_path / "mine.py").write_text("def load(muscle): ...\n")
    file = tmp_path / "study.toml"
    file.write_text(TABLE)
    assert main(["ladder", str(file), "--allow-code"]) == 2
    assert "muscle, feed= and losses=" in capsys.readouterr().err
