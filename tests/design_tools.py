"""What the tests of designs share."""

import importlib.util
import sys
from pathlib import Path


class Fixed:
    """A controller whose answer does not depend on what it measures."""

    def __init__(self, answer):
        self.answer = answer
        self.seen = []

    def reset(self):
        self.seen = []

    def __call__(self, t, measured):
        self.seen.append(dict(measured))
        return self.answer(t) if callable(self.answer) else self.answer


def weakened(plant, share):
    law = [f"muscle1.{a}" for a in ("a1", "a2", "a4", "a5", "a6")]
    return {n: share * plant.variable(n).start for n in law}


def example(name):
    path = Path(__file__).parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
