"""The messages that docs/faq.md quotes are those that people meet: each is provoked here."""

import re
import warnings
from pathlib import Path

import pytest

import pam_ocp as pam
from pam_ocp.cli.main import main

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "faq.md").read_text("utf-8")
QUOTED = re.findall(r'\*\*"(.*?)"(?: \(.*?\))?\*\*', PAGE)
TABLE = "pressure [bar],contraction [%],force [N]\n"


def table(text, **words):
    Path("t.csv").write_text(text)
    return pam.read_table("t.csv", **words)


def load(**words):
    return pam.HangingLoad("DMSP-20-300", **{"mass": 5.0, **words})


def slide():
    return pam.AntagonisticSlide("DMSP-20-300", mass=2.0, pre_contraction=0.10)


def few():
    return table(TABLE + "1,0,10\n2,0,300\n3,0,560\n2,5,130\n")


def predict(pressure, contraction):
    fit = pam.fit_force(pam.read_table("DMSP-20-300_static.csv", rest_length=0.300))
    return fit.predict(pressure, contraction)


def plan(**words):
    return pam.plan(slide(), [{"x": -0.010}, {"x": 0.010}], **words)


def problem_with_code():
    Path("p.toml").write_text(
        '[plant]\narrangement = "mine.py:Plant"\nmuscle = "DMSP-20-300"\n[[stops]]\nx = 0\n'
    )
    Path("mine.py").write_text("")
    main(["plan", "p.toml"])


PROVOKED = [
    ("has no column for", lambda: table("foo,bar,baz\n1,2,3\n2,3,4\n")),
    ("holds lengths", lambda: table(TABLE.replace("contraction [%]", "length [mm]") + "1,300,9\n")),
    ("if it is absolute", lambda: table(TABLE + "1.013,0,0\n2,0,300\n3,0,560\n")),
    ("rows dropped", lambda: table(TABLE + "1,0,10\n2,0,\n3,0,560\n")),
    ("must be within", lambda: pam.muscle("DMSP-20-300").law.tension(3e5, 10)),
    ("far from any", lambda: predict(3, 0.10)),
    ("taut cells", lambda: pam.fit_force(few())),
    ("outside of the data", lambda: predict(3e5, 0.30)),
    ("outside the stroke", lambda: pam.plan(slide(), [{"x": -0.1}, {"x": 0.1}])),
    ("no plan found", lambda: plan(duration=0.02, method=pam.Collocation(10, 3))),
    ("not verified", lambda: plan(method=pam.Collocation(2, 2), tolerance=None)),
    ("unknown variable", lambda: pam.simulate(load(), {"muscle.comand": 3e5}, duration=0.1)),
    ("has no argument", lambda: plan(minimize="time")),
    ("no equilibrium", lambda: load(mass=500.0).equilibrium(x=0.02)),
    ("sample_time", lambda: pam.lqr(load(), load().equilibrium(x=0.04), sample_time=0.5)),
    ("would run", problem_with_code),
    (
        "former version",
        lambda: pam.load_plan(ROOT / "tests" / "versions" / "0.2" / "plan.npz", slide()),
    ),
]
BY_OTHERS = {"no C compiler works here", "... needs ..., which is not installed"}
"""Shown by tests of exports and of the wheel, in places where things are missing."""


@pytest.mark.parametrize(("words", "call"), PROVOKED, ids=[words for words, _ in PROVOKED])
def test_a_message_that_is_quoted_is_what_people_see(words, call, tmp_path, monkeypatch, capsys):
    (quote,) = [q for q in QUOTED if words in q]
    monkeypatch.chdir(tmp_path)
    seen = ""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            call()
        except (pam.PamError, TypeError) as error:
            seen = str(error)
    seen += "\n".join(str(one.message) for one in told) + capsys.readouterr().err
    pattern = ".*".join(re.escape(part.strip()) for part in quote.split("..."))
    assert re.search(pattern, seen, re.S), seen


def test_every_quoted_message_is_provoked():
    left = [q for q in QUOTED if q not in BY_OTHERS and not any(w in q for w, _ in PROVOKED)]
    assert left == []
