"""What can go wrong, and checks of arguments that say so.

Each message names the argument, the value seen, the range allowed and the remedy.
"""

from __future__ import annotations

import builtins
import functools
import inspect
import math
import numbers
import reprlib
import sys
import types
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from numbers import Integral
from typing import (
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import NDArray

from .exceptions import ExportError as ExportError
from .exceptions import FitError as FitError
from .exceptions import InputError as InputError
from .exceptions import OutOfTime as OutOfTime
from .exceptions import PamError as PamError
from .exceptions import PlanError as PlanError
from .exceptions import PlanWarning as PlanWarning
from .exceptions import SimulationError as SimulationError
from .exceptions import UnknownNameError as UnknownNameError
from .exceptions import VibrationError as VibrationError
from .exceptions import WriteError as WriteError
from .exceptions import nearest
from .quantities import doubt, is_quantity, meant_within, quantity

LARGEST_COUNT = 2**63 - 1
LEAST_TOLERANCE = 1e-14
"""Some fifty times the spacing of numbers; below, an integrator counts rounding errors."""


def with_article(noun: str) -> str:
    """A noun with its article: ``an input``, ``a state``."""
    return f"a{'n' if noun[0] in 'aeioAEIO' else ''} {noun}"


def kind_of(value: Any) -> str:
    """The kind of a value for a sentence: ``an int``, ``a Plan``, ``None``."""
    return "None" if value is None else with_article(type(value).__name__)


def require_instance(
    argument: str, value: Any, kinds: type | tuple[type, ...], remedy: str, none: bool = False
) -> Any:
    """``value``, or an InputError when it is none of ``kinds`` (with ``none``: nor None)."""
    if isinstance(value, kinds) or (none and value is None):
        return value
    raise InputError(f"{argument} is {kind_of(value)}: {remedy}")


def require_count(argument: str, value: Any, least: int = 1, most: int | None = None) -> int:
    """``value`` as an int, or an InputError when it is no whole number of this range."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if whole and abs(value) > LARGEST_COUNT:
        raise InputError(f"{argument} is larger than any count here (2^63 - 1)")
    if not whole or value < least or (most is not None and value > most):
        allowed = f">= {least}" if most is None else f"from {least} to {most}"
        raise InputError(f"{argument} = {value!r}: give a whole number {allowed}")
    return int(value)


def require_flag(argument: str, value: Any, none: str = "") -> bool | None:
    """``value``, or an InputError when it is neither True nor False (with ``none``, which says
    what that means: nor None).
    """
    if isinstance(value, bool) or (none and value is None):
        return value
    allowed = f"True, False or None ({none})" if none else "True or False"
    raise InputError(f"{argument} = {value!r}: give {allowed}")


def require_names(argument: str, value: Any) -> list[str]:
    """One name or several as a list, or an InputError for what holds no names."""
    given = [value] if isinstance(value, str) else value
    names = list(given) if isinstance(given, Iterable) else [given]
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"{argument} = {value!r}: give a name in quotes, or a list of them")
    return names


def require_tolerance(argument: str, value: Any) -> float:
    """``value`` as a relative tolerance of an integrator: numbers have 16 digits."""
    if not LEAST_TOLERANCE <= (given := require_positive(argument, value)) < 1:
        raise InputError(
            f"{argument} = {given:g} must lie in {LEAST_TOLERANCE:g} .. 1 (numbers have 16 "
            "digits); 1e-10 .. 1e-4 are usual"
        )
    return given


def require_number(argument: str, value: Any, unit: str = "") -> float:
    """``value`` as a float, infinite and NaN among them, or an InputError when it is no number.

    A text such as "20 mm" is a number too, where ``unit`` is known.
    """
    if type(value) is float:
        return value
    if is_quantity(value):
        return quantity(argument, value, *([unit] if unit else []))
    try:
        if isinstance(value, bool | np.bool_):
            value = bool(value)
            raise TypeError
        if getattr(value, "ndim", 0) > 0:
            raise TypeError
        return float(value)
    except OverflowError:
        raise InputError(f"{argument} is larger than any float (1.8e308)") from None
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{argument} = {value!r} is not a number; give a float") from None


def require_finite(argument: str, value: Any, unit: str = "") -> float:
    """``value`` as a float, or an InputError when it is not a finite number, see
    :func:`require_number`.
    """
    number = require_number(argument, value, unit)
    if not math.isfinite(number):
        kind = f"number {unit}" if unit not in ("", "1") else "number"
        raise InputError(f"{argument} = {number} must be a finite {kind}")
    return number


def require_numbers(
    argument: str,
    value: Any,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    *,
    doubted: bool = False,
) -> Any:
    """``value`` as a float, or as an array of floats, all finite and from ``low`` to ``high``
    [unit]; CasADi expressions pass as they are.

    Numbers may be texts such as "3 bar", in lists, too. doubted : warn (UnitWarning) of a size far
    from any usual one. Raises InputError.
    """
    if type(value).__module__.startswith("casadi"):
        return value
    scalar = isinstance(value, float) or is_quantity(value)
    array = None if scalar else _array(argument, value)
    if array is None or array.ndim == 0:
        found: Any = require_finite(argument, value, unit)
        worst, place = found, ""
    else:
        found = _floats(argument, array, unit)
        outside = ~(np.isfinite(found) & (found >= low) & (found <= high)).ravel()
        if not found.size:
            return found
        row = int(np.argmax(outside if outside.any() else np.abs(found).ravel()))
        worst, place = float(found.flat[row]), f": sample {row}"
        if not math.isfinite(worst):
            raise InputError(f"{argument}{place} is {worst}; all must be finite")
    if not low <= worst <= high:
        ends = f">= {low:g}" if high == math.inf else f"within {low:g} .. {high:g}"
        shown = f"{argument}{place} = {worst:g}" + (f" {unit}" if unit not in ("", "1") else "")
        hint = meant_within(worst, unit, low, high) if unit else ""
        raise InputError(f"{shown} must be {ends}{hint}")
    if doubted:
        doubt(argument, found, unit)
    return found


def broadcast(**given: Any) -> tuple[NDArray[np.float64], ...]:
    """Numbers and arrays, broadcast against each other, or an InputError with their shapes."""
    arrays = {name: np.asarray(value, float) for name, value in given.items()}
    try:
        return tuple(np.broadcast_arrays(*arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} has shape {a.shape}" for name, a in arrays.items())
        raise InputError(f"{shapes}: give one of each, or arrays that broadcast") from None


def require_ends(
    argument: str, ends: Any, unit: str = "", *, open_ends: bool = False
) -> tuple[float, float]:
    """(low, high) of numbers or texts such as "3 bar"; ends may be infinite. Raises InputError.

    open_ends : None stands for an infinite end, and both may be equal.
    """
    if not isinstance(ends, list | tuple | np.ndarray) or len(ends) != 2:
        raise InputError(f"{argument} = {ends!r}: give (low, high)")
    low, high = (
        infinite
        if open_ends and end is None
        else end
        if end in (-math.inf, math.inf)
        else require_finite(argument, end, unit)
        for end, infinite in zip(ends, (-math.inf, math.inf), strict=True)
    )
    if not (low < high or (open_ends and low == high)):
        raise InputError(f"{argument} = {ends!r} must be (low, high), the first the smaller")
    return float(low), float(high)


def _array(argument: str, value: Any) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except ValueError:
        raise InputError(f"{argument}: rows differ in length; give one for each place") from None
    return np.asarray(value, dtype=object) if array.dtype.kind in "US" else array


def _floats(argument: str, array: NDArray[Any], unit: str) -> NDArray[np.float64]:
    """An array of floats; its cells may be texts."""
    if array.dtype.kind in "fiu":
        return np.asarray(array, dtype=float)
    try:
        if array.dtype.kind != "O":
            raise InputError(f"these are {array.dtype}")
        flat = [require_finite(f"sample {i}", v, unit) for i, v in enumerate(array.flat)]
    except InputError as error:
        raise InputError(f"{argument} does not hold numbers only: {error}") from None
    return np.array(flat, dtype=float).reshape(array.shape)


def require_positive(argument: str, value: Any, unit: str = "", zero: bool = False) -> float:
    """``value`` as a float, or an InputError when it is not > 0 (>= 0 with ``zero``)."""
    number = require_finite(argument, value, unit)
    if number < 0 or (number == 0 and not zero):
        bound = ">= 0" if zero else "> 0"
        raise InputError(f"{argument} = {number:g} {unit} must be {bound}".replace("  ", " "))
    return number


# ---- arguments of another kind than the signature says -------------------------------------------
# Nothing is refused beforehand: what works, works. But where Python's own words would come out of
# the depth of a call (``'int' object is not iterable``), the signature tells whose fault it is.
F = TypeVar("F", bound=Callable[..., Any])
P = ParamSpec("P")
R = TypeVar("R")
RAW = (TypeError, ValueError, AttributeError, LookupError, RuntimeError)
"""What Python and its libraries raise of a value that is of the wrong kind."""
MOST = 100
"""Items of a sequence that are looked at."""
SHOWN = reprlib.Repr()
SHOWN.maxstring = SHOWN.maxother = 60
WORDS = {
    str: "a text",
    int: "a whole number",
    float: "a number",
    bool: "True or False",
    Any: "a value",
}
NAMED = "_names_arguments"
"""Of a function that :func:`with_kinds` made."""
ARRAY_LIKE = {"_SupportsArray", "_Buffer", "_NestedSequence"}
"""Parts of NumPy's hint for what makes an array."""
SERIES = (Sequence, Iterable, Collection, list, tuple)


class _Names(dict[str, Any]):
    """Names of annotations; those imported for type checkers alone are classes of the face,
    else Any.
    """

    def __missing__(self, name: str) -> Any:
        known = getattr(sys.modules.get(__name__.partition(".")[0]), name, Any)
        return getattr(builtins, name, known if isinstance(known, type) else Any)


def blamed(function: Callable[..., Any], args: Any, kwargs: Any, error: Exception) -> Exception:
    """An error that names the argument which is unknown or not of its kind; ``error`` where all
    are.
    """
    if isinstance(error, PamError):
        return error
    signature = inspect.signature(function)
    try:
        require_known_keywords(function.__qualname__, signature, kwargs)
        given = signature.bind(*args, **kwargs).arguments
    except TypeError as unbound:
        return unbound if kwargs.keys() - signature.parameters.keys() else error
    names = _Names(getattr(inspect.unwrap(function), "__globals__", {}))
    for name, value in given.items():
        parameter = signature.parameters[name]
        variadic = parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        if variadic or parameter.annotation is parameter.empty:
            continue
        hint = _hint(parameter.annotation, names)
        if not _fits(value, hint):
            return InputError(f"{name} = {SHOWN.repr(value)}: give {_words(hint)}")
    return error


def with_kinds(made: F) -> F:
    """A function, or a class, that names the argument which is of the wrong kind."""
    if isinstance(made, type):
        own = vars(made).get("__init__")
        if isinstance(own, types.FunctionType) and not getattr(own, NAMED, False):
            setattr(made, "__init__", with_kinds(own))  # noqa: B010
        return made

    @functools.wraps(made)
    def called(*args: Any, **kwargs: Any) -> Any:
        try:
            return made(*args, **kwargs)
        except RAW as error:
            said = blamed(made, args, kwargs, error)
            if said is error:
                raise
            raise said from error

    setattr(called, NAMED, True)
    return cast("F", called)


def require_known_keywords(
    name: str, signature: inspect.Signature, given: Mapping[str, Any]
) -> None:
    """TypeError that names the nearest keywords, where one is given that a function has not."""
    known = signature.parameters
    wrong = next((n for n in given if n not in known), None)
    if wrong is None or any(p.kind is p.VAR_KEYWORD for p in known.values()):
        return
    near = nearest(wrong, known, 0.6)
    has = " or ".join(near) if near else ", ".join(n for n in known if n != "self")
    raise TypeError(
        f"{name.removesuffix('.__init__')}() has no argument {wrong!r}; "
        + (f"did you mean {has}?" if near else f"it has {has}")
    )


def renamed(since: str, **names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Arguments go on under their former names: each ``old=new`` of ``names`` is taken under its
    old name, too, with a DeprecationWarning.
    """

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


def _hint(annotation: Any, names: _Names) -> Any:
    """A hint out of its text; Any where that needs what is imported for type checkers alone."""
    one = types.SimpleNamespace(__annotations__={"it": annotation})
    try:
        return get_type_hints(one, {}, names)["it"]
    except Exception:
        return Any


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of the kind that a hint says; True in doubt."""
    hint = getattr(hint, "__value__", hint)
    origin, of = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if hint is None or hint is type(None):
        return value is None
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in of)
    if origin is Literal:
        return any(type(value) is type(one) and value == one for one in of)
    kind = origin or hint
    if kind is float or kind is int:  # texts are quantities
        return isinstance(value, str | numbers.Number | np.ndarray) and not getattr(
            value, "ndim", 0
        )
    if kind is str:
        return isinstance(value, str)
    if isinstance(kind, type) and issubclass(kind, Mapping):
        pairs = value.items() if isinstance(value, Mapping) and of else ()
        fit = all(_fits(k, of[0]) and _fits(v, of[1]) for k, v in pairs)
        return isinstance(value, Mapping) and fit
    if kind in SERIES:
        return _is_series(value, of)
    if kind is Callable:
        return callable(value)
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return True
    return isinstance(value, kind)


def _is_series(value: Any, of: tuple[Any, ...]) -> bool:
    if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
        return False
    try:
        if iter(value) is value:
            return True  # an iterator, which is not to be used up
        items = list(value)[:MOST]
    except (TypeError, NotImplementedError):  # an array without dimensions, an expression
        return False
    return all(_fits(item, of[0]) for item in items) if of else True


def _words(hint: Any) -> str:
    """A kind in words: ``a text or None``."""
    if getattr(hint, "__name__", "") == "ArrayLike":  # NumPy 2.5 gives the alias a name
        return "numbers"
    origin, of = get_origin(hint), get_args(hint)
    if hint is None or hint is type(None):
        return "None"
    if origin in (Union, types.UnionType):
        if any(getattr(get_origin(one) or one, "__name__", "") in ARRAY_LIKE for one in of):
            return "numbers"
        return " or ".join(dict.fromkeys(map(_words, of)))
    if origin is Literal:
        return " or ".join(map(repr, of))
    kind = origin or hint
    if isinstance(kind, type) and issubclass(kind, Mapping):
        parts = [_words(one).removeprefix("a ") for one in of]
        return f"a mapping {{{': '.join(parts)}}}" if parts else "a mapping"
    if kind in SERIES:
        inner = _words(of[0]) if of and of[0] is not Any else "values"
        return f"a sequence of {inner.removeprefix('a ')}{'s' if inner in WORDS.values() else ''}"
    if kind is Callable:
        return "a function"
    name = getattr(kind, "__name__", str(kind))
    return WORDS.get(kind) or with_article(name)
