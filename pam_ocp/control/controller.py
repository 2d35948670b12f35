"""What a closed loop asks of a controller, of an estimator, and of what they are told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

from ..plants.plant import Plant
from .references import Source

Measured: TypeAlias = Mapping[str, float]


class Controller(Protocol):
    """What decides the inputs at each sample.

    It may have, and the loop then uses: ``sample_time`` [s]; ``delay`` (samples from measuring to
    acting that it is designed for); ``plant`` (its model: says of an FMU's inputs what range they
    have); ``wanted(t)`` (values by name that are to be reached, for the result's reference);
    ``aims(t)`` (those that are to arrive, for the verdict; by default those wanted);
    ``statistics`` and ``prediction_error()`` (see Mpc); ``expected()`` (states by name at the end
    of the sample), ``limits`` ({state or output: range}) and ``idle`` (inputs without influence).
    """

    def reset(self) -> None:
        """Forget the past: called once before each run."""

    def __call__(self, t: float, measured: Measured) -> Mapping[str, float]:
        """Inputs by name [SI] to hold from t [s] on; those left out stay at their start value.
        Openings of valves (``muscle.opening``) may be answered in place of their commands.

        ``measured`` gives every state and output of the plant by name, with noise where asked for;
        with an estimator the estimated states and unknowns, and what is measured besides.
        """


@runtime_checkable
class Tracking(Protocol):
    """A controller that is told by the loop what to track."""

    def tracking(
        self, reference: Mapping[str, Source], inputs: Mapping[str, float], preview: bool
    ) -> Controller:
        """The controller of one run.

        reference : {name: function of time [s]}; inputs : those that act as the run begins;
        preview : it may look ahead in the reference. Raises InputError for what it does not track.
        """


@dataclass(frozen=True)
class Estimate:
    """What an estimator knows at one moment, by name [SI]."""

    state: dict[str, float]
    values: dict[str, float]
    """Of the unknowns: parameters, disturbances, ``der(STATE)``."""
    deviation: dict[str, float]
    """Standard deviation of states and unknowns."""


class Observer(Protocol):
    """An estimator in the loop. In each sample: ``correct``, then ``predict`` to the next one."""

    @property
    def plant(self) -> Plant:
        """Its model."""

    @property
    def sample_time(self) -> float:
        """Time between two calls of :meth:`predict` [s]."""

    @property
    def deviations(self) -> Mapping[str, float]:
        """{measured state or output: standard deviation of its noise [SI]}."""

    @property
    def estimate(self) -> Estimate:
        """The present knowledge."""

    def reset(self) -> None:
        """Forget the past: called once before each run."""

    def correct(self, measurement: Measured, inputs: Mapping[str, float] | None = None) -> object:
        """Take measured values in; ``inputs`` are those that act while it is measured."""

    def predict(self, inputs: Mapping[str, float] | None = None) -> object:
        """Go one sample on, under inputs by name."""


def counted(controller: object) -> float | None:
    """The sample time [s] that a controller counts on; None where it has none, or remembers nothing
    from one sample to the next (state feedback without integrals).
    """
    remembers = getattr(controller, "integrated", None) != []
    return getattr(controller, "sample_time", None) if remembers else None
