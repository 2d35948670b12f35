"""Static rules of FMI 2.0 and 3.0 beyond the schemas: ``findings(path)`` names each that is broken.

Written from the two standards: tables of causality, variability and initial, completeness and order
of the model structure, references to units, types, clocks and terminals, files of the archive.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET

Rule = Callable[["Unit"], Iterator[str]]

CONTINUOUS = ("discrete", "continuous")
COMBINATIONS = {
    "parameter": ("fixed", "tunable"),
    "calculatedParameter": ("fixed", "tunable"),
    "structuralParameter": ("fixed", "tunable"),
    "input": CONTINUOUS,
    "output": ("constant", *CONTINUOUS),
    "local": ("constant", "fixed", "tunable", *CONTINUOUS),
    "independent": ("continuous",),
}
"""Causality: variabilities that go with it."""
EXACT, CALCULATED, ANY = ("exact",), ("calculated", "approx"), ("calculated", "exact", "approx")
INITIAL = {
    **{("parameter", v): EXACT for v in ("fixed", "tunable")},
    **{("structuralParameter", v): EXACT for v in ("fixed", "tunable")},
    **{("calculatedParameter", v): CALCULATED for v in ("fixed", "tunable")},
    **{(c, "constant"): EXACT for c in ("output", "local")},
    **{("local", v): CALCULATED for v in ("fixed", "tunable")},
    **{(c, v): ANY for c in ("output", "local") for v in CONTINUOUS},
}
"""What ``initial`` may be, its default first; nothing for what is not listed."""
NAME = re.compile(r"(?:der\((?P<of>[^()]+)(?:,\d+)?\)|(?P<plain>[^()]+))\Z")
PART = re.compile(r"(?:[A-Za-z_]\w*|'[^']+')(?:\[\d+(?:,\d+)*\])?\Z")
IDENTIFIER = re.compile(r"[A-Za-z_]\w*\Z")


@dataclass
class Variable:
    """A variable of either version, read alike."""

    name: str
    reference: int
    causality: str
    variability: str
    initial: str
    said: str | None
    """The attribute ``initial`` as it stands."""
    at: dict[str, str] = field(default_factory=dict)
    kind: str = "Float64"

    @property
    def unit_of(self) -> str | None:
        return self.at.get("unit")


class Unit:
    """An FMU's description."""

    def __init__(self, path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            self.files = set(archive.namelist())
            self.root = ET.fromstring(archive.read("modelDescription.xml"))
            icons = "terminalsAndIcons/terminalsAndIcons.xml"
            self.icons = ET.fromstring(archive.read(icons)) if icons in self.files else None
        self.second = self.root.get("fmiVersion", "").startswith("2")
        self.variables = list(self._variables())
        self.places: dict[int, Variable] = (
            dict(enumerate(self.variables, 1))
            if self.second
            else {v.reference: v for v in self.variables}
        )
        """By what the model structure calls them."""

    def _variables(self) -> Iterator[Variable]:
        for element in self.root.iterfind("ModelVariables/*"):
            own = element[0] if self.second else element
            at = {**element.attrib, **own.attrib}
            causality = at.get("causality", "local")
            usual = "fixed" if causality in ("parameter", "calculatedParameter") else "continuous"
            if own.tag == "Clock":
                usual = "discrete"
            variability = at.get("variability", usual)
            allowed = INITIAL.get((causality, variability), ("",))
            reference = int(at["valueReference"])
            initial = at.get("initial", allowed[0])
            said = at.get("initial")
            yield Variable(
                at["name"], reference, causality, variability, initial, said, at, own.tag
            )

    def structure(self, second: str, third: str) -> list[ET.Element]:
        found = self.root.find("ModelStructure")
        if found is None:
            return []
        return list(found.findall(f"{second}/Unknown" if self.second else third))

    def called(self, element: ET.Element) -> int:
        return int(element.get("index" if self.second else "valueReference", "0"))

    def outputs(self) -> list[ET.Element]:
        return self.structure("Outputs", "Output")

    def derivatives(self) -> list[ET.Element]:
        return self.structure("Derivatives", "ContinuousStateDerivative")

    def initials(self) -> list[ET.Element]:
        return self.structure("InitialUnknowns", "InitialUnknown")

    @property
    def states(self) -> set[int]:
        """Places of continuous states."""
        return {int(v.at["derivative"]) for v in self.variables if "derivative" in v.at}


# ---- names and kinds ----------------------------------------------------------------------------
def names(unit: Unit) -> Iterator[str]:
    known: set[str] = set()
    for v in unit.variables:
        if v.name in known:
            yield f"{v.name} is there twice"
        known.add(v.name)
        match = NAME.match(v.name)
        inner = (match["of"] or match["plain"]) if match else ""
        if not inner or not all(PART.match(part) for part in inner.split(".")):
            yield f"{v.name!r} is no structured name"
        elif match and match["of"] and match["of"] not in {w.name for w in unit.variables}:
            yield f"{v.name} is the derivative of nothing"


def references(unit: Unit) -> Iterator[str]:
    numbers = [v.reference for v in unit.variables]
    if len(set(numbers)) < len(numbers):
        yield "a value reference is there twice"


def combinations(unit: Unit) -> Iterator[str]:
    for v in unit.variables:
        if v.variability not in COMBINATIONS.get(v.causality, ()):
            yield f"{v.name}: causality {v.causality} with variability {v.variability}"
        allowed = INITIAL.get((v.causality, v.variability), ())
        if v.kind == "Clock":
            allowed = ()
        if v.said is not None and v.said not in allowed:
            yield f"{v.name}: initial {v.said} with {v.causality}, {v.variability}"


def starts(unit: Unit) -> Iterator[str]:
    for v in unit.variables:
        if v.kind == "Clock":
            continue
        wanted = v.causality == "input" or v.initial in ("exact", "approx")
        if v.causality == "independent":
            wanted = False
        if wanted != ("start" in v.at):
            yield f"{v.name} has {'no' if wanted else 'a'} start value"


def ranges(unit: Unit) -> Iterator[str]:
    for v in unit.variables:
        low, high = float(v.at.get("min", "-inf")), float(v.at.get("max", "inf"))
        if not low <= high:
            yield f"{v.name}: min > max"
        if "start" in v.at and not low <= float(v.at["start"]) <= high:
            yield f"{v.name}: its start is outside of its range"
        if "nominal" in v.at and not float(v.at["nominal"]) > 0:
            yield f"{v.name}: nominal is not above 0"


def one_time(unit: Unit) -> Iterator[str]:
    times = [v for v in unit.variables if v.causality == "independent"]
    if len(times) > 1 or (not times and not unit.second):
        yield "there is not one independent variable"
    if any("start" in v.at for v in times):
        yield "time has a start"


# ---- units and types ----------------------------------------------------------------------------
def units(unit: Unit) -> Iterator[str]:
    known = {
        u.get("name"): {d.get("name") for d in u.findall("DisplayUnit")}
        for u in unit.root.findall("UnitDefinitions/Unit")
    }
    if len(known) < len(unit.root.findall("UnitDefinitions/Unit")):
        yield "a unit is there twice"
    types = dict(_types(unit))
    for name, at in [(v.name, v.at) for v in unit.variables] + list(types.items()):
        own = at.get("unit") or types.get(at.get("declaredType", ""), {}).get("unit")
        if own is not None and own not in known:
            yield f"{name}: unit {own} is not defined"
        shown = at.get("displayUnit")
        if shown is not None and shown not in known.get(own, set()):
            yield f"{name}: display unit {shown} is none of {own}"


def _types(unit: Unit) -> Iterator[tuple[str, dict[str, str]]]:
    for element in unit.root.iterfind("TypeDefinitions/*"):
        yield element.attrib["name"], dict((element[0] if unit.second else element).attrib)


def types(unit: Unit) -> Iterator[str]:
    known = dict(_types(unit))
    if len(known) < len(list(_types(unit))):
        yield "a type is there twice"
    for v in unit.variables:
        wanted = v.at.get("declaredType")
        if wanted is None:
            continue
        if wanted not in known:
            yield f"{v.name}: type {wanted} is not defined"
        for attribute in ("unit", "quantity"):
            both = v.at.get(attribute), known.get(wanted, {}).get(attribute)
            if None not in both and both[0] != both[1]:
                yield f"{v.name}: its {attribute} is not that of its type"
    if set(known) & {v.name for v in unit.variables}:
        yield "a type has the name of a variable"


# ---- model structure ----------------------------------------------------------------------------
def complete(unit: Unit) -> Iterator[str]:
    wanted = {
        "outputs": {n for n, v in unit.places.items() if v.causality == "output"},
        "derivatives": {n for n, v in unit.places.items() if "derivative" in v.at},
        "initial unknowns": {n for n, v in unit.places.items() if _unknown_at_first(unit, n, v)},
    }
    told = {
        "outputs": unit.outputs(),
        "derivatives": unit.derivatives(),
        "initial unknowns": unit.initials(),
    }
    for what, elements in told.items():
        found = [unit.called(e) for e in elements]
        if len(set(found)) < len(found):
            yield f"{what}: one is there twice"
        for n in wanted[what] ^ set(found):
            name = unit.places[n].name if n in unit.places else n
            yield f"{what}: {name} is {'missing' if n in wanted[what] else 'none'}"


def _unknown_at_first(unit: Unit, place: int, v: Variable) -> bool:
    if v.initial not in ("calculated", "approx") or v.kind == "Clock":
        return False
    return (
        v.causality in ("output", "calculatedParameter")
        or place in unit.states
        or "derivative" in v.at
    )


def dependencies(unit: Unit) -> Iterator[str]:
    lists = {"at steps": [*unit.outputs(), *unit.derivatives()], "at first": unit.initials()}
    for when, elements in lists.items():
        for e in elements:
            name = unit.places[unit.called(e)].name if unit.called(e) in unit.places else "?"
            kinds = e.get("dependenciesKind", "").split()
            known = [int(n) for n in e.get("dependencies", "").split()]
            if kinds and len(kinds) != len(known):
                yield f"{name}: dependencies and their kinds differ in number"
            allowed = {"dependent", "constant"}
            if when == "at steps":
                allowed |= {"fixed", "tunable", "discrete"}
            if set(kinds) - allowed:
                yield f"{name}: a kind of dependency that is none {when}"
            if len(set(known)) < len(known) or (unit.second and known != sorted(known)):
                yield f"{name}: dependencies in another order, or twice"
            for n in known:
                if n not in unit.places or not _known(unit, n, when):
                    yield f"{name} depends on {n}, which is not known {when}"


def _known(unit: Unit, place: int, when: str) -> bool:
    v = unit.places[place]
    if v.causality in ("input", "independent") or place in unit.states:
        return True
    return when == "at first" and v.initial == "exact"


def slopes(unit: Unit) -> Iterator[str]:
    for v in unit.variables:
        if "derivative" not in v.at:
            continue
        of = unit.places.get(int(v.at["derivative"]))
        if of is None or of.variability != "continuous" or v.variability != "continuous":
            yield f"{v.name} is the derivative of no continuous variable"
        elif of.causality not in ("output", "local"):
            yield f"{v.name}: its state is a {of.causality}"
    for v in unit.variables:
        if v.at.get("reinit") == "true" and unit.second is False and v.reference not in unit.states:
            yield f"{v.name}: reinit, and no state"


# ---- clocks, terminals, files -------------------------------------------------------------------
def clocks(unit: Unit) -> Iterator[str]:
    known = {v.reference for v in unit.variables if v.kind == "Clock"}
    for v in unit.variables:
        if v.kind == "Clock":
            if v.causality not in ("input", "output", "local") or v.variability != "discrete":
                yield f"{v.name}: a clock that is {v.causality}, {v.variability}"
            if v.at.get("intervalVariability") == "constant":
                if not float(v.at.get("intervalDecimal", "0")) > 0:
                    yield f"{v.name}: a constant interval that is not above 0"
            elif "intervalVariability" not in v.at:
                yield f"{v.name}: a clock without intervalVariability"
        for n in v.at.get("clocks", "").split():
            if int(n) not in known:
                yield f"{v.name}: clock {n} is none"


def terminals(unit: Unit) -> Iterator[str]:
    if unit.icons is None:
        return
    known = {v.name for v in unit.variables}
    found = unit.icons.findall("Terminals/Terminal")
    if len({t.get("name") for t in found}) < len(found):
        yield "a terminal is there twice"
    for terminal in found:
        name = terminal.get("name")
        if terminal.get("matchingRule") not in ("bus", "plug", "sequence"):
            yield f"{name}: matching rule {terminal.get('matchingRule')}"
        members = terminal.findall("TerminalMemberVariable")
        called = [m.get("memberName") for m in members]
        if terminal.get("matchingRule") != "sequence" and len(set(called)) < len(called):
            yield f"{name}: a member is there twice"
        for member in members:
            if member.get("variableName") not in known:
                yield f"{name}: {member.get('variableName')} is no variable"
            if member.get("variableKind") not in ("signal", "inflow", "outflow"):
                yield f"{name}: kind {member.get('variableKind')}"
        for picture in terminal.findall("TerminalGraphicalRepresentation"):
            file = f"terminalsAndIcons/{picture.get('iconBaseName')}.png"
            if file not in unit.files:
                yield f"{name}: {file} is missing"


def files(unit: Unit) -> Iterator[str]:
    kinds = [e for k in ("CoSimulation", "ModelExchange") for e in unit.root.findall(k)]
    if not kinds:
        yield "neither Co-Simulation nor Model Exchange"
    for kind in kinds:
        identifier = kind.get("modelIdentifier", "")
        if not IDENTIFIER.match(identifier):
            yield f"modelIdentifier {identifier!r} is no name in C"
        binaries = [f for f in unit.files if f.startswith("binaries/") and not f.endswith("/")]
        if not binaries or any(Path(f).stem != identifier for f in binaries):
            yield "a binary is not named as modelIdentifier"
        for file in kind.findall("SourceFiles/File"):
            if f"sources/{file.get('name')}" not in unit.files:
                yield f"sources/{file.get('name')} is missing"
    if not unit.root.get("guid" if unit.second else "instantiationToken"):
        yield "there is no token"
    if any("\\" in f or f.startswith("/") or ".." in Path(f).parts for f in unit.files):
        yield "a path that leaves the archive"


def experiment(unit: Unit) -> Iterator[str]:
    told = unit.root.find("DefaultExperiment")
    if told is None:
        return
    if not float(told.get("startTime", "0")) < float(told.get("stopTime", "1e9")):
        yield "the default experiment ends before it begins"
    for name in ("stepSize", "tolerance"):
        if not float(told.get(name, "1")) > 0:
            yield f"{name} of the default experiment is not above 0"


RULES: tuple[Rule, ...] = (
    names,
    references,
    combinations,
    starts,
    ranges,
    one_time,
    units,
    types,
    complete,
    dependencies,
    slopes,
    clocks,
    terminals,
    files,
    experiment,
)


def findings(path: Path) -> list[str]:
    """What is broken, one sentence each with its rule's name."""
    unit = Unit(path)
    return [f"{rule.__name__}: {said}" for rule in RULES for said in rule(unit)]
