"""Arguments of another kind than the signature says, named once a call has failed by them.

Nothing is refused beforehand: what works, works. But where Python's own words would come out of the
depth of a call (``'int' object is not iterable``), the signature tells whose fault it is.
"""

from __future__ import annotations

import builtins
import functools
import inspect
import numbers
import reprlib
import sys
import types
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from .errors import with_article
from .exceptions import InputError, PamError, nearest

F = TypeVar("F", bound=Callable[..., Any])
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
