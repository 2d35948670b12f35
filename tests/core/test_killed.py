"""kill -9 at random moments: see tests/killed.py, which goes on for as long as one likes."""

import random
import sys

import pytest
from killed import loop

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]


@pytest.mark.parametrize("command", ["export", "simulate_many"])
def test_what_kill_9_leaves_is_whole_and_the_next_run_goes_on(command):
    assert loop(command, 2, random.Random()) == []
