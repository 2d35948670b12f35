"""Commands that cannot be meant: exit code 2, one sentence of our own, nothing written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from cli_tools import run

PLANT = '[plant]\narrangement = "AntagonisticSlide"\nmuscle = "DMSP-20-200N"\n'
STOPS = '[[stops]]\nx = "-10 mm"\n[[stops]]\nx = "10 mm"\n'
FILES = {
    "empty.csv": "",
    "notes.txt": "hello\n",
    "broken.toml": "[plant\n",
    "list.json": "[1, 2]",
    "afile": "",
    "words.csv": "pressure [bar],contraction [%],force [N]\n1,1,viel\n2,2,20\n3,3,10\n",
    "record.csv": "t [s],x [mm],muscle_command [bar]\n0,1,3\n0.01,2,3\n0.02,3,4\n0.03,3,4\n",
    "back.csv": "t [s],x [mm],muscle_command [bar]\n0,1,3\n0.02,2,3\n0.01,3,4\n0.03,3,4\n",
    "lengths.csv": "pressure [bar],length [mm],force [N]\n1,300,10\n2,290,20\n3,280,10\n",
    "study.toml": '[steps.a]\nkind = "muscle"\nname = "DMSP-20-300"\n',
    "kind.toml": '[steps.a]\nkind = "musle"\n',
    "plan.toml": PLANT + STOPS,
    "one.toml": PLANT + '[[stops]]\nx = "-10 mm"\n',
    "typo.toml": 'minimize = "time"\n' + PLANT + STOPS,
    "unit.toml": PLANT + STOPS.replace("10 mm", "10 bar"),
    "far.toml": PLANT + STOPS.replace("10 mm", "10 cm"),
    "bare.toml": '[plant]\narrangement = "HangingLoad"\n' + STOPS,
    "rig.toml": '[driver]\nkind = "modbuss"\n',
    "faults.toml": '[[fault]]\nkind = "stuckk"\n',
    "mine.py": "plant = 3\n",
    "bad.py": "plant = \n",
}
FIT = "fit DMSP-20-300_static.csv --rest-length 0.3"
FORCES = "fit-forces DMSP-20-300_static.csv"
LOAD = "simulate HangingLoad --duration 1s"
COMMANDS = {
    # ---- measured files --------------------------------------------------------------------------
    "fit notes.txt --rest-length 0.3": "no table: it needs a header and at least one row",
    "fit words.csv": "say --missing ... if it marks a missing value, or leave such rows out with "
    "--bad-lines drop",
    "fit record.csv": "--columns 'pressure=muscle_command [bar]'",
    "fit lengths.csv": "give --rest-length, as --rest-length '300 mm'",
    "fit lengths.csv --rest-length 300": "far too short for the rest length 300 m",
    "fit nowhere.csv --rest-length 0.3": "nowhere.csv",
    "fit DMSP-10-250_static.csv --rest-length 0.2": "rest",
    "fit DMSP-20-300_static.csv --rest-length '3 bar'": "--rest-length = '3 bar'",
    f"{FIT} --diameter '20 bar'": "--diameter = '20 bar': this measures something else than 'm'",
    f"{FIT} --fixed a9=1": "did you mean 'a6'",
    f"{FIT} --fixed a1=1 a1=2": "--fixed a1=2: a1 is given twice",
    f"{FIT} --fixed a1": "--fixed a1: give NAME=VALUE",
    f"{FIT} --loss cauchy": "choose 'squares', 'huber', 'l1' or 'bisquare'",
    f"{FIT} --branches": "the table has no branches",
    f"{FIT} --out m.csv": "m.csv: a muscle file ends in .toml or .json",
    f"{FIT} --ssv m.txt": "the name of a set of parameters ends in .ssv",
    f"{FIT} --muscles muscle1": "give --ssv, the file for it",
    f"{FIT} --floor ' -5 N'": "floor = -5 N must be >= 0",
    f"{FIT} --skip two": "argument --skip: 'two' is no whole number",
    f"{FIT} --time-limit soon": "argument --time-limit: the time = 'soon' is not a number",
    f"{FIT} --units force=bar": "give a calibration: --units 'force=bar * 2 N/bar - 0.3 N'",
    f"{FIT} --law polynomial-99-1": "gain_degree = 99: give a whole number from 0 to 12",
    f"{FIT} --law spline-3:a,b": "give numbers behind the colon",
    f"{FIT} --law six-paramter": "six-parameter",
    f"{FIT} --plot a.docx": "--plot a.docx: give a name that ends in .png",
    f"{FIT} --excel a.ods": "--excel a.ods: give a name that ends in .xlsx",
    f"{FIT} --excel none/a.xlsx": "the folder none does not exist",
    f"{FIT} --restlength 0.3": "--restlength 0.3; did you mean --rest-length?",
    "look record.csv --max-gap x": "argument --max-gap: 'x' is no number",
    "look record.csv --sample-time 0": "sample_time = 0 s must be > 0",
    "campaign nowhere": "no table of a campaign could be read",
    "fit-forces none.csv": "unknown table file 'none.csv'",
    f"{FORCES} DMSP-20-300_static.csv --rest-length 0.3": "a second table of the name",
    f"{FORCES} --rest-length 0.3 --law six": "unknown force law 'six'",
    f"{FORCES} --rest-length 0.3 --shared a9": "give at least two",
    f"{FORCES} --rest-length 'A=3 kg'": "something else than 'm'",
    f"{FORCES} --rest-length B=0.3": "give --rest-length",
    "fit-holds --plant HangingLod record.csv --estimate mass": "did you mean 'HangingLoad'?",
    "fit-plant --plant HangingLoad record.csv": "--free is missing",
    "fit-plant --plant HangingLoad back.csv --free mass": "time runs backwards in row 3 (line 4)",
    "ladder record.csv --free mass": "record.csv cannot be read as a TOML file",
    # ---- plants and motions ----------------------------------------------------------------------
    "export hanging_load --out h.zip": "the name of an FMU ends in .fmu",
    "export hanging_load --platform win64": "unknown platform 'win64'",
    "export hanging_lod": "HangingLoad",
    "export hanging_load --muscle DMSP-20-40N": "DMSP-20-400N",
    "export hanging_load --set mass": "--set mass: give NAME=VALUE",
    "export hanging_load --set mass=-1": "outside",
    "export hanging_load --set mas=1": "mass",
    "export hanging_load --set 'mass=3 bar'": "this measures something else than 'kg'",
    "export mine.py:plant --allow-code": "mine.py:plant is an int; give a Plant",
    "export bad.py:plant --allow-code": "bad.py, line 1: invalid syntax; mend it there",
    "export notes.txt": "notes.txt is a table or record, no plant",
    "check .": ".: a folder, no FMU",
    "check nowhere.fmu": "no such file",
    "check mine.py": "FMU",
    "muscles show": "give the NAME",
    "muscles show DMSP-20-300 --plot a.txt": "ends in .png",
    "loads --muscle DMSP-20-30": "did you mean 'DMSP-20-300'",
    "loads --masses -5": "masses = -5 kg must be > 0",
    "loads --masses heavy": "--masses = 'heavy' is not a number",
    "loads --masses '5 bar'": "something else",
    "components lod": "did you mean 'load'?",
    "simulate HangingLoad": "give --duration, such as --duration '500 ms', or --inputs FILE",
    "simulate HangingLoad --duration 0": "--duration = 0 s must be > 0",
    "simulate HangingLoad --duration '3 bar'": "something else than 's'",
    "simulate HangingLoad --durration 1s": "--durration 1s; did you mean --duration?",
    "simulate HangingLoad --inputs words.csv": "words.csv has no column for the time",
    f"{LOAD} --samples 1": "--samples = 1: give a whole number from 2",
    f"{LOAD} --rtol 0": "rtol = 0 must be > 0",
    f"{LOAD} --input muscle.comand=3bar": "did you mean 'muscle.command'?",
    f"{LOAD} --input muscle.command=3kg": "this measures something else than 'Pa'",
    f"{LOAD} --rest x=5m": "did you mean 5 mm",
    f"{LOAD} --input mass=3": "not an input",
    f"{LOAD} --out x.docx": "x.docx: a trajectory is written as one of .csv, .npz",
    f"{LOAD} --out none/m.csv": "the folder none does not exist; create it first",
    "compare record.csv nowhere.csv": "nowhere.csv: no such file",
    "compare record.csv record.csv --tolerance -1": "--tolerance = -1 must be >= 0",
    "linearize HangingLoad --rest x=0.03 --out l.csv": "matrices are written as .json",
    "linearize HangingLoad --rest 'x=2 m'": "0 mm .. 78 mm",
    "linearize HangingLoad --rest x=0.03 --outputs forc": "did you mean 'muscle.force'?",
    "report plan.toml --crate c.zip": "licence is missing: give an SPDX identifier",
    "report plan.toml --out r.pdf": "the name of a report ends in .html",
    # ---- plans, loops, studies, rigs -------------------------------------------------------------
    "plan one.toml": "one.toml: stops holds 1: a motion needs at least two stops",
    "plan typo.toml": "unknown key of the problem 'minimize': did you mean 'minimise'?",
    "plan unit.toml": "this measures something else than 'm'",
    "plan far.toml": "stop 1: x = -100 mm is outside the stroke",
    "plan bare.toml": "plant.muscle is missing: give a name of the catalogue",
    "plan plan.toml --animate a.mp4": "--animate a.mp4: give a name that ends in .gif",
    "plan plan.toml --time-limit 0": "time_limit = 0 s must be > 0",
    "mpc --out m.docx": "--out m.docx: a trajectory is written as one of .csv, .npz",
    "mpc --estimator kalmann": "did you mean 'kalman'?",
    "mpc --seed -1": "seed = -1: give a whole number >= 0",
    "mpc none.toml": "none.toml",
    "mpc --set 'mass=3 mm'": "something else than 'kg'",
    "mpc --set mass": "--set mass: give NAME=VALUE",
    "mpc --real mass": "NAME=VALUE",
    "mpc --real masse=3": "did you mean",
    "mpc --duration '2 kg'": "something else than 's'",
    "mpc --duration -1": "duration",
    "mpc --against nowhere.fmu": "nowhere.fmu: no such FMU",
    "study kind.toml": "unknown steps.a.kind 'musle': did you mean 'muscle'?",
    "study study.toml --shard 3/2": "give K/N with K from 1 to N",
    "study study.toml --cache afile": "afile is a file; give the name of a folder",
    "study none.toml": "none.toml",
    "study .": ".",
    "study study.toml --workers 0": "workers",
    "study study.toml --out study.toml/x": "study.toml",
    "tour --out afile": "afile is a file; give the name of a folder",
    "rig run rig.toml": "look that nobody is near, and give --arm",
    "rig check rig.toml": "did you mean 'modbus'?",
    "twin HangingLoad --udp 99999": "port = 99999: give a whole number from 0 to 65535",
    "twin HangingLoad --udp port": "argument --udp: 'port' is no whole number",
    "twin HangingLoad --udp 0 --noise y=1": "unknown reading of the twin 'y'",
    "twin HangingLoad --udp 0 --faults faults.toml": "did you mean 'stuck'?",
    "bench --port 99999": "port = 99999: give a whole number from 0 to 65535",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("absurd")
    for name, text in FILES.items():
        (place / name).write_text(text)
    return place


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("command", COMMANDS)
def test_it_is_refused_in_one_sentence(command, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    try:
        code, out, err = run(capsys, "", *shlex.split(command))
    except SystemExit as ended:  # of argparse, which prints the usage before
        said = capsys.readouterr()
        code, out, err = ended.code, said.out, said.err
        err = err.splitlines()[-1] + "\n"
    assert (code, out) == (2, "")
    assert COMMANDS[command] in err
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert {p.name for p in folder.iterdir()} == FILES.keys()
