"""What each component conserves or loses, over random motions; the books are kept in
``benchmarks/balance.py`` by equations of their own, the study has 200 motions of each.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

import pam_ocp as pam

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import balance
import physics_study


@pytest.mark.parametrize("name", physics_study.COMPONENTS)
def test_the_books_of_random_motions_close_and_nothing_is_gained(name):
    draw, sheet = np.random.default_rng(2027), physics_study.accounted(name)
    for _ in range(2):
        for closing in sheet.closed(*physics_study.random_motion(sheet.plant, draw)):
            assert closing.missing <= balance.TOLERANCE, closing
            assert closing.least >= -balance.NEGATIVE, closing


def test_books_with_a_wrong_number_do_not_close():
    muscle, loss = pam.muscle(balance.MUSCLE), pam.losses.CoulombFriction(30.0, speed=5e-3)
    plant = pam.HangingLoad(muscle, 10.0, damping=60.0, losses=loss)
    wrong = pam.losses.CoulombFriction(30.1, speed=5e-3)
    sheet = balance.Books(plant, balance.ledgers(plant, muscle, None, wrong))
    motion = physics_study.random_motion(plant, np.random.default_rng(1))
    missing = {c.ledger: c.missing for c in sheet.closed(*motion)}
    assert missing["motion"] < balance.TOLERANCE < 1e-4 < missing["loss"]
