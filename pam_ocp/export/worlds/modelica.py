"""Modelica: a plant as a model, a muscle as a component with two flanges and a pneumatic port."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca

from ...core.atomic import atomic_path
from ...core.errors import ExportError, InputError
from ...core.files import require_ending
from ...core.stop import verb
from ...core.variables import Variable
from ...muscles.gas import AMBIENT_PRESSURE, GAS_CONSTANT, REFERENCE_TEMPERATURE, ConsistentVolume
from ...muscles.pneumatic_muscle import Muscle
from ...plants.alone import attached_alone
from ...plants.damping import Loss
from ...plants.feeds import IdealPressure
from ...plants.plant import Plant, require_plant
from .instructions import OPERATIONS, Instructions, instructions
from .registry import ENDINGS, WORLDS

ATOM, POWER, PRODUCT, SUM = 4, 3, 2, 1
"""How firmly a text holds together."""
LONG = 60
"""Letters, beyond which a part that is used twice gets a name; shorter ones are written again."""


_PLAIN = (
    *("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    *("floor", "ceil", "sign"),
)
FUNCTIONS = {
    **{name: f"{name}({{0}})" for name in _PLAIN},
    "fabs": "abs({0})",
    "fmin": "min({0}, {1})",
    "fmax": "max({0}, {1})",
    "atan2": "atan2({0}, {1})",
    "hypot": "sqrt(({0})^2 + ({1})^2)",
    "expm1": "(2*exp(({0})/2)*sinh(({0})/2))",
    "log1p": "log(1 + ({0}))",
}
OPERATORS = {
    "add": ("{} + {}", SUM, (SUM, PRODUCT)),
    "sub": ("{} - {}", SUM, (SUM, PRODUCT)),
    "mul": ("{}*{}", PRODUCT, (PRODUCT, POWER)),
    "div": ("{}/{}", PRODUCT, (PRODUCT, POWER)),
    "neg": ("-{}", SUM, (PRODUCT,)),
    "twice": ("2*{}", PRODUCT, (POWER,)),
    "inv": ("1/{}", PRODUCT, (POWER,)),
    "sq": ("{}^2", POWER, (ATOM,)),
    **dict.fromkeys(("pow", "constpow"), ("{}^{}", POWER, (ATOM, ATOM))),
}
"""{operation: (its text, how firmly that holds together, and how firmly its parts must)}."""
EITHER = "noEvent(if {0} then {1} else {2})"
_WORDS = """
algorithm and annotation assert block break class connect connector constant constrainedby der
discrete each else elseif elsewhen encapsulated end enumeration equation expandable extends external
false final flow for function if import impure in initial inner input loop model not operator or
outer output package parameter partial protected public pure record redeclare replaceable return
stream then true type when while within time abs acos asin atan atan2 ceil cos cosh exp floor log
max min sign sin sinh smooth sqrt sum tan tanh noEvent pre terminal sample delay cross size fill
zeros ones vector mod rem Real Integer Boolean String
"""
RESERVED = frozenset(_WORDS.split())
OWN = frozenset({"flange_a", "flange_b", "port", "length", "speed", "pressure", "volume"})
OWN |= {"mass", "R", "atmosphere", "temperature"}
"""Of the component, besides the variables of the muscle."""
CONNECTORS = """\
  connector Flange "a translational flange, as that of Modelica.Mechanics.Translational"
    Real s(unit = "m") "position";
    flow Real f(unit = "N") "force into the component";
  end Flange;

  connector PneumaticPort "air"
    Real p(unit = "Pa") "gauge pressure";
    flow Real m_flow(unit = "kg/s") "mass flow into the component";
  end PneumaticPort;
"""


@verb
def export_modelica(
    system: Plant | Muscle,
    path: str | os.PathLike[str],
    *,
    losses: Loss | Sequence[Loss] = (),
    name: str | None = None,
) -> Path:
    """Write a plant or a muscle as Modelica source; returns the path.

    A plant becomes a model with inputs and outputs. A muscle becomes a package: its component has
    two flanges (their distance is its length, it pulls them together) and a pneumatic port; the air
    in it is isothermal, and its mass follows from pressure and volume. Names have underscores in
    place of dots; every variable has its unit and description, parameters their sources.

    losses : of a muscle. name : of the model; by default that of the system.

    Raises InputError (a muscle without diameter, whose volume nobody knows; a name that Modelica
    does not take), ExportError for an operation that Modelica has not.

    Examples
    --------
    >>> pam.export.export_modelica(muscle, "Muscle.mo").name
    'Muscle.mo'
    """
    if name is not None and (name in RESERVED or not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII)):
        raise InputError(
            f"name = {name!r} is none of a Modelica model: give letters (A-Z, a-z), digits and "
            "underscores, a letter first, and no word of the language"
        )
    if isinstance(system, Muscle):
        text = _component(system, losses, name)
    elif losses:
        raise InputError("losses: a plant has its own; give them with a muscle alone")
    else:
        plant = require_plant(system)
        model = name or _class(plant.name)
        text = "\n".join([_model(plant, model), ""])
    require_ending(path, ".mo", "a Modelica model")
    with atomic_path(path) as file:
        file.write_text(text, encoding="utf-8")
    return Path(path)


WORLDS.register("modelica")(export_modelica)
ENDINGS[".mo"] = "modelica"


def _class(name: str) -> str:
    """A name for a model: hanging_load as HangingLoad."""
    plain = next(iter(identifiers([name]).values()))
    words = [w[:1].upper() + w[1:] for w in plain.split("_") if w]
    made = "".join(words)
    return made if made[:1].isalpha() and made not in RESERVED else f"M{made}"


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _declared(prefix: str, v: Variable, name: str, start: bool, value: bool = False) -> str:
    about = [f'unit = "{v.unit}"']
    if v.display_unit not in ("1", v.unit):
        about.append(f'displayUnit = "{v.display_unit}"')
    if start and v.start is not None:
        about.append(f"start = {v.start!r}")
    if prefix == "" and start:
        about.append("fixed = true")
    if v.nominal != 1.0 and not value:
        about.append(f"nominal = {v.nominal!r}")
    worth = f" = {v.start!r}" if value else ""
    words = f" {_quoted(v.description)}" if v.description else ""
    return f"{prefix + ' ' if prefix else ''}Real {name}({', '.join(about)}){worth}{words};"


def _equations(plant: Plant, names: Mapping[str, str]) -> tuple[list[str], list[tuple[str, str]]]:
    """(names of shared parts, (left, right) of all equations)."""
    xdot, y, _ = plant.function(plant.x, plant.u, plant.p)
    whole = ca.Function("plant", [plant.x, plant.u, plant.p], [xdot, y])
    program = instructions(whole, f"plant {plant.name!r}")
    groups = (plant.states, plant.inputs, plant.parameters)
    arguments = [[names[v.name] for v in g] for g in groups]
    prefix = "w"
    while any(n.startswith(prefix) and n[len(prefix) :].isdigit() for n in names.values()):
        prefix += "w"
    shared, (slopes, outputs) = formulas(program, arguments, prefix)
    lines = list(shared)
    lines += [(f"der({names[v.name]})", e) for v, e in zip(plant.states, slopes, strict=True)]
    lines += [(names[v.name], e) for v, e in zip(plant.outputs, outputs, strict=True)]
    return [name for name, _ in shared], lines


def _model(plant: Plant, model: str) -> str:
    """A plant as a model with inputs and outputs."""
    names = identifiers([v.name for v in plant.variables], RESERVED)
    inner, lines = _equations(plant, names)
    declared = [
        *(_declared("parameter", v, names[v.name], False, True) for v in plant.parameters),
        *(_declared("input", v, names[v.name], True) for v in plant.inputs),
        *(_declared("output", v, names[v.name], False) for v in plant.outputs),
        *(_declared("", v, names[v.name], True) for v in plant.states),
    ]
    return _text(model, plant.description, declared, inner, lines)


def _text(
    model: str,
    description: str,
    declared: Sequence[str],
    inner: Sequence[str],
    lines: Sequence[tuple[str, str]],
    bare: Sequence[str] = (),
) -> str:
    body = [f"  {line}" for line in declared]
    if inner:
        body += ["protected", *(f"  Real {n};" for n in inner)]
    body += ["equation", *(f"  {line};" for line in bare)]
    body += [f"  {left} = {right};" for left, right in lines]
    return "\n".join([f"model {model} {_quoted(description)}", *body, f"end {model};"])


def _component(muscle: Muscle, losses: Loss | Sequence[Loss], name: str | None) -> str:
    """A package with the connectors and the muscle."""
    if muscle.diameter is None:
        raise InputError(
            f"muscle {muscle.name!r} has no diameter, so its volume is unknown; give it one "
            "(dataclasses.replace(muscle, diameter=0.02))"
        )
    plant, attached = attached_alone(muscle, IdealPressure(), losses, "muscle")

    def declare(name: str, value: float, **about: Any) -> ca.SX:
        return plant.parameter(f"muscle.{name}", value, **about)

    volume = ConsistentVolume().filled(attached.muscle, attached.contraction, declare)
    plant.output("muscle.volume", volume, unit="m3", nominal=1e-4, description="air in the muscle")
    moved = {"muscle.length": "length", "muscle.speed": "speed", "muscle.pressure": "pressure"}
    names = identifiers(
        [v.name.removeprefix("muscle.") for v in plant.variables if v.name not in moved],
        RESERVED | OWN,
    )
    names = {v.name: names.get(v.name.removeprefix("muscle."), "") for v in plant.variables} | moved
    names["muscle.volume"] = "volume"
    inner, lines = _equations(plant, names)
    declared = [
        "Flange flange_a;",
        "Flange flange_b;",
        "PneumaticPort port;",
        *(_declared("parameter", v, names[v.name], False, True) for v in plant.parameters),
        f'parameter Real atmosphere(unit = "Pa") = {AMBIENT_PRESSURE!r} "absolute, outside";',
        f'parameter Real temperature(unit = "K") = {REFERENCE_TEMPERATURE!r} "of the air";',
        f'constant Real R(unit = "J/(kg.K)") = {GAS_CONSTANT!r} "specific gas constant of air";',
        *(_declared("", v, names[v.name], True) for v in plant.states),
        *(_declared("", v, names[v.name], False) for v in plant.inputs),
        *(_declared("", v, names[v.name], False) for v in plant.outputs),
        'Real mass(unit = "kg") "air inside";',
    ]
    bare = [
        "length = flange_b.s - flange_a.s",
        "speed = der(length)",
        "pressure = port.p",
        "flange_b.f = force",
        "flange_a.f = -force",
        "mass = (pressure + atmosphere)*volume/(R*temperature)",
        "port.m_flow = der(mass)",
    ]
    law = type(muscle.law)
    source = getattr(muscle.law, "reference", "") or law.__name__
    words = f"{muscle.name or 'muscle'}: {getattr(law, 'title', '') or law.__name__}; {source}"
    model = _text("Muscle", words, declared, inner, lines, bare)
    inside = "\n".join(f"  {line}" for line in model.splitlines())
    package = name or _class(muscle.name or "PneumaticMuscle")
    title = _quoted("A pneumatic muscle by its force law. SI units, gauge pressures")
    return f"package {package} {title}\n{CONNECTORS}\n{inside}\nend {package};\n"


# ---- formulas: shared parts named once -----------------------------------------------------------
@dataclass(eq=False)
class _Node:
    """A value: an operation on others, a name or a number; ``name`` once it has one."""

    kind: str
    parts: tuple[_Node, ...] = ()
    text: str = ""
    used: int = 0
    name: str = ""
    made: tuple[str, int] | None = None
    """Its text, once that is written."""


_BOOLEAN = ("lt", "le", "eq", "ne", "not", "and", "or")
_COMPARED = {"lt": "<", "le": "<="}


def identifiers(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """{name: an identifier for it}, dots as underscores, no two alike."""
    taken, found = set(reserved), {}
    for name in names:
        plain = base = re.sub(r"\W", "_", name, flags=re.ASCII)
        count = 1
        while plain in taken:
            count += 1
            plain = f"{base}_{count}"
        taken.add(plain)
        found[name] = plain
    return found


def formulas(
    program: Instructions, arguments: Sequence[Sequence[str]], prefix: str
) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """((name, formula) of the shared parts, in order; the formulas of each result).

    arguments : names of each argument's entries. prefix : of the names of shared parts.
    """
    known: dict[tuple[object, ...], _Node] = {}
    nodes: list[_Node] = []

    def entered(kind: str, parts: tuple[_Node, ...] = (), text: str = "") -> _Node:
        key = (kind, *map(id, parts), text)
        if key not in known:
            known[key] = _Node(kind, parts, text)
            nodes.append(known[key])
            for part in parts:
                part.used += 1
        return known[key]

    def operation(kind: str) -> Callable[..., _Node]:
        return lambda *parts: entered(kind, parts)

    table = {kind: operation(kind) for kind in OPERATIONS}
    entries = [lambda i, names=names: entered("name", (), names[i]) for names in arguments]
    results = program.run(table, entries, lambda v: entered("number", (), _number(v)))
    for column in results:
        for entry in column:
            entry.used += 1
    shared: list[tuple[str, str]] = []
    for node in nodes:
        if node.parts and node.used > 1 and node.kind not in _BOOLEAN:
            text, _ = _text_of(node)
            if len(text) > LONG or node.kind in FUNCTIONS:
                node.name = f"{prefix}{len(shared) + 1}"
                node.made = None
                shared.append((node.name, text))
    return shared, [[_text_of(entry)[0] for entry in column] for column in results]


def _branches(a: _Node, b: _Node) -> tuple[_Node, _Node, _Node] | None:
    """(condition, then, else) where a sum is what CasADi makes of if_else."""
    if a.name or b.name or not a.kind == b.kind == "if_else_zero":
        return None
    for one, other in ((a, b), (b, a)):
        no = other.parts[0]
        if no.kind == "not" and no.parts[0] is one.parts[0]:
            return one.parts[0], one.parts[1], other.parts[1]
    return None


def _number(value: float) -> str:
    if value != value or value in (float("inf"), float("-inf")):
        raise ExportError(f"an equation holds the number {value}, which no formula can")
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") and "e" not in text and len(text) < 9 else text


def _text_of(node: _Node) -> tuple[str, int]:
    """The text of a value, and how firmly it holds together."""
    if node.name:
        return node.name, ATOM
    if node.made is None:
        node.made = _written(node)
    return node.made


def _at(node: _Node, least: int) -> str:
    text, level = _text_of(node)
    return text if level >= least else f"({text})"


def _written(node: _Node) -> tuple[str, int]:
    kind, parts = node.kind, node.parts
    if kind in ("name", "number"):
        return node.text, SUM if node.text.startswith("-") else ATOM
    if kind in _BOOLEAN:
        return EITHER.format(_truth(node), "1", "0"), ATOM
    if kind == "if_else_zero":
        return EITHER.format(_truth(parts[0]), _text_of(parts[1])[0], "0"), ATOM
    if kind == "add" and (branches := _branches(*parts)):
        condition, then, other = branches
        return EITHER.format(_truth(condition), _text_of(then)[0], _text_of(other)[0]), ATOM
    if kind in OPERATORS:
        template, level, least = OPERATORS[kind]
        return template.format(*map(_at, parts, least)), level
    if kind not in FUNCTIONS:
        raise ExportError(f"Modelica has no {kind!r}; write the formula otherwise")
    return FUNCTIONS[kind].format(*(_text_of(part)[0] for part in parts)), ATOM


def _truth(node: _Node) -> str:
    """The text of a condition."""
    kind, parts = node.kind, node.parts
    if node.name or kind not in _BOOLEAN:
        # of a number: whether it is not 0, which relations of reals do not ask
        return f"abs({_text_of(node)[0]}) > 0"
    if kind == "not":
        return f"not ({_truth(parts[0])})"
    if kind in ("and", "or"):
        return f"({_truth(parts[0])}) {kind} ({_truth(parts[1])})"
    a, b = (_at(part, SUM) for part in parts)
    if kind in _COMPARED:
        return f"{a} {_COMPARED[kind]} {b}"
    same = f"{a} >= {b} and {a} <= {b}"
    return f"({same})" if kind == "eq" else f"not ({same})"
