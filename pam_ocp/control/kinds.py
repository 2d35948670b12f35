"""Controllers and estimators by the name that a problem file gives as their ``kind``; blocks by the
class that they are made of.

A controller is called with the model (a Plant) and its own arguments by name; those of one about an
equilibrium hold ``at``, which is the rest that a run starts from unless a file says another.

The file that defines a block's equations enters them here under the name of the class::

    @BLOCKS.register("StateFeedback")
    def state_feedback(controller: StateFeedback) -> Block: ...

The function gives the law alone. What all have in common (missing measurements, limits, switching
on and off) is put around it by :func:`guarded`. A law may take these inputs, which the guard knows:

``sent.NAME``  the command NAME that acted since the last sample
``active``     1 while the law's own commands acted, 0 while something else was sent
``limited``    1 where a limit of the guard kept the last command from being what was asked for
``held_back``  the same, of limits that the law cannot know: rates, and ranges narrower than the
               command's own
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.block import Block
from ..core.errors import InputError, UnknownNameError, kind_of
from ..core.registry import Registry

Array: TypeAlias = NDArray[np.float64]
CONTROLLERS: Registry[Callable[..., Any]] = Registry("controller", __package__)
ESTIMATORS: Registry[Callable[..., Any]] = Registry("estimator", f"{__package__}.estimators")
BLOCKS: Registry[Callable[..., Block]] = Registry("block", __package__)
"""The functions that make a block of a controller's law, by the name of its class."""


ACTIVE, LIMITED, HELD_BACK, SENT = "active", "limited", "held_back", "sent."
ESTIMATE = "estimate."
"""What an estimator's outputs begin with."""
BEFORE = ".before"
"""``sent.NAME.before1``: memory of a command on its way to act."""
TOLD = (ACTIVE, LIMITED, HELD_BACK, "sent", "enable", "wanted", "ahead", "place")
"""First parts of names of inputs that are no measurements: references, and what the guard tells."""
LARGEST = 1e30
"""A number beyond is none [SI]; single precision holds it."""


def _kind(controller: Any) -> str | None:
    return next((k.__name__ for k in type(controller).__mro__ if k.__name__ in BLOCKS), None)


def takes(controller: Any, option: str) -> bool:
    """Whether the maker of this controller's block has the option."""
    kind = None if isinstance(controller, Block) else _kind(controller)
    return kind is not None and option in list(BLOCKS.arguments(kind))[1:]


def law_of(controller: Any, **options: Any) -> Block:
    """The block of a controller's law alone. Raises InputError for what has none."""
    if isinstance(controller, Block):
        if options:
            raise InputError(f"{controller.name} is a block already; leave out {min(options)}")
        return controller
    kind = _kind(controller)
    if kind is not None:
        known = list(BLOCKS.arguments(kind))[1:]
        for option in options:
            if option not in known:
                raise UnknownNameError(f"option of a {kind}", option, known)
        return BLOCKS[kind](controller, **options)
    raise InputError(
        f"{kind_of(controller)} is not known as a block; there are {', '.join(BLOCKS)}"
    )
