"""A free mass, the controller of the benchmark's slide, and quadratic programs solved exactly."""

import casadi as ca
import numpy as np
from conftest import benchmark_slide

import pam_ocp as pam
from pam_ocp.control.mpc.mpc import Mpc

COMMANDS = ("muscle1.command", "muscle2.command")


def mass(limit: float = np.inf) -> pam.Plant:
    plant = pam.Plant("mass", "a free mass")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    f = plant.input("f", unit="N", min=-limit, max=limit)
    push = plant.input("push", unit="N", disturbance=True)
    m = plant.parameter("m", 1.0, unit="kg", min=1e-3, tunable=True)
    plant.der(x, v)
    plant.der(v, (f + push) / m)
    return plant


def slide_mpc(**options) -> Mpc:
    settings = {
        "horizon": 25,
        "sample_time": 0.005,
        "track": {"x": 1.0, "stiffness": 0.1},
        "rate": dict.fromkeys(COMMANDS, 0.1),
    }
    return Mpc(benchmark_slide(), **{**settings, **options})


def exact(program, point):
    """The quadratic program at a point by PIQP at its tightest, for each node's unknowns."""
    p = program
    tight = {"piqp": {"eps_abs": 1e-12, "eps_rel": 1e-12}}
    solver = ca.conic("exact", "piqp", {"h": p.h_sparsity, "a": p.a_sparsity}, tight)
    found = solver(
        h=ca.DM(p.h_sparsity, point.h),
        g=point.gradient,
        a=ca.DM(p.a_sparsity, point.a),
        lba=point.a_low,
        uba=point.a_high,
        lbx=point.w_low,
        ubx=point.w_high,
    )["x"]
    return np.asarray(found).ravel()
