"""Classes of laws that are made at run time, so that they can be pickled."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, field, fields, make_dataclass
from typing import Any, cast

from ..law import ForceLaw

__all__ = ["copied_fields", "made_law"]


def copied_fields(law: type[ForceLaw]) -> dict[str, Any]:
    """The fields of a law by name, made anew for another class."""
    return {
        f.name: field(metadata=f.metadata)
        if f.default is MISSING
        else field(default=f.default, metadata=f.metadata)
        for f in fields(law)
    }


def made_law(
    class_name: str,
    coefficients: Mapping[str, Any],
    *,
    remake: tuple[Callable[..., type[ForceLaw]], tuple[Any, ...]] | None = None,
    **members: Any,
) -> type[ForceLaw]:
    """A frozen dataclass of this name with ForceLaw as its base."""
    if remake is not None:  # classes made at run time are pickled as the call that makes them
        members["made_by"] = remake
        members["__reduce__"] = lambda law: (_remade, (*remake, tuple(law.values.values())))
    return cast(
        type[ForceLaw],
        make_dataclass(
            class_name,
            [(n, float, f) for n, f in coefficients.items()],
            bases=(ForceLaw,),
            namespace={"__doc__": members["title"], "__module__": __name__, **members},
            frozen=True,
        ),
    )


def _remade(factory: Callable[..., type[ForceLaw]], arguments: Any, values: Any) -> ForceLaw:
    return factory(*arguments)(*values)
