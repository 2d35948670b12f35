"""A sample of benchmarks/plan_study.py: random tasks solved from the planner's own guess, and ones
that cannot be, each naming a true conflict.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import plan_study as study

pytestmark = pytest.mark.slow


@pytest.mark.filterwarnings("ignore::pam_ocp.muscles.ValidityWarning")
@pytest.mark.parametrize("seed", [1, 3])
def test_a_random_feasible_task_is_solved_and_verified(seed):
    task = study.random_task(np.random.default_rng([5, seed]))
    plan, error = study.solve(task)
    assert error is None, task.words
    assert plan.verified, plan.verdict


@pytest.mark.filterwarnings("ignore::pam_ocp.muscles.ValidityWarning")
@pytest.mark.parametrize(
    ("kind", "seed"), [("no time", 1), ("no pressure", 3), ("place taken", 7), ("no budget", 4)]
)
def test_an_infeasible_task_names_a_true_conflict(kind, seed):
    task = study.infeasible_task(np.random.default_rng([6, seed]), kind)
    task.arguments["starts"] = 1
    plan, error = study.solve(task)
    assert plan is None, task.words
    assert error.plan.conflicts
    assert study.conflict_is_true(error)
