"""The page of ``pam-ocp bench``: data, muscle, plant, motion, control and export by hand and eye.

A thin room above the verbs. Needs ``pip install pam_ocp[bench]``; docs/bench.md has a developer's
section.
"""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
