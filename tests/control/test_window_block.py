"""The moving-horizon estimator as a block: the estimator's own figures, and the same bits in C."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from c_program import Program, needs_compiler
from conftest import BAR, benchmark_slide

import pam_ocp as pam
from pam_ocp.control import BlockController, MovingHorizonEstimator, block, chain
from pam_ocp.export import check_fmu, export_fmu

STEP = 5e-3
NOISE = {"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}


def estimator(plant: pam.Plant, **more: Any) -> MovingHorizonEstimator:
    settings: dict[str, Any] = {
        "sample_time": STEP,
        "measured": NOISE,
        "horizon": 6,
        "process": {"v": 1e-3},
        "uncertainty": {"x": 1e-4, "v": 1e-3},
        "unknown": {"mass": (0.5, 0.01)},
    }
    return MovingHorizonEstimator(plant, **{**settings, **more})


def record(plant: pam.Plant, mass: float, count: int) -> list[tuple[dict[str, float], Any]]:
    """(noisy measurements, some missing and some far off; commands that acted before) by sample."""
    t = np.arange(count + 1) * STEP
    base = {v.name: v.start or 0.0 for v in plant.inputs}
    up = np.where(np.arange(count + 1) // 12 % 2, 0.6, -0.6) * BAR
    inputs = {"muscle1.command": base["muscle1.command"] + up}
    inputs["muscle2.command"] = base["muscle2.command"] - up
    held = {
        n: (lambda at, c=c: c[np.minimum((at + 1e-9) / STEP, count).astype(int)])
        for n, c in inputs.items()
    }
    run = pam.simulate(plant.with_values({"mass": mass}), held, t=t)
    rng, rows = np.random.default_rng(3), []
    for k in range(count):
        seen = {n: float(run[n][k] + s * rng.standard_normal()) for n, s in NOISE.items()}
        if k % 3 == 1:
            del seen["muscle1.pressure"]
        if k % 10 == 5:
            seen["x"] += 5e-4
        rows.append((seen, {n: float(c[k - 1]) for n, c in inputs.items()} if k else None))
    return rows


def entered(made: Any, seen: dict[str, float], sent: Any) -> np.ndarray:
    """The block's inputs: what is not measured is NaN."""
    told = {v.name: v.start for v in made.inputs if v.name.startswith("sent.")}
    told |= {f"sent.{n}": value for n, value in (sent or {}).items()}
    return np.array([{**seen, **told}.get(v.name, np.nan) for v in made.inputs])


CASES: dict[str, tuple[dict[str, Any], float]] = {
    "free": ({}, 1e-10),
    "robust": ({"robust": 1.5}, 1e-10),
    "bounded": ({"bounds": {"mass": (1.0, 2.2)}, "iterations": 12}, 2e-6),
    "one step": ({"horizon": 1}, 1e-10),
}


@pytest.mark.parametrize("case", CASES)
def test_it_tells_what_the_estimator_tells(case: str) -> None:
    """Whose window grows from its first node, where that of the block begins full."""
    (more, limit), plant = CASES[case], benchmark_slide()
    known = estimator(plant, **more)
    made = block(known, plant=plant, guard=False)
    memory, scale, last = made.start("memory"), known._scale, []
    for seen, sent in record(plant, 2.6, 40):
        if sent is not None:
            known.predict(sent)
        wanted = known.correct(seen, sent)
        memory, told = (
            np.asarray(e).ravel() for e in made.step(memory, entered(made, seen, sent), [])
        )
        here, spread = np.split(told, 2)
        values = {**wanted.state, **wanted.values}
        assert np.abs((here - [values[n] for n in known.names]) / scale).max() < limit
        assert np.abs(spread / [wanted.deviation[n] for n in known.names] - 1).max() < 1e-6
        last.append(here[-1])
    if case == "bounded":
        assert max(last) == pytest.approx(2.2, abs=1e-6)
    else:
        assert last[-1] == pytest.approx(2.6, rel=0.05)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("case", ["robust", "bounded"])
def test_in_c_it_gives_the_same_bits(case: str, tmp_path: Path) -> None:
    plant = benchmark_slide()
    made = block(estimator(plant, **CASES[case][0]), plant=plant, guard=False)
    folder = pam.export_c(made, tmp_path / "c", name="window", steps=20, tolerance=1e-9)
    program, memory = Program(folder, "window", made), made.start("memory")
    for seen, sent in record(plant, 2.6, 40):
        values = entered(made, seen, sent)
        memory, told = (np.asarray(e).ravel() for e in made.step(memory, values, []))
        found = program.step(dict(zip((v.name for v in made.inputs), values, strict=True)))
        assert np.array_equal(list(found.values()), told)
    readme = (folder / "README.md").read_text()
    assert f"- Gauss-Newton steps: {CASES[case][0].get('iterations', 3)}" in readme
    assert all(f"- {what}: {most}" in readme for what, most in made.loops.items())


@pytest.mark.slow
def test_a_regulator_behind_it_holds_a_slide_of_another_mass() -> None:
    plant = benchmark_slide()
    rest = plant.equilibrium(x=0.0, stiffness=2e4)
    law = pam.lqr(plant, rest, sample_time=STEP)
    made = block(chain([estimator(plant, start=rest), law]), plant=plant)
    real = plant.with_values({"mass": 2.6})
    start = {**dict(zip((v.name for v in plant.states), rest.x, strict=True)), "x": 0.002}
    loop = pam.closed_loop(BlockController(made), real, duration=0.5, start=start, noise=NOISE)
    assert abs(loop["x"][-1]) < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
def test_it_is_an_fmu(fmi: Any, tmp_path: Path) -> None:
    plant = benchmark_slide()
    made = block(estimator(plant, horizon=3), plant=plant)
    path = export_fmu(made, tmp_path / "window.fmu", fmi=fmi, platforms="native")
    checked = check_fmu(path)
    assert checked.ok, str(checked)
