"""What cannot be meant on the page: a sentence in its words each, by its jobs and fields. No
browser.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from pam_ocp.bench.elements import Number
from pam_ocp.bench.form import argument_rows
from pam_ocp.bench.jobs import control, data, export, motion, muscle, plant
from pam_ocp.bench.made import World, plant_of
from pam_ocp.bench.session import EMPTY, Session
from pam_ocp.bench.words import page_words
from pam_ocp.core.errors import PamError
from pam_ocp.plants.kinds import LOSSES

CATALOGUE = {"kind": "catalogue", "name": "DMSP-20-300", "rest_length": None}
STATE = {**EMPTY, "muscle": CATALOGUE, "plant": {"arrangement": "AntagonisticSlide"}}
STATE |= {"point": {"x": 0.0, "muscle1.pressure": 3e5}}
TABLE = b"p [bar],contraction [%],F [N]\n1,1,10\n2,2,20\n3,3,10\n"
LENGTHS = TABLE.replace(b"contraction [%]", b"length [mm]").replace(b",1,", b",300,")
RECORD = b"t [s],q [mm]\n0,1\n1,2\n2,3\n"
MASS = Number("Mass", "kg", 0.0, 1e3)
FMU = {"id": "e1", "fmi": "2.0", "step_size": 0.01, "platforms": "native", "motion": ""}
Call = Callable[[Session], Any]


def say(*words: Any) -> None:
    return None


def world(session: Session, **parts: Any) -> World:
    return World(session.folder, {**STATE, **parts}, allow_code=True)


def dropped(session: Session, name: str, content: bytes, **said: Any) -> dict[str, Any]:
    return {"name": name, "file": session.store(name, content), "said": said}


def reads(name: str, content: bytes, **said: Any) -> Call:
    def call(session: Session) -> None:
        seen = data.look_at(say, world(session), dropped(session, name, content, **said))
        raise PamError(seen["problem"])

    return call


def fits(law: str, content: bytes = TABLE, **fixed: float) -> Call:
    def call(session: Session) -> Any:
        said = {"table": dropped(session, "a.csv", content), "law": law, "fixed": fixed}
        return muscle.fit_law(say, world(session), said)

    return call


def reads_muscle(name: str, content: bytes) -> Call:
    return lambda s: muscle.read_muscle(say, world(s), s.store(name, content))


def builds(arrangement: str, **arguments: Any) -> Call:
    content = {"arrangement": arrangement, **arguments}
    return lambda s: plant.outline_of(say, world(s, plant=content))


def runs_code(text: bytes) -> Call:
    return lambda s: builds(f"{s.store('mine.py', text)}:plant")(s)


@cache
def slide() -> Any:
    return plant_of(World(Path(), STATE))


def plans(*at: float, **changes: Any) -> Call:
    said = {**motion.first_motion(slide(), "motions1", "Motion 1"), "method": "coarse"}
    for stop, place in zip(said["stops"], at, strict=False):
        stop["at"] = place
    return lambda s: motion.planned(say, world(s), {**said, **changes})


def controls(kind: str, gains: Any = (), study: Any = (), state: Any = (), **changes: Any) -> Call:
    def call(session: Session) -> Any:
        said = control.first_controller(slide(), STATE["point"], kind, "controllers1")
        said["gains"].update(gains)
        said["study"].update({"duration": 0.05, **dict(study)})
        return control.closed(say, world(session, **dict(state)), {**said, **changes})

    return call


CALLS: dict[str, tuple[Call, str]] = {
    # ---- files -----------------------------------------------------------------------------------
    "a picture as a table": (reads("p.csv", b"\x89PNG\r\n\x1a\n" + bytes(99)), "is no text file"),
    "an empty file": (reads("e.csv", b""), "e.csv is empty: it needs a header"),
    "a letter": (reads("notes.txt", b"dear Anna\ntoday\n"), "notes.txt is empty, or no table"),
    "a text as a workbook": (reads("a.xlsx", b"hello"), "a.xlsx is empty, or no table"),
    "a broken MAT file": (reads("a.mat", b"MATLAB 5.0 MAT-file" + bytes(99)), "save it with -v7"),
    "a list as a table": (reads("a.json", b"[1,2]"), "a.json holds no table"),
    "words in cells": (
        reads("w.csv", TABLE.replace(b"20", b"viel")),
        "name it under Missing values if it marks a missing value",
    ),
    "force in bar": (
        reads("a.csv", TABLE, units={"force": "bar"}),
        "the unit of 'force' in Columns, 'bar', is no unit of a force",
    ),
    "a column that is not there": (
        reads("a.csv", TABLE, columns={"force": "Kraft"}),
        "unknown column 'Kraft': known: p [bar]",
    ),
    "too short a muscle": (reads("l.csv", LENGTHS, rest_length=-0.3), "Rest length = -0.3 m must"),
    "more lines left out than there are": (reads("a.csv", TABLE, skip=50), "a.csv is empty"),
    "time that goes back": (
        reads("t.csv", b"t [s],x [mm]\n0,1\n2,2\n1,3\n", clock="refuse"),
        "or cut there: 'cut at gaps' in the menu Clock",
    ),
    # ---- muscles and plants ----------------------------------------------------------------------
    "a fit of three cells": (fits("six-parameter"), "hold some with the fields Known constants"),
    "a fit of a record": (fits("six-parameter", RECORD), "a.csv is a record in time"),
    "an unknown law": (fits("six-paramter"), "did you mean 'six-parameter'?"),
    "a letter as a muscle": (reads_muscle("m.toml", b"hello"), "m.toml cannot be read"),
    "a table as a muscle": (reads_muscle("m.csv", TABLE), "a muscle file ends in .toml or .json"),
    "no muscle yet": (
        lambda s: plant.outline_of(say, world(s, muscle=None)),
        "choose or fit one in the tab Muscle",
    ),
    "no plant in the file": (runs_code(b"plant = 3\n"), "mine.py:plant is an int; give a Plant"),
    "a file that is no Python": (runs_code(b"plant = \n"), "mine.py, line 1: invalid syntax"),
    "a mass below 0": (builds("HangingLoad", mass=-2.0), "mass = -2 kg must be > 0"),
    "a pair's regulator for one": (
        builds("HangingLoad", feed={"kind": "PairRegulator"}),
        "feeds two muscles by one command",
    ),
    "rest half a metre away": (
        lambda s: plant.rest(say, world(s), {"x": 0.5, "muscle1.pressure": 3e5}),
        "x: the condition = 500 mm is outside -30 mm .. 30 mm",
    ),
    "a vibration of nothing": (lambda s: plant.vibration(say, world(s), 0.0, 9), "offset = 0"),
    "loads below 0": (lambda s: plant.loads(say, world(s), [-1.0], [3e5]), "masses = -1 kg must"),
    # ---- motions, controllers, exports -----------------------------------------------------------
    "stops beyond the stroke": (plans(-0.5, 0.5), "stop 1: x = -500 mm is outside the stroke"),
    "one stop twice": (plans(0.0, 0.0), "stops 1 and 2 are the same"),
    "nothing to minimise": (plans(minimise={"time": 0.0}), "give one of them a weight"),
    "crossed bounds": (
        plans(bounds=[{"name": "v", "low": 1.0, "high": -1.0}]),
        "the bounds are crossed; give (lower, upper)",
    ),
    "a leg of -1 s": (plans(durations=[-1.0]), "duration = -1 s must be > 0"),
    "a record of something else": (
        lambda s: motion.replayed(
            say,
            world(s),
            motion.first_motion(slide(), "motions1", "Motion 1") | {"method": "coarse"},
            dropped(s, "a.csv", TABLE),
        ),
        "a.csv is a force table, no record in time",
    ),
    "a sample time of 0": (controls("lqr", sample_time=0.0), "sample_time = 0 s must be > 0"),
    "noise below 0": (controls("lqr", study={"noise": -1.0}), "noise['x'] = -1 m must be >= 0"),
    "a step of 5 m": (controls("lqr", study={"step": 5.0}), "x: reference = 5000 mm is outside"),
    "no operating point": (controls("lqr", state={"point": {}}), "choose one in the tab Plant"),
    "a horizon of 0": (controls("mpc", gains={"horizon": 0}), "horizon = 0: give a whole number"),
    "an FMU by steps of 0": (
        lambda s: export.fmu(say, world(s), {**FMU, "step_size": 0.0}),
        "step_size = 0 s must be > 0",
    ),
    "an SSP without a motion": (
        lambda s: export.ssp(say, world(s), FMU),
        "plan one in the tab Motion",
    ),
    # ---- fields ----------------------------------------------------------------------------------
    "a word for a number": (lambda s: MASS.read("heavy", "kg"), "Mass = 'heavy' is not a number"),
    "a pressure for a mass": (lambda s: MASS.read("3 bar", "kg"), "something else than 'kg'"),
    "below the range": (lambda s: MASS.read("-3", "kg"), "Mass = -3 kg: give 0 kg .. 1000 kg"),
    "no number": (lambda s: MASS.read("nan", "kg"), "Mass = nan: give a finite number"),
    "nothing": (lambda s: MASS.read("", "kg"), "Mass is empty; give a number"),
    "two commas": (lambda s: MASS.read("1,000,5", "kg"), "is not a number; give a number with"),
}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    made = Session.new(tmp_path_factory.mktemp("absurd"))
    yield made
    made.close()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("label", CALLS)
def test_it_is_answered_in_the_words_of_the_page(label, session):
    call, words = CALLS[label]
    with pytest.raises(PamError) as caught:
        call(session)
    said = page_words(str(caught.value), session.folder, session.names)
    assert words in said
    assert "\n" not in said
    assert str(session.folder) not in said
    assert "NoneType" not in said
    assert not (session.folder / "exports").exists() or not any(
        (session.folder / "exports").iterdir()
    )


# ---- what is meant, however it is typed ----------------------------------------------------------
@pytest.mark.parametrize(
    ("typed", "unit", "found"),
    [
        ("-3,5", "bar", -3.5e5),
        ("\u22123,5", "kPa", -3.5e3),  # as typesetters write it
        (" \u22123.5\u00a0kPa ", "bar", -3.5e3),
        ("3,5 Bar", "psi", 3.5e5),
    ],
)
def test_a_number_is_read_in_the_unit_beside_it_or_in_its_own(typed, unit, found):
    assert Number("Pressure", "Pa").read(typed, unit) == pytest.approx(found, rel=1e-14)


@pytest.mark.parametrize(
    ("kind", "name", "typed", "found"),
    [
        ("MaxwellSlip", "yield contraction", "0.002, 0.01", [0.002, 0.01]),
        ("MaxwellSlip", "yield contraction", "0,002; 0,01", [0.002, 0.01]),
        ("MaxwellSlip", "yield contraction", "0.2 %", [0.002]),
        ("PrandtlIshlinskii", "contracting [N]", "6, 5e-3 kN", [6.0, 5.0]),
    ],
)
def test_several_numbers_are_read_as_they_are_shown(kind, name, typed, found):
    said: dict[str, Any] = {}
    rows = argument_rows(LOSSES, kind, {}, said.__setitem__, turning=False)
    ((_, shown, act),) = [row for row in rows if row[0].label == name]
    act(shown)
    (argument,) = said
    assert said[argument] == pytest.approx(LOSSES.arguments(kind)[argument].default)
    act(typed)
    assert said[argument] == pytest.approx(found)
    for wrong in ("", "nan", "1, x", "3 bar"):
        with pytest.raises(PamError):
            act(wrong)


def test_digits_of_a_number_are_no_name_of_a_stored_file():
    assert page_words("v = -3.2311742677852644e-26 m/s", Path("/b"), {}).endswith("52644e-26 m/s")
