"""IPOPT: options that all solves share, and what each kind of start adds."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

DEFAULTS: dict[str, Any] = {
    "tol": 1e-9,
    "constr_viol_tol": 1e-9,
    "compl_inf_tol": 1e-10,  # objectives to 1e-8, so that their differences are worth something
    "acceptable_iter": 0,
    "mu_init": 1e-2,
    # with mu_init 1e-2: 33 iterations for 40 to 150 on time-optimal motions
    "alpha_for_y": "bound-mult",
    "nlp_scaling_method": "none",  # the program is scaled by the plant's nominals already
    # a tenth of the time; what counts is the program's own residual
    "fast_step_computation": "yes",
    # a matrix of MUMPS that is singular here and there (redundant inputs, memories that a cycle
    # closes twice) fills in, up to a hundred times, unless MUMPS scales it itself
    "mumps_pivtol": 1e-6,
    "mumps_scaling": 77,
    "mumps_permuting_scaling": 0,
    # minimum degree that sets dense rows apart (a free duration is in all equations): 20 to 30 % of
    # an iteration's time on 6000 unknowns and more, nothing on small ones
    "mumps_pivot_order": 6,
}
"""IPOPT's options; ``plan(..., options=...)`` overrides them."""

BARRIER_OF_TIME = 5e-4
"""mu_init where only the duration counts, in seconds: motions are quick, and a barrier as high as
for other objectives would first make them slow (a sixth of the time of 78 random tasks).
"""

ADAPTIVE: dict[str, Any] = {
    "mu_strategy": "adaptive",
    "alpha_for_y": "primal",
}
"""Another way through, for a second try."""

_PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac")

NEAR: dict[str, Any] = {
    "mu_init": 1e-6,
    "mu_strategy": "adaptive",
    "bound_mult_init_method": "mu-based",
    "max_iter": 300,  # a neighbour that is no help: start cold instead
    # no step misses the constraints by more than the guess: along flat costs long steps did, again
    # and again, and led to other motions (hard random tasks: half the work, up to 28 % lower costs;
    # others as before)
    "theta_max_fact": 1.0,
    **dict.fromkeys(_PUSHES, 1e-6),
}
"""From the primal values of another mesh: a third of the iterations of cold starts there."""

WARM: dict[str, Any] = {
    "warm_start_init_point": "yes",
    "mu_strategy": "adaptive",  # 3 to 20 iterations where a barrier that only falls takes 5 to 60
    "max_iter": 80,
    # 1e-9 takes twice as many where the active constraints change
    **{f"warm_start_{name}": 1e-6 for name in (*_PUSHES, "mult_bound_push")},
}
"""From primal and dual values of the same program with other numbers."""


WANDERING: dict[str, Any] = {
    "acceptable_iter": 15,
    "acceptable_tol": 1e-2,
    "acceptable_dual_inf_tol": 1e-6,
    "acceptable_constr_viol_tol": 1e-2,
    "acceptable_compl_inf_tol": 1e-8,
    "acceptable_obj_change_tol": 1e-7,
}
"""Where to end a solve that has its optimum but no one place for it: costs are flat there (a load
that is let down takes no work, whenever it goes), so Newton's steps are long, and each leads off
the constraints by its square. It is settled then, see ``DAMPED``.
"""
DAMPED: dict[str, float] = {
    **dict.fromkeys(("last", "finer"), 1e-4),
    "damped": 1e-2,
    **dict.fromkeys(("corrector", "restored"), 1.0),
}
"""Added to the Hessian's diagonal for starts that are near: steps along which costs are flat become
short (K. Levenberg, Quart. Appl. Math. 2 (1944) 164-168), and the solution is one that lies near.
Gradients, and so optima, stay as they are.
"""

PLACE: dict[str, Any] = {
    "acceptable_iter": 1,
    "acceptable_tol": 1.0,
    "acceptable_dual_inf_tol": 1e-1,
    "acceptable_constr_viol_tol": 1e-4,
    "acceptable_compl_inf_tol": 1e-4,
    "max_iter": 30,
}
"""For places on a way that are left again: back to the constraints by the shortest way. Costs need
not be the least there, and where they are flat a solver goes on for hundreds of iterations.
"""

CORRECTOR: dict[str, Any] = {**WARM, **PLACE}
"""From one place of a path to the next on the same mesh, by its multipliers."""

LAST: dict[str, Any] = {**WANDERING, **WARM, "max_iter": 150}
"""To the end of a path: the same, and costs are at their least."""

RESTORED: dict[str, Any] = {**NEAR, **PLACE}
"""The same from one mesh to the next."""

FINER: dict[str, Any] = {
    **WANDERING,
    **NEAR,
    "max_iter": 250,
    "acceptable_iter": 5,
    "acceptable_dual_inf_tol": 1e-3,
    "acceptable_constr_viol_tol": 1e-3,
    "acceptable_obj_change_tol": 1e-6,
}
"""From one mesh to the next, until costs all but stay: where they are flat, hundreds of iterations
more gain less than a ten-thousandth.
"""

CONVERGED: dict[str, Any] = {
    **WARM,
    "acceptable_iter": 1,
    "acceptable_tol": 1e-6,
    "acceptable_dual_inf_tol": 1e-6,
    "acceptable_constr_viol_tol": 1e-4,
    "acceptable_compl_inf_tol": DEFAULTS["compl_inf_tol"],
}
"""After a solve that went to and fro: costs at their least to a residual of 1e-6. Where they
are flat this goes on for ever in small steps, each of which leaves the constraints again.
"""

FEASIBLE: dict[str, Any] = {
    "mu_init": 1e-12,
    "bound_mult_init_method": "mu-based",
    **dict.fromkeys(_PUSHES, 1e-9),
    "acceptable_iter": 1,
    **{f"acceptable_{n}tol": 1e20 for n in ("", "dual_inf_", "compl_inf_", "obj_change_")},
    "acceptable_constr_viol_tol": 1e-8,
    "max_iter": 30,
}
"""Back to the constraints by the shortest steps (Gauss-Newton's, of least norm), whatever that
costs: beside the constraints it costs next to nothing.
"""

NEAREST: dict[str, Any] = {
    **FEASIBLE,
    "mu_init": 1e-6,
    "mu_strategy": "adaptive",
    **dict.fromkeys(_PUSHES, 1e-6),
    "max_iter": 60,
}
"""The same where limits that are active have to be left: a barrier that is lower holds them."""

Start: TypeAlias = Literal[
    "cold",
    "adaptive",
    "near",
    "warm",
    "corrector",
    "last",
    "restored",
    "finer",
    "damped",
    "feasible",
    "nearest",
]
STARTS: dict[Start, dict[str, Any]] = {
    "cold": WANDERING,
    "adaptive": {**WANDERING, **ADAPTIVE},
    "near": {**WANDERING, **NEAR},
    "warm": {**WANDERING, **WARM},
    "corrector": CORRECTOR,
    "last": LAST,
    "restored": RESTORED,
    "finer": FINER,
    "damped": CONVERGED,
    "feasible": FEASIBLE,
    "nearest": NEAREST,
}
