"""Planning problems as files: TOML with units in the values becomes the arguments of plan."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import casadi as ca

from ...core.errors import InputError, UnknownNameError, with_kinds
from ...core.files import read_toml, reading
from ...core.quantities import known_keys, pair, quantity, table
from ...judge.statement import TIME, Avoid, Constraint, Phase, Profile, Stop, subject
from ...plants.plant import Plant
from ...plants.plant_file import plant_of, require_allowed
from ...simulation.reducers import LONGEST, OPERATORS
from ..transcription.mesh import Arcs, Collocation, Shooting
from .problem import budget

_METHODS = {kind.__name__: kind for kind in (Collocation, Shooting, Arcs)}
_STOP = ("rest", "dwell", "within")


@with_kinds
def load_problem(path: str | Path, *, allow_code: bool = False) -> tuple[Plant, dict[str, Any]]:
    """Read a planning problem: (plant, arguments), for ``pam_ocp.plan(plant, **arguments)``.

    The file's keys are the arguments of :func:`pam_ocp.plan`, and ``plant``, a table as
    :func:`pam_ocp.plants.plant_file.plant_of` reads it. Values are numbers in SI or texts with a
    unit, as "15 mm"; a range is ``[low, high]`` or ``{ min = low, max = high }`` with either left
    out (durations: the latter). See docs/planning.md for every key.

    allow_code : the file may run code: a plant named FILE.py:NAME, and options of the solver that
        load libraries or write files. Without it they are refused; a file of others cannot do harm.

    Raises InputError that names the file, the key, the value and what is allowed.

    Examples
    --------
    >>> from pathlib import Path
    >>> text = '''
    ... stops = [{ x = "-10 mm" }, { x = "10 mm" }]
    ... plant = { arrangement = "AntagonisticSlide", muscle = "DMSP-20-300" }
    ... '''
    >>> _ = Path("problem.toml").write_text(text)
    >>> found, arguments = pam.planning.load_problem("problem.toml")
    >>> pam.plan(found, **arguments).verified
    True
    """
    source = Path(path)
    content = read_toml(source)
    with reading(path, "a planning problem", "docs/planning.md tells every key"):
        known_keys("the problem", content, ("plant", *_READERS))
        for key in ("plant", "stops"):
            if key not in content:
                raise InputError(f"{key} is missing")
        plant = plant_of(content.pop("plant"), "plant", source.parent, allow_code=allow_code)
        return plant, plan_arguments(plant, content, allow_code=allow_code)


def plan_arguments(
    plant: Plant, content: Mapping[str, Any], *, allow_code: bool = False
) -> dict[str, Any]:
    """Arguments of :func:`pam_ocp.plan` from the keys of a problem file, without its plant."""
    known_keys("the problem", content, _READERS)
    if "stops" not in content:
        raise InputError("stops is missing")
    _require_harmless("options", content.get("options", {}), allow_code)
    return {k: _READERS[k](plant, k, v) for k, v in content.items()}


# ---- values -------------------------------------------------------------------------------------
def _wanted(plant: Plant, name: str, where: str, value: Any) -> Any:
    """A number, or a pair of them."""
    unit = subject(plant, name)[0].unit
    if isinstance(value, list | Mapping):
        return pair(where, value, unit)
    return quantity(where, value, unit)


def _profile(where: str, value: Mapping[str, Any], unit: str) -> Profile:
    known_keys(where, value, ("t", "values", "smooth"))
    columns = {}
    for key, of in (("t", "s"), ("values", unit)):
        rows = value.get(key)
        if not isinstance(rows, list):
            raise InputError(f"{where}.{key} = {rows!r}: give a list of times and one of values")
        columns[key] = [quantity(f"{where}.{key}[{i}]", v, of) for i, v in enumerate(rows)]
    smooth = _flag(None, f"{where}.smooth", value.get("smooth", False))
    return Profile(columns["t"], columns["values"], smooth)


def _bound(plant: Plant, name: str, where: str, value: Any) -> Any:
    """As _wanted, and each side may be a profile over time."""
    unit = subject(plant, name)[0].unit
    if not isinstance(value, Mapping):
        return _wanted(plant, name, where, value)
    if "t" in value or "values" in value:
        return _profile(where, value, unit)
    if not any(isinstance(side, Mapping) for side in value.values()):
        return pair(where, value, unit)
    known_keys(where, value, ("min", "max"))
    sides: list[Any] = []
    for side in ("min", "max"):
        end = value.get(side)
        if isinstance(end, Mapping):
            sides.append(_profile(f"{where}.{side}", end, unit))
        else:
            sides.append(None if end is None else quantity(f"{where}.{side}", end, unit))
    return tuple(sides)


def _seconds(plant: Plant, where: str, value: Any) -> Any:
    """Seconds, a range, or "free"."""
    if value == "free":
        return None
    if not isinstance(value, Mapping):
        return quantity(where, value, "s")
    low, high = pair(where, value, "s")
    if low is None or high is None:
        raise InputError(f"{where} = {dict(value)!r}: give both min and max, or 'free'")
    return low, high


# ---- keys ----------------------------------------------------------------------------------------
def _flag(plant: Plant | None, where: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{where} = {value!r}: give true or false")
    return value


def _number(plant: Plant, where: str, value: Any) -> float:
    return quantity(where, value)


def _count(plant: Plant, where: str, value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise InputError(f"{where} = {value!r}: give a whole number")
    return value


def _cyclic(plant: Plant, where: str, value: Any) -> Any:
    if value not in (True, False, "mirrored"):
        raise InputError(f"{where} = {value!r}: give true, false or 'mirrored'")
    return value


def _tables(where: str, value: Any) -> list[tuple[str, Mapping[str, Any]]]:
    """(where, table) of each entry of an array of tables."""
    if not isinstance(value, list):
        raise InputError(f"{where} = {value!r}: give a list of tables, each under [[{where}]]")
    return [(f"{where}[{i}]", table(f"{where}[{i}]", v)) for i, v in enumerate(value, start=1)]


def _stops(plant: Plant, where: str, value: Any) -> list[Stop]:
    stops = []
    for at, content in _tables(where, value):
        misplaced = [k for k in content if k in _READERS and k not in _STOP]
        if misplaced:
            raise InputError(
                f"{at} holds {misplaced[0]!r}, a key of the whole problem; in TOML it must stand "
                "above the first [table] or [[table]]"
            )
        names = {n: v for n, v in _flat(content) if n not in _STOP}
        more: dict[str, Any] = {}
        if "rest" in content:
            more["rest"] = _flag(plant, f"{at}.rest", content["rest"])
        if "dwell" in content:
            more["dwell"] = _seconds(plant, f"{at}.dwell", content["dwell"])
        if "within" in content:
            more["within"] = quantity(f"{at}.within", content["within"])
        stops.append(Stop({n: _wanted(plant, n, f"{at}.{n}", v) for n, v in names.items()}, **more))
    return stops


def _flat(content: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Names with values; TOML reads muscle1.pressure without quotes as a table in a table."""
    found = []
    for name, value in content.items():
        if isinstance(value, Mapping) and not set(value) <= _INNER:
            found += [(f"{name}.{inner}", v) for inner, v in _flat(value)]
        else:
            found.append((name, value))
    return found


_INNER = {"min", "max", "t", "values", "smooth", "aim", "weight"}
"""Keys of tables that are values."""


def _duration(plant: Plant, where: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_seconds(plant, f"{where}[{i}]", v) for i, v in enumerate(value, start=1)]
    return _seconds(plant, where, value)


def _word_or_numbers(plant: Plant, where: str, value: Any) -> str | dict[str, float]:
    if isinstance(value, str):
        return value
    return {n: quantity(f"{where}.{n}", v) for n, v in table(where, value).items()}


def _bounds(plant: Plant, where: str, value: Any) -> dict[str, Any]:
    return {n: _bound(plant, n, f"{where}.{n}", v) for n, v in _flat(table(where, value))}


def _constraints(plant: Plant, where: str, value: Any) -> list[Constraint | Avoid]:
    found: list[Constraint | Avoid] = []
    for at, content in _tables(where, value):
        if "avoid" in content:
            known_keys(at, content, ("avoid", "name"))
            region = {}
            for name, sides in _flat(table(f"{at}.avoid", content["avoid"])):
                unit = "s" if name == "time" else subject(plant, name)[0].unit
                if not (isinstance(sides, list) and len(sides) == 2):
                    raise InputError(f"{at}.avoid.{name} = {sides!r}: give [centre, half width]")
                centre, width = (quantity(f"{at}.avoid.{name}", v, unit) for v in sides)
                region[name] = (centre, width)
            found.append(Avoid(region, **{k: v for k, v in content.items() if k == "name"}))
            continue
        known_keys(at, content, ("expression", "min", "max", "name", "nominal", "unit"))
        unit = str(content.get("unit", "1"))
        low, high, nominal = (
            quantity(f"{at}.{k}", content[k], unit) if k in content else None
            for k in ("min", "max", "nominal")
        )
        expression = expression_of(plant, content.get("expression"), f"{at}.expression")
        name = str(content.get("name", content["expression"]))
        found.append(Constraint(expression, low, high, name, nominal or 1.0, unit))
    return found


def _phases(plant: Plant, where: str, value: Any) -> list[Phase]:
    found = []
    for at, content in _tables(where, value):
        known_keys(at, content, ("duration", "bounds", "constraints"))
        duration = content.get("duration", "free")
        found.append(
            Phase(
                _seconds(plant, f"{at}.duration", duration),
                _bounds(plant, f"{at}.bounds", content.get("bounds", {})),
                _constraints(plant, f"{at}.constraints", content.get("constraints", [])),
            )
        )
    return found


def _track(plant: Plant, where: str, value: Any) -> dict[str, Any]:
    return {n: _aim(plant, n, f"{where}.{n}", v) for n, v in _flat(table(where, value))}


def _aim(plant: Plant, name: str, where: str, value: Any) -> Any:
    """A number, a profile, or either with a weight."""
    unit = subject(plant, name)[0].unit
    if not isinstance(value, Mapping):
        return quantity(where, value, unit)
    if "aim" in value:
        known_keys(where, value, ("aim", "weight"))
        aim = _aim(plant, name, f"{where}.aim", value["aim"])
        return aim, quantity(f"{where}.weight", value.get("weight", 1.0))
    return _profile(where, value, unit)


def _budgets(plant: Plant, where: str, value: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for term, most in table(where, value).items():
        unit = budget(plant, term, 0.0)[0].shown.unit
        at = f"{where}.{term}"
        listed = isinstance(most, list | Mapping)
        found[term] = pair(at, most, unit) if listed else quantity(at, most, unit)
    return found


def _design(plant: Plant, where: str, value: Any) -> dict[str, Any]:
    return {
        n: pair(f"{where}.{n}", v, plant.variable(n).unit) for n, v in _flat(table(where, value))
    }


def _expression(plant: Plant, where: str, value: Any) -> ca.SX:
    return expression_of(plant, value, where)


def _method(plant: Plant, where: str, value: Any) -> Any:
    given = dict(table(where, value))
    kind = given.pop("kind", "Collocation")
    if kind not in _METHODS:
        raise UnknownNameError(f"{where}.kind", kind, _METHODS)
    made = _METHODS[kind]
    known_keys(f"{where} ({kind})", given, [f.name for f in fields(made)])
    return made(**given)


def _text(plant: Plant, where: str, value: Any) -> str:
    if not isinstance(value, str):
        raise InputError(f"{where} = {value!r}: give a text in quotes")
    return value


_HARMLESS = re.compile(r"(?!.*(lib|file))[a-z]\w*", re.IGNORECASE)
"""Options of solvers that neither load libraries nor write files."""


def _require_harmless(where: str, value: Any, allow_code: bool) -> None:
    for name, given in table(where, value).items():
        if isinstance(given, dict | list) or not _HARMLESS.fullmatch(name):
            require_allowed(f"{where}.{name} may load a library or write a file", allow_code)


def _options(plant: Plant, where: str, value: Any) -> dict[str, Any]:
    return dict(table(where, value))


_READERS: dict[str, Callable[[Plant, str, Any], Any]] = {
    "stops": _stops,
    "cyclic": _cyclic,
    "duration": _duration,
    "minimise": _word_or_numbers,
    "bounds": _bounds,
    "rest": _flag,
    "memory": _word_or_numbers,
    "phases": _phases,
    "constraints": _constraints,
    "track": _track,
    "budgets": _budgets,
    "design": _design,
    "integrand": _expression,
    "final": _expression,
    "method": _method,
    "tolerance": _number,
    "starts": _count,
    "solver": _text,
    "compiled": _flag,
    "options": _options,
}
"""How each key of a problem is read."""


_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "abs": (1, ca.fabs),
    "sqrt": (1, ca.sqrt),
    "exp": (1, ca.exp),
    "log": (1, ca.log),
    "sin": (1, ca.sin),
    "cos": (1, ca.cos),
    "tan": (1, ca.tan),
    "tanh": (1, ca.tanh),
    "min": (2, ca.fmin),
    "max": (2, ca.fmax),
}
"""What may be called: number of arguments, and the function."""


def expression_of(plant: Plant, text: Any, where: str = "expression") -> ca.SX:
    """A scalar expression of the plant's variables, from text.

    Numbers (SI), + - * / **, brackets, names of variables, ``der(STATE)``, ``time`` (since the
    motion began) and the functions abs, sqrt, exp, log, sin, cos, tan, tanh, min, max. Nothing in
    the text is executed. Raises InputError naming what is not understood.
    """
    if not isinstance(text, str):
        raise InputError(f"{where} = {text!r}: give a text, as 'muscle1.force - muscle2.force'")
    if len(text) > LONGEST:
        raise InputError(
            f"{where} has {len(text)} characters, {LONGEST} are allowed; write it in Python"
        )
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise InputError(f"{where} = {text!r} is no expression") from None
    return ca.SX(_value(plant, tree, f"{where} = {text!r}"))


def _value(plant: Plant, node: ast.expr, where: str) -> Any:
    if (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and not isinstance(node.value, bool)
    ):
        return ca.SX(node.value)
    if isinstance(node, ast.Name | ast.Attribute):
        name = ast.unparse(node)
        return TIME if name == "time" else plant.expression(name)
    if isinstance(node, ast.BinOp | ast.UnaryOp) and type(node.op) in OPERATORS:
        parts = [node.operand] if isinstance(node, ast.UnaryOp) else [node.left, node.right]
        return OPERATORS[type(node.op)](*(_value(plant, part, where) for part in parts))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        return _called(plant, node.func.id, node.args, where)
    raise InputError(
        f"{where}: {ast.unparse(node)!r} is not understood; use numbers, + - * / **, names of "
        f"variables, time, der(STATE) and {', '.join(_FUNCTIONS)}"
    )


def _called(plant: Plant, name: str, arguments: list[ast.expr], where: str) -> Any:
    if name == "der" and len(arguments) == 1:
        return plant.expression(f"der({ast.unparse(arguments[0])})")
    if name not in _FUNCTIONS:
        raise UnknownNameError(f"function in {where}", name, ["der", *_FUNCTIONS])
    count, function = _FUNCTIONS[name]
    if len(arguments) != count:
        raise InputError(f"{where}: {name} takes {count} arguments, not {len(arguments)}")
    return function(*(_value(plant, a, where) for a in arguments))
