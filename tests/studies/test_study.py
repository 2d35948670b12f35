"""Studies: what runs, what is kept, what is refused before anything runs."""

import csv
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path

import pytest
from conftest import refused
from fmpy.ssp.simulation import simulate_ssp

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.studies import run_study
from pam_ocp.studies.study import work
from pam_ocp.studies.study_file import read_study

STUDY = """
title = "A load on a muscle"
text = "What it says <b>here</b> is text."

[steps.static]
kind = "table"
file = "mine.csv"
rest_length = "300 mm"

[steps.law]
kind = "fit"
table = "static"
law = "three-element"

[steps.load]
kind = "plant"
arrangement = "HangingLoad"
muscle = "law"
mass = "10 kg"

[steps.lifted]
kind = "simulate"
plant = "load"
inputs = { "muscle.command" = "3 bar" }
duration = "50 ms"
samples = 11

[steps.linear]
kind = "linearize"
plant = "load"
rest = { "muscle.pressure" = "1 bar" }

[steps.again]
kind = "simulate"
plant = "load"
inputs = "lifted"

[steps.same]
kind = "compare"
reference = "lifted"
other = "again"
tolerance = 1e-6

[steps.heavier]
kind = "sweep"
of = "lifted"
vary = { "load.mass" = ["5 kg", "8 kg"] }
numbers = ["x.last"]
"""
TABLE = "pressure [bar],contraction [%],force [N]\n" + "".join(
    f"{p},{k},{100 * p * (3 * (1 - k / 100) ** 2 - 1) + 2 * k - 40}\n"
    for p in (1, 2, 3, 4, 5)
    for k in (0, 5, 10, 15, 20)
)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A folder in which the study ran once."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "mine.csv").write_text(TABLE)
    (folder / "study.toml").write_text(STUDY)
    assert run(folder).ok
    return folder


@pytest.fixture
def place(done, tmp_path):
    """A copy of it, with all that it wrote and kept."""
    shutil.copytree(done, tmp_path, dirs_exist_ok=True)
    return tmp_path


@pytest.fixture
def fresh(tmp_path):
    """A folder in which nothing ran."""
    (tmp_path / "mine.csv").write_text(TABLE)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


def run(place, **options):
    return run_study(place / "study.toml", place / "out", cache=place / "cache", **options)


def states(result):
    return {n: s.state for n, s in result.steps.items()}


def tables(folder):
    endings = (".csv", ".toml", ".npz", ".xlsx", ".png")  # what holds no time that it took
    found = {p.relative_to(folder): p for p in folder.rglob("*") if p.suffix in endings}
    return {n: p.read_bytes() for n, p in found.items()}


def changed(place, old, new, file="study.toml"):
    text = (place / file).read_text()
    assert old in text
    (place / file).write_text(text.replace(old, new))


@pytest.mark.usefixtures("plain_pictures")
def test_a_second_run_does_nothing_and_a_change_runs_what_stands_on_it(place):
    before = tables(place / "out")
    assert before
    met = states(run(place))
    assert next(iter(met)) == "static"
    assert set(met.values()) == {"kept"}
    assert tables(place / "out") == before
    changed(place, 'mass = "10 kg"', 'mass = "12 kg"')
    # the sweep sets the mass itself; its cases are what they were
    met = states(run(place))
    assert {n for n, s in met.items() if s == "done"} == {*BEHIND_THE_LOAD, "load"}
    changed(place, 'mass = "12 kg"', 'mass = "12.0 kg"')  # the same plant in other words
    changed(place, 'title = "A load', 'title = "Another load')
    met = states(run(place))
    assert met["load"] == "done"
    assert met["same"] == "kept"  # it stands on motions that came out as before


BEHIND_THE_LOAD = ("lifted", "linear", "again", "same")


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_other_measurements_run_all_and_another_order_of_keys_nothing(place):
    changed(
        place,
        'file = "mine.csv"\nrest_length = "300 mm"',
        'rest_length = "300 mm"\nfile = "mine.csv"',
    )
    assert set(states(run(place)).values()) == {"kept"}
    changed(place, "5,20,", "5,21,", "mine.csv")
    assert "kept" not in states(run(place)).values()


def test_the_numbers_are_those_of_the_same_steps_in_python(place):
    result = run(place)
    table = pam.read_table(place / "mine.csv", rest_length=0.3)
    muscle = pam.fit_force(table, "three-element").muscle()
    plant = pam.HangingLoad(muscle, mass=10.0)
    t = [0.005 * i for i in range(11)]
    motion = pam.simulate(plant, {"muscle.command": 3e5}, t=t, rtol=1e-8)
    assert result["lifted"].numbers["x.last"][0] == pytest.approx(motion["x"][-1], rel=1e-9)
    rows = list(csv.reader((place / "out" / "heavier" / "sweep.csv").open()))
    assert rows[0] == ["load.mass", "x.last [m]"]
    lighter = pam.simulate(plant.with_values(mass=5.0), {"muscle.command": 3e5}, t=t, rtol=1e-8)
    assert float(rows[1][1]) == pytest.approx(lighter["x"][-1], rel=1e-9)
    assert rows[2][0] == "8 kg"
    written = pam.load_muscle(place / "out" / "law" / "muscle.toml")
    assert written.law.values == muscle.law.values
    plant_file = str(place / "out" / "load" / "plant.toml")
    assert main(["simulate", plant_file, "--duration", "5 ms", "-q"]) == 0


@pytest.mark.slow
def test_workers_and_executors_give_the_same_bits(place, request):
    before = tables(place / "out")
    assert set(states(run(place, fresh=True, workers=2)).values()) == {"done"}
    assert tables(place / "out") == before
    request.getfixturevalue("plain_pictures")  # those of workers were compared
    result = run(place, fresh=True, executor=ThreadPoolExecutor(2))
    assert set(states(result).values()) == {"done"}
    after = tables(place / "out")
    assert set(after) == set(before)
    assert all(after[n] == before[n] for n in before if n.suffix != ".png")
    refused("not both", run, place, workers=2, executor=ThreadPoolExecutor(2))


def once_lethal(*job):
    """A step's work, but for the first worker that comes to one of them."""
    mark = Path(os.environ["PAM_ONCE"])
    if job[0].name == "lifted" and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return work(*job)


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="workers are forked there")
def test_a_step_whose_worker_is_lost_is_done_once_more(place, tmp_path, monkeypatch):
    monkeypatch.setenv("PAM_ONCE", str(tmp_path / "once"))
    monkeypatch.setattr("pam_ocp.studies.study.work", once_lethal)
    result = run(place, fresh=True, executor=2)
    assert (tmp_path / "once").exists()
    assert set(states(result).values()) == {"done"}


@pytest.mark.usefixtures("plain_pictures")
def test_a_step_that_fails_ends_what_stands_on_it_and_nothing_else(place):
    changed(place, '"muscle.pressure" = "1 bar"', 'x = "290 mm"')  # no pressure holds it there
    result = run(place)
    assert not result.ok
    assert result["linear"].state == "failed"
    assert {n for n, s in result.steps.items() if s.state in ("failed", "left out")} == {"linear"}
    page = (place / "out" / "report.html").read_text()
    assert "Not all is well" in page
    changed(place, 'law = "three-element"', 'law = "three-element"\nfixed = { c1 = 0.0 }')
    refused("fixed: coefficient", run, place)


def test_what_no_step_writes_any_more_goes_unless_it_was_changed(place):
    out = place / "out"
    (out / "linear" / "poles.csv").write_text("mine")
    text = (place / "study.toml").read_text()
    begin = text.index("[steps.linear]")
    (place / "study.toml").write_text(text[:begin] + text[text.index("[steps.again]") :])
    run(place)
    assert not (out / "linear" / "linear.json").exists()
    assert (out / "linear" / "poles.csv").read_text() == "mine"


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.sources, self.links, self.ids, self.tags = [], [], set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        said = dict(attrs)
        self.tags.append(tag)
        self.ids.add(said.get("id"))
        if tag == "img":
            self.sources.append(said["src"])
        if tag == "a":
            self.links.append(said["href"])


def test_the_report_is_one_page_that_tells_all_and_loads_nothing(place):
    result = run(place)
    text = result.report.read_text("utf-8")
    page = Page(text)
    assert page.sources
    assert all(s.startswith("data:image/png;base64,") for s in page.sources)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert "&lt;b&gt;here" in text
    for link in page.links:
        inside = link.startswith("#") and link[1:] in page.ids
        assert inside or (place / "out" / link).is_file()
    for heading in ("measured", "assumed", "fitted", "computed", "verified"):
        assert f"What was {heading}" in text
    assert "How sure" in text
    assert "@media print" in text
    assert re.search(r"mine\.csv</td><td><code>[0-9a-f]{64}", text)
    assert f"pam_ocp {pam.__version__}" in text


KILLED = """
import sys
from pam_ocp.studies import run_study
if __name__ == "__main__":
    place = sys.argv[1]
    told = lambda step, i, n: print(step.name, flush=True)
    run_study(f"{place}/study.toml", f"{place}/out", cache=f"{place}/cache", progress=told)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no kill -9 there")
def test_a_killed_study_goes_on_where_it_was(done, fresh):
    place = fresh
    code = place / "run.py"
    code.write_text(KILLED)
    for steps in (1, 3, 0):
        with subprocess.Popen(
            [sys.executable, code, str(place)], stdout=subprocess.PIPE, text=True
        ) as process:
            for _ in range(steps):
                process.stdout.readline()
            time.sleep(0.05)
            process.send_signal(signal.SIGKILL)
    resumed = run(place)
    assert states(resumed)["static"] == "kept"
    assert resumed.ok
    assert tables(place / "out") == tables(done / "out")


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_what_is_kept_but_damaged_is_made_anew(place):
    for path in (place / "cache").rglob("output.pkl"):
        path.write_bytes(path.read_bytes()[:40])
    result = run(place)
    assert set(states(result).values()) == {"done"}
    assert result.ok


WRONG = {
    "circle": ('inputs = "lifted"', 'inputs = "again"', "go in a circle: again -> again"),
    "unknown step": ('plant = "load"\nrest', 'plant = "lod"\nrest', "did you mean 'load'"),
    "unknown muscle": ('muscle = "law"', 'muscle = "lav"', "or a step: law"),
    "a step of another kind": ('plant = "load"\nrest', 'plant = "law"\nrest', "makes no plant"),
    "unknown kind": ('kind = "fit"', 'kind = "fitt"', "did you mean 'fit'"),
    "no kind": ('kind = "fit"\n', "", "kind is missing"),
    "unknown key": ('law = "three-element"', 'lwa = "three-element"', "did you mean 'law'"),
    "unknown key of a plant": ('mass = "10 kg"', 'masse = "10 kg"', "did you mean 'mass'"),
    "unknown key of the study": ("title", "titel", "did you mean 'title'"),
    "missing key": ('file = "mine.csv"\n', "", "file is missing"),
    "wrong unit": ('mass = "10 kg"', 'mass = "10 mm"', "something else than 'kg'"),
    "wrong unit of time": ('"50 ms"', '"50 mm"', "something else than 's'"),
    "wrong unit in a sweep": ('["5 kg", "8 kg"]', '["5 kg", "1 bar"]', "something else than 'kg'"),
    "wrong unit of an input": ('"3 bar" }\ndur', '"3 kg" }\ndur', "something else than 'Pa'"),
    "missing file": ("mine.csv", "yours.csv", "unknown table file 'yours.csv'"),
    "unknown law": ('"three-element"', '"four-element"', "did you mean 'three-element'"),
    "unknown variable": ('"muscle.command"', '"muscle.comand"', "did you mean 'muscle.command'"),
    "unknown arrangement": ('"HangingLoad"', '"HangigLoad"', "did you mean 'HangingLoad'"),
    "a sweep of nothing": ('["5 kg", "8 kg"]', "[]", "give a list of values"),
    "a sweep of no step": ('of = "lifted"', 'of = "lift"', "did you mean 'lifted'"),
    "a sweep beside it": ('"load.mass"', '"linear.si"', "does not stand on linear"),
    "a sweep of no key": ('"load.mass"', '"load.mas"', "did you mean 'mass'"),
    "a number for a name": ('table = "static"', "table = 3", "unknown steps.law.table 3"),
    "no TOML": ("[steps.law]", "[steps.law", "cannot be read as a TOML file"),
    "two steps of a name": ("[steps.linear]", "[steps.law]", "cannot be read as a TOML file"),
    "a name of two words": ("[steps.linear]", '[steps."a b"]', "a step's name begins"),
    "code without consent": ('"HangingLoad"', '"mine.py:load"', "unknown key of plant"),
    "a tolerance with a unit": ("1e-6", '"1 bar"', "something else than a plain number"),
    "rest and start": (
        'duration = "50 ms"',
        'rest = {}\nstart = {}\nduration = "5 ms"',
        "give one",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_meant_is_one_sentence_before_anything_runs(fresh, capsys, name):
    place = fresh
    old, new, words = WRONG[name]
    changed(place, old, new)
    arguments = ["--out", str(place / "out"), "--cache", str(place / "cache")]
    assert main(["study", str(place / "study.toml"), *arguments]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert not [p for p in (place / "out").rglob("*") if p.is_file()]


CONTROLLED = """
[steps.load]
kind = "plant"
arrangement = "HangingLoad"
muscle = "DMSP-20-300"
mass = "10 kg"

[steps.pushed]
kind = "plant"
arrangement = "HangingLoad"
muscle = "DMSP-20-300"
mass = "10 kg"
loads = [{ kind = "ExternalForce", name = "push" }]

[steps.law]
kind = "controller"
plant = "load"
rest = { x = "40 mm" }
controller = { kind = "lqr", effort = 2.0, sample_time = "2 ms", integral = { x = 50.0 } }

[steps.ran]
kind = "loop"
plant = "load"
controller = "law"
against = "pushed"
start = { x = "40 mm" }
reference = { x = "43 mm" }
disturbances = { push = ["20 N", "100 ms"] }
duration = "0.2 s"
estimator = { kind = "none" }

[steps.inline]
kind = "loop"
plant = "load"
controller = { kind = "pid", proportional = 5e5, integral = 1e7, derivative = 1e4 }
start = { x = "40 mm" }
reference = { x = "41 mm" }
duration = "1.5 s"

[steps.source]
kind = "export-c"
controller = "law"
precision = "single"

[steps.unit]
kind = "export"
controller = "law"
fmi = "3.0"
platforms = ["native"]

[steps.system]
kind = "export-ssp"
plant = "load"
controller = "law"
platforms = ["native"]
connections = { "plant.muscle.command" = "controller.muscle.command", "controller.x" = "plant.x", \
"controller.v" = "plant.v", "controller.muscle.pressure" = "plant.muscle.pressure" }
hold = { "controller.wanted.x" = "43 mm", "controller.enable" = 1.0 }
"""


def controlled(tmp_path, old="", new=""):
    assert old in CONTROLLED
    path = tmp_path / "study.toml"
    path.write_text(CONTROLLED.replace(old, new, 1) if old else CONTROLLED, "utf-8")
    return path


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_controllers_run_and_leave_as_c_unit_and_system(tmp_path):
    result = run_study(controlled(tmp_path), tmp_path / "out", cache=tmp_path / "cache")
    assert result.ok, result
    muscle = pam.muscle("DMSP-20-300")
    plant = pam.HangingLoad(muscle, mass=10.0)
    pushed = pam.HangingLoad(muscle, mass=10.0, loads=[pam.loads.ExternalForce(name="push")])
    point = plant.equilibrium({"x": 0.04})
    law = pam.lqr(plant, point, effort=2.0, sample_time=2e-3, integral={"x": 50.0})
    start = {v.name: point[v.name] for v in (*plant.states, *plant.inputs)}
    told = {"reference": {"x": 0.043}, "disturbances": {"push": (20.0, 0.1)}, "start": start}
    own = pam.closed_loop(law, pushed, duration=0.2, **told)
    for kind, value in (("last", own["x"][-1]), ("max", own["x"].max())):
        assert result["ran"].numbers[f"x.{kind}"][0] == pytest.approx(value, rel=1e-9)
    pid = pam.control.PointPid(plant, point, 5e5, 1e7, 1e4)
    assert max(p.real for p in pid.poles) < -1.9
    # what is left of the step of 1 mm behind the slowest pole
    assert abs(result["inline"].numbers["x.last"][0] - 0.041) < 1.2e-3 * math.exp(-1.9 * 1.5)
    out = tmp_path / "out"
    assert "float" in next((out / "source" / "c").glob("*.h")).read_text()
    assert (out / "unit" / "plant.fmu").stat().st_size > 1000
    played = simulate_ssp(str(out / "system" / "system.ssp"), stop_time=3.0, step_size=2e-3)
    assert abs(played["plant.x"][-1] - 0.043) < 1e-6  # nothing but its integral gets it there
    # other gains are another controller to all that stands on it, and to nothing else
    changed = controlled(tmp_path, "effort = 2.0", "effort = 3.0")
    again = run_study(changed, out, cache=tmp_path / "cache")
    fresh = {n for n, s in again.steps.items() if s.state == "done"}
    assert fresh == {"law", "ran", "source", "unit", "system"}


WRONG_CELLS = ("200", "-1", "true", '"a"', "1.5")
WRONG_CONTROL = {
    "a kind": ('kind = "lqr"', 'kind = "lqg"', "unknown controller.kind 'lqg'"),
    "an argument": ("effort = 2.0", "efort = 2.0", "did you mean 'effort'"),
    "no rest": ('rest = { x = "40 mm" }', "", "rest is missing"),
    "an unknown state": ('rest = { x = "40 mm" }', 'rest = { y = "40 mm" }', "'y'"),
    "a push that the plant does not know": ('against = "pushed"', "", "'push'"),
    "against what": ('against = "pushed"', 'against = "psuhed"', "give 'plant', 'fmu', or"),
    "a motion as a controller": (
        'controller = "law"\nagainst',
        'controller = "inline"\nagainst',
        "law",
    ),
    "a precision": ('"single"', '"half"', "give 'double' or 'single'"),
    "both": ('controller = "law"\nfmi', 'plant = "load"\ncontroller = "law"\nfmi', "one of them"),
    "none": ('controller = "law"\nfmi', "fmi", "give plant or controller"),
    "outputs of a controller": ('fmi = "3.0"', 'fmi = "3.0"\noutputs = ["x"]', "is its own"),
    "no wires": ("connections = {", "# {", "connections is missing"),
    "a foreign component": ('"controller.x" = "plant.x"', '"controller.x" = "plnt.x"', "plnt.x"),
}


@pytest.mark.parametrize("name", WRONG_CONTROL)
def test_controllers_that_cannot_be_meant_are_told_before_anything_runs(tmp_path, name):
    old, new, sentence = WRONG_CONTROL[name]
    path = controlled(tmp_path, old, new)
    with pytest.raises(pam.InputError, match="study") as told:
        run_study(path, tmp_path / "out", cache=tmp_path / "cache")
    assert sentence in str(told.value)


@pytest.mark.parametrize(
    ("cells", "words"),
    [(f"[{c}]", "is no cell of the table; give whole numbers from 0") for c in WRONG_CELLS]
    + [(str(list(range(25))), "without names all 25 cells")],
)
def test_cells_that_are_not_there_cannot_be_left_out_and_some_cell_stays(fresh, cells, words):
    length = 'rest_length = "300 mm"'
    changed(fresh, length, f"{length}\nwithout = {cells}")
    refused(words, run, fresh)


@pytest.mark.usefixtures("plain_pictures")
def test_what_is_called_as_a_step_beside_the_study_is_no_part_of_it(fresh):
    """Nor does it matter that files come while a study runs."""
    place = fresh
    (place / "study.toml").write_text(STUDY[: STUDY.index("[steps.linear]")])
    (place / "load").mkdir()
    (place / "load" / "notes.txt").write_text("mine")
    seen = []

    def another(step, done, of):
        seen.append(step.name)
        (place / "load" / f"{step.name}.txt").write_text("came meanwhile")

    first = run(place, progress=another)
    assert first.ok
    assert len(seen) == len(first.steps)
    assert set(states(run(place)).values()) == {"kept"}


@pytest.mark.usefixtures("plain_pictures")
def test_the_command_tells_the_same_as_json_and_judges_by_its_exit_code(place, capsys):
    import json

    file, out, cache = (str(place / n) for n in ("study.toml", "out", "cache"))
    arguments = ["study", file, "--out", out, "--cache", cache]
    assert main([*arguments, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["ok"] is True
    assert said["steps"]["same"]["good"] is True
    assert said["written"] == [str(place / "out" / "report.html")]
    assert main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    changed(place, "tolerance = 1e-6", "tolerance = -1.0")
    assert main(arguments) == 1
    assert "✗ same" in capsys.readouterr().out


OWN = """
[steps.load]
kind = "plant"
arrangement = "mine.py:build"
muscle = "DMSP-20-300"

[steps.lifted]
kind = "simulate"
plant = "load"
inputs = { "muscle.command" = "3 bar" }
duration = "20 ms"
samples = 3
"""


def own_study(folder, builder):
    """A study with a plant of one's own, whose mass stands in a module that it imports."""
    (folder / "study.toml").write_text(OWN)
    (folder / "mine.py").write_text(builder)
    (folder / "weights_of_mine.py").write_text("MASS = 10.0\n")


def masses(folder):
    """What each step did, and the plant's mass as its file gives it now."""
    result = run(folder, allow_code=True)
    assert result.ok
    return states(result), result["lifted"].numbers["x.last"][0]


def lifted(mass):
    plant = pam.HangingLoad("DMSP-20-300", mass=mass)
    return pam.simulate(plant, {"muscle.command": 3e5}, t=[0.0, 0.01, 0.02], rtol=1e-8)["x"][-1]


@pytest.mark.parametrize(
    "builder",
    [
        "import pam_ocp as pam, weights_of_mine\n"
        "def build(muscle): return pam.HangingLoad(muscle, mass=weights_of_mine.MASS)\n",
        "import pam_ocp as pam\ndef build(muscle):\n    from weights_of_mine import MASS\n"
        "    return pam.HangingLoad(muscle, mass=MASS)\n",
    ],
    ids=["at its head", "within the function"],
)
@pytest.mark.usefixtures("plain_pictures")
def test_a_change_in_a_module_that_a_named_file_imports_is_seen(tmp_path, monkeypatch, builder):
    monkeypatch.syspath_prepend(tmp_path)
    own_study(tmp_path, builder)
    for mass, expected in ((10.0, "done"), (10.0, "kept"), (12.0, "done"), (10.0, "kept")):
        (tmp_path / "weights_of_mine.py").write_text(f"# a comment\nMASS = {mass}\n")
        met, x = masses(tmp_path)
        assert met == {"load": expected, "lifted": expected}
        assert x == pytest.approx(lifted(mass), rel=1e-9)
    with (tmp_path / "weights_of_mine.py").open("a") as file:
        file.write("\n# another comment\n")
    assert set(masses(tmp_path)[0].values()) == {"kept"}


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_a_file_that_own_code_names_is_seen_and_what_it_hides_is_done_anew(tmp_path, monkeypatch):
    own_study(
        tmp_path,
        "import pam_ocp as pam\nfrom pathlib import Path\n"
        f"MASS = Path({str(tmp_path)!r}) / 'mass.txt'\n"
        "def build(muscle): return pam.HangingLoad(muscle, mass=float(MASS.read_text()))\n",
    )
    for mass in (10.0, 12.0):
        (tmp_path / "mass.txt").write_text(str(mass))
        met, x = masses(tmp_path)
        assert set(met.values()) == {"done"}
        assert x == pytest.approx(lifted(mass), rel=1e-9)
    assert set(masses(tmp_path)[0].values()) == {"kept"}
    own_study(
        tmp_path,
        "import importlib, pam_ocp as pam\n"
        "def build(muscle):\n    weights = importlib.import_module('weights' + '_of_mine')\n"
        "    return pam.HangingLoad(muscle, mass=weights.MASS)\n",
    )
    monkeypatch.syspath_prepend(tmp_path)
    for mass in (10.0, 12.0, 12.0):
        (tmp_path / "weights_of_mine.py").write_text(f"MASS = {mass}\n")
        with pytest.warns(UserWarning, match=r"load: mine\.py imports what is named as it runs"):
            met, x = masses(tmp_path)
        assert set(met.values()) == {"done"}
        assert x == pytest.approx(lifted(mass), rel=1e-9)


def test_a_plant_file_that_names_code_is_followed(tmp_path):
    """Own code counts also where a file that the study names is what names it."""
    own_study(tmp_path, "import pam_ocp as pam\ndef build(muscle): return 10.0\n")
    (tmp_path / "plant.toml").write_text('arrangement = "mine.py:build"\n')
    (tmp_path / "study.toml").write_text(OWN.replace("mine.py:build", "plant.toml"))
    study = read_study(tmp_path / "study.toml")
    found = study.behind(study.entries["load"]).files
    assert {p.name for p in found} == {"plant.toml", "mine.py"}
