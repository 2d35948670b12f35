"""The two bundled tables, fits to them, and what several tests of static fits draw from."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from pam_ocp.fitting import ForceFit, ForceTable, fit_force, read_table
from pam_ocp.muscles.law import SixParameterLaw

# REFERENCE: our sets for p in bar and kappa in %
PUBLISHED = {
    "DMSP-20-300": (12.789, 419.48, -0.56665, -8.7013, 267.672, -309.603),
    "DMSP-10-250": (-3.0515, 168.235, -0.42455, -2.90206, 91.4042, -201.027),
}
TRUTH = SixParameterLaw.from_published(PUBLISHED["DMSP-20-300"])


@cache
def measured(name: str = "DMSP-20-300") -> ForceTable:
    """The bundled table of a muscle whose name ends in its rest length [mm]."""
    return read_table(f"{name}_static.csv", rest_length=1e-3 * int(name.rpartition("-")[2]))


@cache
def fit_20() -> ForceFit:
    """The six-parameter law fitted to the table of the DMSP-20-300."""
    return fit_force(measured())


def six(c: Any, p: Any, kappa: Any) -> Any:
    """Eq. (3) in NumPy, written out a second time."""
    return (c[0] * p + c[1]) * np.exp(c[2] * kappa) + c[3] * kappa * p + c[4] * p + c[5]


def six_slopes(c: Any, p: Any, kappa: Any) -> Any:
    """Its derivatives in the coefficients, (cells, 6)."""
    e = np.exp(c[2] * kappa)
    bent = (c[0] * p + c[1]) * kappa * e
    return np.stack([p * e, e, bent, kappa * p, p, np.ones_like(p)], axis=1)


def grid(kappa: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(pressures, contractions) of all cells."""
    contraction, pressure = (a.ravel() for a in np.meshgrid(kappa, p))
    return pressure, contraction


def six_by_scipy(kappa: Any, p: Any, force: Any, start: Any) -> Any:
    """SciPy's least squares of eq. (3) from a start; p in bar, kappa in %."""
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    return least_squares(
        lambda c: six(c, p, kappa) - force,
        start,
        lambda c: six_slopes(c, p, kappa),
        method="lm",
        x_scale="jac",
        **tight,
    )


def joined(*tables: ForceTable) -> ForceTable:
    """Cells of several tables in one."""
    names = ("pressure", "contraction", "force")
    columns = (np.concatenate([getattr(t, n) for t in tables]) for n in names)
    return ForceTable(*columns, tables[0].rest_length)
