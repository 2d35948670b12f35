"""Arguments go on under their former names, and say the new one."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def renamed(since: str, **names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Take each ``old=new`` of ``names`` under its old name, with a DeprecationWarning."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            for old in names.keys() & kwargs.keys():
                new, name = names[old], function.__name__
                warnings.warn(
                    f"{name}({old}=...) is {name}({new}=...) since version {since}",
                    DeprecationWarning,
                    stacklevel=2,
                )
                kwargs.setdefault(new, kwargs.pop(old))
            return function(*args, **kwargs)

        return called

    return decorate
