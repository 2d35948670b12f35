"""A linear system in plain arrays, where python-control is not needed.

python-control loads SciPy's statistics and pyplot, a third of a second: what wants poles and
frequency responses only has them from here.
"""

from __future__ import annotations

import copyreg
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    import control

Array: TypeAlias = NDArray[np.float64]
Complex: TypeAlias = NDArray[np.complex128]


@dataclass(frozen=True)
class LinearModel:
    """x' = A x + B u, y = C x + D u (of samples dt > 0: x[k+1] = ...), with names and units.

    Its members are those of a ``control.StateSpace``; :meth:`to_control` makes one.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    state_labels: list[str]
    input_labels: list[str]
    output_labels: list[str]
    units: Mapping[str, str] = field(default_factory=dict)
    name: str = ""
    dt: float = 0.0

    def poles(self) -> Complex:
        """The eigenvalues of A [rad/s; 1 of samples]."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def __call__(self, s: ArrayLike, squeeze: bool = False) -> Complex:
        """C (s I - A)^-1 B + D, (outputs, inputs, places), at each of the places s (z of samples).

        squeeze : without the axes of length one.
        """
        places = np.atleast_1d(np.asarray(s, complex))
        shifted = places[:, None, None] * np.eye(len(self.A)) - self.A
        inner = np.linalg.solve(shifted, np.broadcast_to(self.B, (len(places), *self.B.shape)))
        found = np.moveaxis(np.asarray(self.C @ inner + self.D, np.complex128), 0, -1)
        return found.squeeze() if squeeze else found

    def to_control(self) -> control.StateSpace:
        """The same of python-control, with ``units`` beside it."""
        import control

        system = control.ss(
            self.A,
            self.B,
            self.C,
            self.D,
            self.dt,
            name=self.name,
            states=self.state_labels,
            inputs=self.input_labels,
            outputs=self.output_labels,
            remove_useless_states=False,
        )
        system.units = dict(self.units)
        copyreg.pickle(control.StateSpace, _packed)  # which holds functions that cannot travel
        return system


def _packed(system: control.StateSpace) -> tuple[Callable[[], control.StateSpace], tuple[()]]:
    """What makes it anew, for pickle and copies."""
    labels = system.state_labels, system.input_labels, system.output_labels
    units = getattr(system, "units", {})
    matrices = system.A, system.B, system.C, system.D
    return LinearModel(*matrices, *labels, units, system.name, system.dt).to_control, ()
