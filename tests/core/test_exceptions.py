"""Errors as other processes hand them on."""

import copy
import pickle

import pytest

from pam_ocp.core.errors import InputError, PlanError, UnknownNameError
from pam_ocp.core.exceptions import FitError, PamError, SimulationError, WriteError


def rebuilt(error):
    """As tblib, which distributed's workers send errors by, does it."""
    found = type(error).__new__(type(error), *error.args)
    found.__dict__.update(vars(error))
    return found


@pytest.mark.parametrize(
    "error",
    [
        UnknownNameError("muscle", "DMSP-20-3O0", ["DMSP-20-300", "DMSP-10-250"]),
        UnknownNameError("muscle", 7, []),
        InputError("mass = -1 kg must be > 0"),
        SimulationError("stuck", 0.3),
        PlanError("no plan"),
        WriteError("full", 28),
        FitError("none"),
    ],
)
@pytest.mark.parametrize("again", [copy.copy, lambda e: pickle.loads(pickle.dumps(e)), rebuilt])
def test_an_error_is_itself_in_another_process(error, again):
    found = again(error)
    assert type(found) is type(error)
    assert isinstance(found, PamError)
    assert (str(found), found.args) == (str(error), error.args)
    assert vars(found) == vars(error)
    if again is not rebuilt:  # which is told of it by itself
        assert getattr(found, "errno", None) == getattr(error, "errno", None)
