"""What acts on the real side of a closed loop, and what is measured of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.errors import InputError, UnknownNameError, require_positive
from ..core.variables import Variable
from ..plants.inversion import Inversion
from ..plants.plant import Plant
from ..simulation.instruments import Instrument, readers_of
from .controller import Observer
from .references import Source, source
from .sides import Side

__all__ = ["Actuators", "Sensors"]


class Actuators:
    """A controller's answer as the side's inputs, within their range."""

    def __init__(self, side: Side, model: Plant | None) -> None:
        self._side = side
        self._known = {v.name: v for v in side.variables}
        self._alias = {n.replace(".", "_"): n for n in self._known}
        self._range = {n: self._known[n] for n in side.inputs}
        self._start = dict(side.inputs)
        inversion = None if model is None else Inversion(model)
        self._inversion = inversion if inversion and self._of(model) else None

    def _of(self, model: Plant | None) -> bool:
        """Whether the side has the model's inputs."""
        return model is not None and all(v.name in self._range for v in model.inputs)

    def known(self, name: str) -> Variable:
        """A variable of the side. Raises UnknownNameError."""
        if self._inversion and (opening := self._inversion.opening_of(name)):
            return self._inversion.inner.variable(opening)
        full = name if name in self._known else self._alias.get(name, name)
        if full not in self._known:
            raise UnknownNameError("variable of the real side", name, self._known)
        return self._known[full]

    def _input(self, name: str) -> Variable:
        variable = self.known(name)
        if variable.name not in self._range:
            raise InputError(
                f"{variable.name} is a {variable.causality} of the plant, not an input; its inputs "
                f"are {', '.join(self._range)}"
            )
        return variable

    def disturbances(self, given: Mapping[str, Any]) -> dict[str, Source]:
        """{input: function of time}."""
        found: dict[str, Source] = {}
        for name, value in given.items():
            variable = self._input(name)
            pair = isinstance(value, list | tuple)
            if not callable(value) and not isinstance(value, Mapping):
                size = value[0] if pair and len(value) else value
                variable.check(size, "disturbance")
            before = self._start[variable.name]
            found[variable.name] = source(f"disturbances[{name!r}]", value, variable.unit, before)
        return found

    def __call__(self, t: float, answer: Mapping[str, float]) -> dict[str, float]:
        if not isinstance(answer, Mapping):
            raise InputError(
                f"the controller's answer at t = {t:g} s is a {type(answer).__name__}: give "
                f"inputs by name, such as {{{next(iter(self._range), 'name')!r}: 3e5}}"
            )
        if self._inversion:
            seen = None if self._inversion.exact else self._side.values()
            answer = self._inversion.commands(answer, measured=seen)
        found = dict(self._start)
        for name, value in answer.items():
            variable = self._range.get(name) or self._input(name)
            try:
                number = float(value)
            except (TypeError, ValueError):
                raise InputError(
                    f"the controller's answer at t = {t:g} s: {name} = {value!r} is not a number"
                ) from None
            if not np.isfinite(number):
                raise InputError(
                    f"the controller's answer at t = {t:g} s is not finite: {dict(answer)}"
                )
            found[variable.name] = min(max(number, variable.min), variable.max)
        return found


class Sensors:
    """What is measured of the side: all states and outputs by name, by instruments, with noise."""

    def __init__(
        self,
        side: Side,
        estimator: Observer | None,
        noise: Mapping[str, float] | None,
        seed: int,
        instruments: Mapping[str, Instrument] | None = None,
    ) -> None:
        self.names = [v.name for v in side.variables if v.causality in ("state", "output")]
        alias = {n.replace(".", "_"): n for n in self.names}
        expected = estimator.deviations if estimator is not None else {}
        for name in expected:
            if name not in self.names:
                raise UnknownNameError("measured variable of the real side", name, self.names)
        given = noise if noise is not None else {} if side.measured else expected
        self.noise = {
            alias.get(n, n): require_positive(f"noise[{n!r}]", s, zero=True)
            for n, s in given.items()
        }
        unknown = [n for n in self.noise if n not in self.names]
        if unknown:
            raise InputError(f"noise: {unknown[0]} is not measured; name states or outputs")
        self._random = np.random.default_rng(seed)
        known = {v.name: v for v in side.variables if v.name in self.names}
        known |= {n: known[full] for n, full in alias.items()}
        for name in instruments or {}:
            if name not in known:
                raise UnknownNameError("measured variable of the real side", name, self.names)
        self._readers = readers_of(instruments, known, seed)
        if noise is None:  # an instrument has its own
            self.noise = {n: s for n, s in self.noise.items() if n not in self._readers}

    def __call__(self, t: float, values: Mapping[str, float]) -> dict[str, float]:
        seen = {n: values[n] for n in self.names}
        for name, reader in self._readers.items():
            reader.tell(t, values[name])
            seen[name] = reader.read(t)
        for name, deviation in self.noise.items():
            seen[name] += deviation * float(self._random.standard_normal())
        return seen
