"""A study as a file: its steps, what each stands on, and all that can be refused beforehand."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from ..core.exceptions import InputError, UnknownNameError
from ..core.files import read_toml, reading
from ..core.own_code import Behind, behind
from ..core.quantities import known_keys, table
from .steps.step import STEPS, Step
from .steps.sweep import cases_of

_KEYS = ("title", "author", "text", "steps")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,60}")
HELP = "'pam-ocp components study-step' lists its keys"


@dataclass(frozen=True)
class Entry:
    """A step as the file has it."""

    name: str
    kind: str
    said: Mapping[str, Any]
    """Its keys, without ``kind``."""
    parts: Mapping[str, str] = field(default_factory=dict)
    """{key: the step that it names}."""
    cases: tuple[str, ...] = ()
    """Of a sweep: the steps that it repeats."""
    place: str = ""
    """Its folder within that of the results."""

    @property
    def step(self) -> type[Step]:
        """What a step of this kind does."""
        return STEPS[self.kind]

    @property
    def above(self) -> tuple[str, ...]:
        """The steps that it stands on."""
        return tuple(dict.fromkeys((*self.parts.values(), *self.cases)))


@dataclass(frozen=True)
class Study:
    """What a study file says; its steps in an order in which each comes after what it stands on."""

    path: Path
    title: str
    author: str
    text: str
    entries: Mapping[str, Entry]

    def behind(self, entry: Entry) -> Behind:
        """The files that a step names, and those behind them; what names a step is no file."""
        steps = {*entry.parts, *(["of"] if entry.kind == "sweep" else [])}
        said = {key: value for key, value in entry.said.items() if key not in steps}
        return behind(said, self.path.parent)


def read_study(path: str | Path) -> Study:
    """Read a study file (see docs/studies.md).

    Raises InputError in one sentence for unknown steps, kinds and keys, keys that are missing, and
    steps that go in a circle. What their values mean is asked later, with the nouns at hand.
    """
    source = Path(path)
    content = read_toml(source)
    with reading(path, "a study", HELP):
        known_keys("the study", content, _KEYS)
        said = table("steps", content.get("steps", {}))
        if not said:
            raise InputError("steps is empty: give at least one table [steps.NAME] with its kind")
        entries = {n: _entry(n, table(f"steps.{n}", v), said) for n, v in said.items()}
        _order(entries)  # a circle would have no end
        for entry in entries.values():
            _require_offers(entry, entries)
        for entry in list(entries.values()):
            if entry.kind == "sweep":
                entries |= _repeated(entry, entries)
        for entry in entries.values():
            _require_offers(entry, entries)
        words = [content.get(k, "") for k in ("title", "author", "text")]
        for key, value in zip(("title", "author", "text"), words, strict=True):
            if not isinstance(value, str):
                raise InputError(f"{key} = {value!r}: give a text in quotes")
        title, author, text = words
        ordered = {n: entries[n] for n in _order(entries)}
    return Study(source, title or source.stem, author, text, ordered)


def _entry(name: str, said: Mapping[str, Any], steps: Mapping[str, Any]) -> Entry:
    where = f"steps.{name}"
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{where}: a step's name begins with a letter and holds letters, digits, _ and -"
        )
    if "kind" not in said:
        raise InputError(f"{where}.kind is missing; give one of {', '.join(STEPS)}")
    kind = STEPS.name(f"{where}.kind", said["kind"])
    step, given = STEPS[kind], {n: v for n, v in said.items() if n != "kind"}
    if "*" not in step.keys:
        known_keys(where, given, _keys(step))
    for key in step.needs:
        if key not in given:
            raise InputError(f"{where}.{key} is missing: a step of kind {kind} needs it")
    parts = {}
    for key in step.parts:
        value = given.get(key)
        if isinstance(value, str) and value in steps:
            parts[key] = value
        elif key in given and key not in step.loose:
            raise UnknownNameError(f"{where}.{key}", value, list(steps))
    return Entry(name, kind, given, parts, place=name)


def _keys(step: type[Step]) -> list[str]:
    return list(dict.fromkeys((*step.needs, *step.parts, *step.keys)))


def _require_offers(entry: Entry, entries: Mapping[str, Entry]) -> None:
    for key, name in entry.parts.items():
        noun, named = entry.step.parts[key], entries[name]
        if noun not in named.step.offers:
            able = [n for n, e in entries.items() if noun in e.step.offers and n != entry.name]
            raise InputError(
                f"steps.{entry.name}.{key} = {name!r}: that is a {named.kind}, which makes no "
                f"{noun}; give one that does"
                + (f": {', '.join(able)}" if able else ", of which there is none")
            )


def _order(entries: Mapping[str, Entry]) -> list[str]:
    try:
        return list(TopologicalSorter({n: e.above for n, e in entries.items()}).static_order())
    except CycleError as error:
        circle = " -> ".join(reversed(error.args[1]))
        raise InputError(
            f"steps go in a circle: {circle}; each may stand on others only that do not need it"
        ) from None


# ---- sweeps --------------------------------------------------------------------------------------
def _repeated(sweep: Entry, entries: Mapping[str, Entry]) -> dict[str, Entry]:
    """The sweep and the steps that it repeats, each with its own values."""
    where = f"steps.{sweep.name}"
    of = sweep.said["of"]
    plain = {n: e for n, e in entries.items() if e.kind != "sweep" and "[" not in n}
    if of not in plain:
        raise UnknownNameError(f"{where}.of", of, plain)
    below = _below(of, plain)
    cases = cases_of(where, sweep.said["vary"])
    for target in cases[0]:
        name, dot, key = target.partition(".")
        if name not in plain or not dot:
            raise UnknownNameError(f"{where}.vary: STEP.key, of which STEP", name, plain)
        if name not in below:
            raise InputError(f"{where}.vary.{target}: {of} does not stand on {name}")
        step = plain[name].step
        if "*" not in step.keys and key.partition(".")[0] not in _keys(step):
            raise UnknownNameError(f"{where}.vary: key of {name}", key, _keys(step))
    made: dict[str, Entry] = {}
    for number, case in enumerate(cases, start=1):
        made |= _case(sweep, number, case, {n: plain[n] for n in below}, plain)
    last = tuple(f"{of}[{sweep.name} {i}]" for i in range(1, len(cases) + 1))
    return {**made, sweep.name: Entry(sweep.name, "sweep", sweep.said, {}, last, sweep.name)}


def _below(name: str, entries: Mapping[str, Entry]) -> list[str]:
    """A step and all that it stands on, those first."""
    found: list[str] = []
    for other in entries[name].above:
        found += [n for n in _below(other, entries) if n not in found]
    return [*found, name]


def _case(
    sweep: Entry,
    number: int,
    case: Mapping[str, Any],
    below: Mapping[str, Entry],
    steps: Mapping[str, Entry],
) -> dict[str, Entry]:
    """Copies of the steps that a case changes, and of those that stand on them."""
    names: dict[str, str] = {}
    made = {}
    for name, entry in below.items():
        changed = {t.partition(".")[2]: v for t, v in case.items() if t.partition(".")[0] == name}
        last = name == sweep.said["of"]
        if not (changed or last or any(n in names for n in entry.above)):
            continue
        names[name] = f"{name}[{sweep.name} {number}]"
        said: dict[str, Any] = dict(entry.said)
        for key, value in changed.items():
            _put(said, key.split("."), value)
        parts = {k: names.get(n, n) for k, n in entry.parts.items() if k not in changed}
        parts |= {k: str(v) for k, v in changed.items() if k in entry.step.parts and v in steps}
        place = f"{sweep.name}/{number}/{name}"
        made[names[name]] = Entry(names[name], entry.kind, said, parts, (), place)
    return made


def _put(said: dict[str, Any], keys: list[str], value: Any) -> None:
    """Set a key of a table within tables, whose copies take the place of the others."""
    if len(keys) > 1 and isinstance(said.get(keys[0]), Mapping):
        said[keys[0]] = dict(said[keys[0]])
        _put(said[keys[0]], keys[1:], value)
    else:
        said[".".join(keys)] = value
