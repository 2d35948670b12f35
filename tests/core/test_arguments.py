"""An argument of the wrong kind is named, whatever depth its call fails in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.core.errors import blamed, with_kinds


def slide() -> pam.Plant:
    return pam.AntagonisticSlide("DMSP-20-200N")


def motion() -> pam.Trajectory:
    return pam.simulate(slide(), duration=0.01)


CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "inputs": (lambda: pam.linearize(slide(), inputs=3), "a sequence of texts"),  # type: ignore
    "outputs": (lambda: pam.fit_plant(slide(), motion(), ["mass"], outputs=2.0), "sequence"),  # type: ignore
    "units": (lambda: pam.read_table("DMSP-20-300_static.csv", units=True), "mapping"),  # type: ignore
    "cases": (lambda: pam.simulate_many(slide(), None, duration=0.1), "sequence"),  # type: ignore
    "path": (lambda: pam.plants.save_plant(slide(), None), "a text"),  # type: ignore
    "unit": (lambda: pam.Variable("x", "state", unit=3), "a text"),  # type: ignore
    "columns": (lambda: pam.Trajectory([0.0, 1.0], 3), "a mapping"),  # type: ignore
    "variables": (lambda: pam.Trajectory([0.0], {"x": [1.0]}, ["x"]), "Variable"),  # type: ignore
}


@pytest.mark.parametrize("name", CALLS)
def test_the_argument_is_named_with_what_it_takes(name: str) -> None:
    call, kind = CALLS[name]
    refused(f"^{name} = .*: give .*{kind}", call)


@with_kinds
def called(
    number: float,
    names: Sequence[str] | None = None,
    way: Literal["up", "down"] = "up",
    act: Callable[[], Any] | None = None,
    **more: Any,
) -> Any:
    if act is not None:
        return act()
    raise TypeError("something deep")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"number": []}, r"number = \[\]: give a number"),
        ({"number": 1, "names": 3}, "names = 3: give a sequence of texts or None"),
        ({"number": 1, "names": [3]}, r"names = \[3\]: give a sequence of texts or None"),
        ({"number": 1, "way": "left"}, "way = 'left': give 'up' or 'down'"),
        ({"number": 1, "act": "x"}, "act = 'x': give a function or None"),
    ],
)
def test_each_kind_of_hint_in_words(given: Mapping[str, Any], said: str) -> None:
    refused(said, called, **given)


def fails() -> None:
    raise KeyError("mine")


@pytest.mark.parametrize(
    "given",
    [
        {"number": 1},
        {"number": "3 bar", "names": ("a", "b")},
        {"number": np.float32(1), "names": np.array(["a"]), "more": object()},
        {"number": np.array(1.0), "names": iter("ab")},
    ],
)
def test_errors_of_calls_with_the_right_kinds_are_as_they_are(given: Mapping[str, Any]) -> None:
    refused("something deep", called, error=TypeError, **given)
    refused("mine", called, error=KeyError, **given, act=fails)


def test_what_works_is_not_refused() -> None:
    assert called([], names=3, act=lambda: "done") == "done"  # type: ignore[arg-type]


def test_errors_of_ours_and_missing_arguments_are_not_touched() -> None:
    own = pam.InputError("ours")
    assert blamed(called, ([],), {}, own) is own
    with pytest.raises(TypeError, match="missing 1 required"):
        called()  # type: ignore[call-arg]


def test_an_expression_is_no_component() -> None:
    with pytest.raises(pam.InputError, match=r"losses holds SX\(a\): give components"):
        pam.HangingLoad("DMSP-20-300", losses=ca.SX.sym("a"))  # type: ignore[arg-type]


def test_a_long_value_is_cut_in_the_sentence() -> None:
    with pytest.raises(pam.InputError) as caught:
        pam.muscle("x" * 10_000)
    assert len(str(caught.value)) < 500
