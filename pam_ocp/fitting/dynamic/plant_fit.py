"""What a dynamic fit tells: parameters with errors, replays of the records, and its doubts."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import courtesy
from ...core.errors import InputError
from ...core.files import read_json, reading, write_json
from ...core.shown import shown
from ...core.signals import Interpolation
from ...core.stop import verb
from ...core.trajectory import Trajectory
from ...core.variables import data_of_variable, variable_of
from ...plants.plant import Plant, require_plant
from ...plants.plant_data import carried
from ...plants.plant_file import load_plant
from ...simulation.compare import RecordComparison, compare_with_record
from ..estimates import coefficient_line
from ..static.correlation import neighbours, widening
from ..statistics import Array, Coefficient, Linearisation
from .adequacy import Adequacy, adequacy_of, residual_adequacy
from .coverage import FittedPlant
from .evidence import Evidence, evidence_of
from .experiment import groups, running, with_inputs
from .gauss_newton import DONE
from .rig import Rig, unknowns_of
from .transcribe import FitMethod

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ACCURATE = 0.02
"""Largest error of the integration that a fit is content with, in standard deviations of the noise.
"""
FOLLOWED = 1.5
"""Times the fit's own residuals that those of the motions which are tested may be."""
BEHIND = 0.95
"""The same, from which on the fit is not where motions through the records are nearest to them."""
COLOURED = 0.3
"""Correlation of neighbouring residuals from which intervals are called too narrow."""


@shown
@dataclass(frozen=True, eq=False)
class PlantFit(FittedPlant):
    """A plant fitted to records.

    plant : with the fitted values. linearisation : of all unknowns (parameters, sensors' gains and
    offsets, delay, initial states), weighted. records, simulated : measured, and the fitted plant
    integrated anew under the measured inputs (sensors' gains and offsets and the delay applied).
    starts : initial states of each record. measured : names that were compared.
    noise : standard deviation of each measured variable [its unit].

    Examples
    --------
    >>> print(f"{dynamic_fit.values['mass']:.2f} kg")
    10.00 kg
    >>> low, high = dynamic_fit.interval("mass")
    >>> low < 10.0 < high
    True
    """

    plant: Plant
    records: tuple[Trajectory, ...]
    simulated: tuple[Trajectory, ...] = field(repr=False)
    measured: tuple[str, ...]
    parameters: tuple[str, ...]
    linearisation: Linearisation = field(repr=False)
    delay: float
    offsets: Mapping[str, float]
    gains: Mapping[str, float]
    starts: tuple[Mapping[str, float], ...] = field(repr=False)
    noise: Mapping[str, float]
    residuals: tuple[Array, ...] = field(repr=False)
    """Measured minus modelled, one (K, ny) for each record, in the measured variables' units."""
    descriptions: Mapping[str, str] = field(repr=False)
    at_bound: tuple[str, ...]
    method: FitMethod
    degree: int
    step: float | None
    inputs: Mapping[str, float]
    status: str
    iterations: int
    seconds: float
    process_noise: Mapping[str, float] = field(default_factory=dict)
    """Intensity of the noise that was allowed to disturb a state [unit/sqrt(s)]; ``simulated`` is
    then the smoothed motion.
    """

    input_noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of measured inputs whose errors were estimated; ``simulated`` ran without
    them.
    """
    interpolation: Interpolation = "linear"
    """How inputs count as having run between the samples of records that do not say it."""
    inputs_ran: str = ""
    """How that was decided, in words; empty where the records say it."""

    # ---- parameters ---------------------------------------------------------------------------
    @cached_property
    def adequacy(self) -> Adequacy:
        """What the residuals of one motion through each record tell about the model; see
        :class:`Adequacy`. Of a smoothed motion or of inputs with errors nothing is tested; of
        records that are not sampled at equal steps, or memories whose kinks need a simulation, only
        whether the fit's residuals are the records' noise.
        """
        if self.process_noise or self.input_noise or not self.records:
            return Adequacy()
        evidence, apart = self._evidence(), {}
        if evidence is not None:
            # how large residuals with free starts are in those of the fit. Larger: the integration
            # does not follow the plant (a memory, a play). Smaller: no matter.
            own = np.array([self.rmse[n] for n in self.measured])
            ratio = np.maximum(evidence.rms / np.maximum(own, 1e-300), 1e-300)
            strays = float(np.exp(np.mean(np.log(ratio))))
            weights = 1 / np.array([self.noise[n] for n in self.measured])
            found = adequacy_of(evidence, weights) if strays < FOLLOWED else Adequacy()
            if found.cause or (strays < FOLLOWED and (strays > BEHIND or self.status not in DONE)):
                return found
            moved = np.abs(evidence.shifts * evidence.scale).tolist()
            apart = dict(zip(evidence.names, moved, strict=True))
        return self._by_residuals(apart)

    def _by_residuals(self, apart: Mapping[str, float]) -> Adequacy:
        rows = zip(self.records, self.residuals, strict=True)
        measured = [r.array(self.measured)[-len(e) :] for r, e in rows]
        linear = self.linearisation
        stderr = dict(zip(linear.names, linear.stderr().tolist(), strict=True))
        lost = len(linear.names)
        return residual_adequacy(self.measured, self.residuals, measured, lost, stderr, apart)

    def _evidence(self) -> Evidence | None:
        """Motions through the records from the fit's values."""
        linear, names = self.linearisation, list(self.measured)
        found = dict(zip(linear.names, linear.values, strict=True))
        free_delay = "delay" in self.parameters
        count = len(self.parameters) - len(self.gains) - len(self.offsets) - free_delay
        free = [tuple(n.split(" = ")) if " = " in n else n for n in self.parameters[:count]]
        unknowns, _ = unknowns_of(
            self.plant,
            groups(self.plant, free),
            names,
            len(self.records),
            float(np.median(np.diff(self.records[0].t))),
            delay=(self.delay - 1.0, self.delay + 1.0) if free_delay else self.delay,
            gains=tuple(self.gains),
            offsets=tuple(self.offsets),
        )
        z = np.array([found[n] for n in unknowns.names]) / unknowns.scale
        z[[j for j, _ in unknowns.of("gains")]] -= 1.0
        rig = Rig({v.name: self.delay for v in self.plant.inputs if self.delay})
        known = running(self.records, self.interpolation)
        records = [with_inputs(self.plant, r, self.inputs) for r in known]
        return evidence_of(self.plant, records, names, unknowns, rig, z)

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """Every unknown but the initial states, by name; standard errors with autocorrelated
        residuals counted, and where the model is inadequate or the search did not end, with what
        that may shift.
        """
        linear = self.linearisation
        a = self.adequacy
        plain = a.adequate and self.status in DONE
        told = {n: e for n, e in a.stderr.items() if not (plain or n in self.at_bound)}
        rows = zip(linear.names, linear.values, linear.stderr(), linear.units, strict=True)
        return {
            n: Coefficient(
                n,
                float(v),
                told.get(n, float(e)) if np.isfinite(e) else float(e),
                u,
                False,
                self.descriptions.get(n, ""),
            )
            for n, v, e, u in rows
            if n in self.parameters
        }

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by name."""
        linear = self.linearisation  # no model needs to be judged for them
        pairs = zip(linear.names, linear.values.tolist(), strict=True)
        return {n: v for n, v in pairs if n in self.parameters}

    def _freedom(self, name: str) -> int:
        return self.linearisation.dof if self.adequacy.adequate else self.adequacy.dof

    def _plain(self) -> Array:
        places = [self.linearisation.names.index(n) for n in self.coefficients]
        return np.asarray(self.linearisation.covariance[np.ix_(places, places)])

    @property
    def rank(self) -> int:
        """How many independent combinations of all unknowns the records determine."""
        return self.linearisation.rank

    # ---- agreement ----------------------------------------------------------------------------
    @property
    def rmse(self) -> dict[str, float]:
        """Root of the mean squared residual over all records [unit of the variable]."""
        squares = np.mean(np.concatenate(self.residuals) ** 2, axis=0)
        return dict(zip(self.measured, np.sqrt(squares).tolist(), strict=True))

    @cached_property
    def comparisons(self) -> tuple[RecordComparison, ...]:
        """Each record against its simulation, by an integrator of its own."""
        return tuple(
            compare_with_record(s, r, self.measured)
            for s, r in zip(self.simulated, self.records, strict=True)
        )

    @property
    def integration_error(self) -> float:
        """RMS difference between the fit's motion and an accurate simulation, in units of noise.

        Noise below 1e-5 of the nominal counts as that much.
        """
        worst = 0.0
        for i, name in enumerate(self.measured):
            least = 1e-5 * self.plant.variable(name).nominal
            gaps = [
                r[:, i] - (record[name][-len(r) :] - run[name])
                for r, record, run in zip(self.residuals, self.records, self.simulated, strict=True)
            ]
            rms = float(np.sqrt(np.mean(np.concatenate(gaps) ** 2)))
            worst = max(worst, rms / max(self.noise[name], least))
        return worst

    @property
    def fit_percent(self) -> dict[str, float]:
        """Mean fit percentage over the records, from the simulations."""
        return {
            n: float(np.mean([c[n].fit_percent for c in self.comparisons])) for n in self.measured
        }

    def validate(self, records: Trajectory | Sequence[Trajectory]) -> list[RecordComparison]:
        """Other records against simulations with the fitted values.

        Only the initial states are estimated from each record; parameters, sensors and delay stay.
        """
        return courtesy.validate(self, records)

    # ---- doubts --------------------------------------------------------------------------------
    @property
    def autocorrelation(self) -> dict[str, float]:
        """Correlation of neighbouring residuals of each measured variable."""
        return {
            name: neighbours([r[:, i] for r in self.residuals])
            for i, name in enumerate(self.measured)
        }

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the parameters are trusted; empty when there is nothing."""
        found = []
        if self.status not in DONE:
            found.append(
                f"the search did not come to its end ({self.status} after {self.iterations} "
                "iterations): these are the best values until then"
            )
        for lost, _, words in self.linearisation.hardly_seen():
            if lost or any(n in words for n in self.parameters):
                found.append(
                    f"the records {'do not' if lost else 'hardly'} see this combination: changing "
                    f"{words} together changes nothing that was measured"
                    + ("" if lost else " by more than its noise (one standard error)")
                )
        found += [
            f"{name} = {self.values[name]:g} ended at the edge of its range: its interval means "
            "nothing"
            for name in self.at_bound
            if name in self.values
        ]
        if self.integration_error > 10 * ACCURATE:
            found.append(
                f"between the samples the integration is off by {self.integration_error:.2g} "
                "standard deviations of the noise; give a smaller step=..."
            )
        found += [text for text in (self.adequacy.sentence,) if text]
        tested = bool(self.adequacy.tests)
        coloured = {n: r for n, r in self.autocorrelation.items() if r > COLOURED and not tested}
        for name, r in coloured.items():
            found.append(
                f"residuals of {name} are serially correlated ({r:.2f}): the model leaves "
                "something out, and intervals are too narrow by a factor of about "
                f"{widening(r):.1f}"
            )
        return tuple(found)

    # ---- text ----------------------------------------------------------------------------------
    def report(self, level: float = 0.95) -> str:
        """The fit as text: agreement, parameters ± standard error, correlations, warnings."""
        linear = self.linearisation
        samples = sum(len(r) for r in self.residuals)
        known = set(self.coefficients)
        pairs = [(r, a, b) for r, a, b in linear.correlated(0.8) if a in known and b in known]
        lines = [
            "[[Plant]]",
            f"    {self.plant.name}: {self.plant.description}",
            "[[Records]]",
            f"    {len(self.records)} with {samples} samples of {', '.join(self.measured)}",
            *([f"    {self.inputs_ran}"] if self.inputs_ran else []),
            "[[Fit]]" + (" of the smoothed motion" if self.process_noise else ""),
            *(
                f"    {n}: RMSE {self.plant.variable(n).shown(e)}, fit {self.fit_percent[n]:.2f} %"
                for n, e in self.rmse.items()
            ),
            f"    condition {linear.condition:.3g}, rank {self.rank} of {len(linear.names)} "
            f"unknowns (initial states included), {linear.dof} degrees of freedom",
            f"    {self.method}: {self.status}, {self.iterations} iterations, {self.seconds:.2f} s",
            *(
                f"    process noise of {n}: {size:.4g} {self.plant.variable(n).unit}/sqrt(s)"
                for n, size in self.process_noise.items()
            ),
            *(
                f"    measured {n} with noise of {self.plant.variable(n).shown(size)}: its errors "
                "are estimated, too"
                for n, size in self.input_noise.items()
            ),
        ]
        if self.warnings:
            lines += ["[[Warnings]]", *(f"    {text}" for text in self.warnings)]
        lines.append(f"[[Parameters]] ± standard error (relative), {100 * level:g} % interval; SI")
        lines += [
            coefficient_line(c, self.interval(c.name, level)) for c in self.coefficients.values()
        ]
        if pairs:
            lines.append("[[Correlations]] (beyond 0.8)")
            lines += [f"    C({a}, {b}) = {r:+.4f}" for r, a, b in pairs]
        return "\n".join(lines)

    def plot(self) -> Figure:
        """Each record and the fitted plant's motion over each other, and their difference."""
        return courtesy.plot_records(self.comparisons)

    def to_excel(self, path: str | os.PathLike[str]) -> Path:
        """Write a workbook (.xlsx): parameters with intervals; measured and simulated, charts."""
        return courtesy.write_plant_fit_book(self, path)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write values, statistics and records as JSON; :func:`load_plant_fit` reads them back."""
        linear = self.linearisation
        content: dict[str, Any] = {
            "format": FORMAT,
            "version": 1,
            "units": "SI",
            "plant": self.plant.name,
            "values": {v.name: v.start for v in self.plant.parameters},
            "states": [v.name for v in self.plant.states],
            "fitted": {n: c.value for n, c in self.coefficients.items()},
            "stderr": {n: c.stderr for n, c in self.coefficients.items() if np.isfinite(c.stderr)},
            "rmse": self.rmse,
            "fit_percent": {n: v if np.isfinite(v) else None for n, v in self.fit_percent.items()},
            "warnings": list(self.warnings),
            **{n: _plain(getattr(self, n)) for n in (*_PLAIN, *_TUPLES)},
            # what matters of the Jacobian is its triangle: J^T J = R^T R
            "linearisation": _plain(vars(replace(linear, jacobian=_triangle(linear.jacobian)))),
            "residuals": _plain(self.residuals),
            "records": [_record(r, r.names) for r in self.records],
            "simulated": [_record(r, self.measured) for r in self.simulated],
        }
        return write_json(path, content | carried(self.plant))

    def save_ssv(self, path: str | os.PathLike[str]) -> Path:
        """Write the fitted parameters as SSV (SSP 1.0), which sets the plant's FMU without
        Python.
        """
        known = {v.name for v in self.plant.parameters}
        values = {n: v for n, v in self.values.items() if n in known}
        return courtesy.save_ssv(self.plant, path, values)

    def __repr__(self) -> str:
        shown = ", ".join(f"{n} = {v:.5g}" for n, v in self.values.items())
        return f"PlantFit({self.plant.name!r}: {shown})"


# ---- files ---------------------------------------------------------------------------------------
FORMAT = "pam_ocp plant fit"
_TUPLES = ("measured", "parameters", "starts", "at_bound")
_OWN_WAY = (*_TUPLES, "plant", "records", "simulated", "linearisation", "residuals")
_PLAIN = tuple(f.name for f in fields(PlantFit) if f.name not in _OWN_WAY)
"""Written as they are."""
_LATER = ("process_noise", "input_noise", "interpolation", "inputs_ran")
"""Not in older files."""


@verb
def load_plant_fit(path: str | os.PathLike[str], plant: Plant | None = None) -> PlantFit:
    """Read what :meth:`PlantFit.save` wrote.

    plant : the same plant (any parameter values), on which the fitted values are set; None: the one
        that the file carries.

    Raises InputError for a file that holds no fit, or one of another plant.

    Examples
    --------
    >>> path = dynamic_fit.save("fit.json")
    >>> print(f"{pam.fitting.load_plant_fit(path, plant).values['mass']:.2f} kg")
    10.00 kg
    """
    name = os.fspath(path)
    content = read_json(path, "a fit of a plant", FORMAT, "PlantFit.save() writes one")
    plant = load_plant(path) if plant is None else require_plant(plant)
    with reading(path, "a fit of a plant", "give one that PlantFit.save() wrote"):
        _require_same(name, content, plant)
        linear = dict(content["linearisation"])
        for key in ("values", "jacobian"):
            linear[key] = np.array(linear[key], dtype=float)
        if linear["active"] is not None:
            linear["active"] = np.array(linear["active"], dtype=float)
        arguments: dict[str, Any] = {
            **{n: content[n] for n in _PLAIN if n in content or n not in _LATER},
            **{n: tuple(content[n]) for n in _TUPLES},
            "plant": plant.with_values(content["values"]),
            "records": tuple(_trajectory(r) for r in content["records"]),
            "simulated": tuple(_trajectory(r) for r in content["simulated"]),
            "linearisation": Linearisation(**linear),
            "residuals": tuple(np.array(r, dtype=float) for r in content["residuals"]),
        }
        return PlantFit(**arguments)


def _require_same(name: str, content: Mapping[str, Any], plant: Plant) -> None:
    for kind, saved, own in (
        ("parameters", list(content["values"]), [v.name for v in plant.parameters]),
        ("states", content["states"], [v.name for v in plant.states]),
    ):
        other = [n for n in (*saved, *own) if (n in saved) != (n in own)]
        if other:
            side = "the file" if other[0] in saved else "the plant"
            raise InputError(
                f"{name} is a fit of plant {content['plant']!r}, whose {kind} are others: only "
                f"{side} has {other[0]}; give the plant that was fitted"
            )


def _triangle(jacobian: Array) -> Array:
    """R (k, k) with R^T R = J^T J; J itself when it has fewer rows."""
    return np.asarray(
        np.linalg.qr(jacobian, mode="r") if len(jacobian) > jacobian.shape[1] else jacobian
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def _record(record: Trajectory, names: Sequence[str]) -> dict[str, Any]:
    return {
        "t": record.t.tolist(),
        "columns": {n: record[n].tolist() for n in names},
        "variables": [data_of_variable(record.variable(n)) for n in names],
        "interpolation": record.interpolation if record.interpolation_known else None,
    }


def _trajectory(content: Mapping[str, Any]) -> Trajectory:
    variables = [variable_of(said) for said in content["variables"]]
    return Trajectory(content["t"], content["columns"], variables, content["interpolation"])
