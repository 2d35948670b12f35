"""What an export was asked for, checked: settings and words about the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Literal

from ..core.errors import InputError, UnknownNameError, require_positive

FmiVersion = Literal["2.0", "3.0"]
EXCHANGE_FRACTION = 1e-2
"""The tolerance proposed to an importer's own solver, as a part of that of Co-Simulation.

A multistep solver such as CVODE holds the error of one step to its tolerance; over the steps of an
oscillation errors add up to some 50 (20 .. 400) times that.
"""
LEAST_PROPOSED = 1e-9
"""Below, importers' limits on the number of steps break a simulation off."""


@dataclass(frozen=True)
class Settings:
    """What an export was asked for, checked."""

    fmi: str
    tolerance: float
    step_size: float
    fixed_step: float
    stop_time: float
    about: Mapping[str, str]
    """Author, version, copyright, license and date of the model, where they are said."""

    @property
    def proposed_tolerance(self) -> float:
        """What DefaultExperiment says, so that Model Exchange comes near to Co-Simulation."""
        return max(self.tolerance * EXCHANGE_FRACTION, min(self.tolerance, LEAST_PROPOSED))


def checked(
    fmi: str,
    step_size: float,
    tolerance: float,
    fixed_step: float | None,
    stop_time: float,
    about: Mapping[str, str] | None = None,
) -> Settings:
    """The settings of an export. Raises InputError, UnknownNameError."""
    if fmi not in ("2.0", "3.0"):
        raise UnknownNameError("FMI version", fmi, ("2.0", "3.0"))
    step_size = require_positive("step_size", step_size, "s")
    stop_time = require_positive("stop_time", stop_time, "s")
    if not 1e-11 <= require_positive("tolerance", tolerance) <= 1e-2:
        raise InputError(f"tolerance = {tolerance:g} must lie in 1e-11 .. 1e-2")
    fixed = 0.0 if fixed_step is None else require_positive("fixed_step", fixed_step, "s")
    return Settings(fmi, float(tolerance), float(step_size), fixed, float(stop_time), about or {})


def checked_about(
    author: str | None,
    version: str | None,
    copyright: str | None,
    license: str | None,
    date: str | datetime | None,
) -> dict[str, str]:
    """What is said of the model, for its description. Raises InputError."""
    said = {"author": author, "version": version, "copyright": copyright, "license": license}
    for name, text in said.items():
        if text is not None and (not isinstance(text, str) or not text.isprintable()):
            raise InputError(f"{name} = {text!r}: give one line of text")
    found = {name: text for name, text in said.items() if text}
    if date is not None:
        try:
            moment = date if isinstance(date, datetime) else datetime.fromisoformat(date)
        except (TypeError, ValueError):
            raise InputError(
                f"date = {date!r}: give a datetime or ISO 8601, such as '2026-03-01T12:00:00Z'"
            ) from None
        moment = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
        found["date"] = moment.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
    return found
