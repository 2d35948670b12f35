"""What was done on the page as a Python script of public verbs: made of the state alone.

Whoever runs it in the session's folder gets the figures of the page: numbers are written with all
their digits. No text of a user or a file stands in the script but as a
quoted literal, or as a comment on one line.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from typing import Any

from ..core.errors import InputError
from ..core.registry import registry_of
from ..judge.statement import Stop
from ..muscles.laws.user_defined import law_named
from ..planning.transcription.mesh import Collocation, Method, Shooting
from ..plants.kinds import PLANTS

HEAD = '''"""Repeats a session of pam-ocp bench; run it in the folder that holds "files"."""

import dataclasses
import runpy

import numpy as np

import pam_ocp as pam
'''
FIGURES = "figures: dict[str, float] = {}  # what the page shows, too"
WIDTH = 96
"""Characters of a line that are not too many."""
SAID = "figure "
TAIL = f'''for name, value in figures.items():
    print(f"{SAID}{{name}} = {{float(value)!r}}")
'''
PUSH = "push"
"""The input of the real side of a loop that pushes it."""
ROOMS = ("feeds", "losses", "loads", "plants", "gas", "muscles")
"""Where the script looks for components: pam.feeds.Regulator."""


def script_of(state: Mapping[str, Any]) -> str:
    """The script: what there is to say of each tab, in the order of the tabs."""
    parts = (data_lines, muscle_lines, plant_lines, motion_lines, control_lines, export_lines)
    blocks = ["\n".join(map(wrapped, lines)) for part in parts if (lines := part(state))]
    text = "\n\n".join(blocks)
    imports = {"dataclasses": "dataclasses.", "runpy": "runpy.", "numpy as np": "np."}
    head = HEAD
    for name, used in imports.items():
        if used not in text:
            head = head.replace(f"import {name}\n", "")
    head = re.sub(r"\n{3,}", "\n\n", head)
    if "figures" in text:
        head, text = f"{head}\n{FIGURES}\n", f"{text}\n\n{TAIL.rstrip()}"
    return f"{head}\n{text}\n"


def figure_lines(owner: str, codes: Mapping[str, str]) -> list[str]:
    """Lines that note figures: {what: code of its value}."""
    inside = [f"    {f'{owner}.{name}'!r}: {code}," for name, code in codes.items()]
    return ["figures |= {", *inside, "}"] if inside else []


def figures_said(printed: str) -> dict[str, float]:
    """The figures among what a script has printed."""
    found = {}
    for line in printed.splitlines():
        name, equals, value = line.removeprefix(SAID).rpartition(" = ")
        if line.startswith(SAID) and equals:
            found[name] = float(value)
    return found


class _Code(str):
    """Code that stands as it is among values."""

    def __repr__(self) -> str:
        return str(self)


def call(function: str, /, *args: str, **keywords: Any) -> str:
    """``pam.verb(table, name=value)``; arguments are code, keywords values. None is left out."""
    said = [*args, *(f"{k}={v!r}" for k, v in keywords.items() if v is not None)]
    return f"{function}({', '.join(said)})"


def wrapped(line: str) -> str:
    """A call that is too long for a line, an argument on each."""
    if len(line) <= WIDTH or line.count("\n"):
        return line
    try:
        (statement,) = ast.parse(line).body
    except (SyntaxError, ValueError):
        return line
    made = statement.value if isinstance(statement, ast.Assign | ast.Expr) else None
    if not isinstance(made, ast.Call):
        return line
    parts = [*made.args, *(k.value for k in made.keywords)]
    names = [*[None] * len(made.args), *(k.arg for k in made.keywords)]
    codes = [ast.get_source_segment(line, part) for part in parts]
    inside = [
        f"    {c}," if n is None else f"    {n}={c}," for n, c in zip(names, codes, strict=True)
    ]
    head = line.encode()[: made.func.end_col_offset].decode()  # offsets count bytes
    return "\n".join([f"{head}(", *inside, ")"])


# ---- data ----------------------------------------------------------------------------------------
def data_lines(state: Mapping[str, Any]) -> list[str]:
    """The chosen table, without the cells that are switched off; records by their names."""
    lines = []
    fitted = state["muscle"] is not None and state["muscle"]["kind"] == "fit"
    data = [d for d in state["data"] if d.get("is") == "record" or d["id"] == state["chosen"]]
    if fitted:  # the table that was fitted, whatever has been chosen since
        table = state["muscle"]["table"]
        data = [d for d in data if d.get("is") == "record"] + [table]
    for item in data:
        source = item["bundled"] if "bundled" in item else f"files/{item['file']}"
        said = {k: v for k, v in item["said"].items() if k != "kind"}
        name = "".join(c if c.isprintable() else " " for c in str(item["name"]))[:100]
        lines.append(f"# {name}")
        if item.get("is") == "record":
            lines.append(f"{item['id']} = {call('pam.read_records', repr(source), **said)}")
            continue
        lines.append(f"table = {call('pam.read_table', repr(source), **said)}")
        if item.get("off"):
            lines += [
                f"off = {sorted(item['off'])!r}  # cells that are switched off",
                "table = table.subset([i not in off for i in range(len(table))])",
            ]
    return lines


# ---- the muscle ----------------------------------------------------------------------------------
def muscle_lines(state: Mapping[str, Any]) -> list[str]:
    """The muscle: of the catalogue, a file, or the fit, with what sliders changed."""
    said = state["muscle"]
    if said is None:
        return []
    if said["kind"] == "catalogue":
        made = call("pam.muscle", repr(said["name"]), rest_length=said.get("rest_length"))
        return [f"muscle = {made}"]
    if said["kind"] == "file":
        return [f"muscle = pam.load_muscle({'files/' + said['file']!r})"]
    law, fixed = said["law"], said.get("fixed") or None
    kept = {n: said[n] for n in ("rest_length", "diameter", "name", "source")}
    lines = [
        f"fit = {call('pam.fit_force', 'table', repr(law), fixed=fixed)}",
        "print(fit.report())",
        f"muscle = {call('fit.muscle', **kept)}",
    ]
    fitted = said.get("fitted", said["coefficients"])
    lines += figure_lines("fit", {n: f"fit.coefficients[{n!r}].value" for n in fitted})
    if said.get("moved"):
        kind = law_named(law)
        named = call("type(fit.law)", **said["coefficients"])
        lines += [f"# coefficients of the {kind.title}, moved by hand"]
        lines += [f"muscle = dataclasses.replace(muscle, law={named})"]
    return lines


# ---- the plant -----------------------------------------------------------------------------------
def plant_lines(state: Mapping[str, Any]) -> list[str]:
    """The plant, and its operating point."""
    if state["muscle"] is None:
        return []
    own = ":" in state["plant"]["arrangement"]
    lines = _own_plant(state["plant"]) if own else [f"plant = {plant_code(state['plant'])}"]
    for sensed, sensor in state["plant"].get("sensors", {}).items():
        lines += [f"plant.add_sensor({sensed!r}, {_component('sensors', sensor)})"]
    if state["point"]:
        lines += [f"point = pam.equilibrium(plant, {state['point']!r})", "print(point)"]
        lines += [
            "for v in (*plant.states, *plant.inputs):",
            '    figures[f"point.{v.name}"] = point[v.name]',
        ]
    return lines


def _own_plant(said: Mapping[str, Any]) -> list[str]:
    """A plant whose file lies among those of the session: NAME is one, or makes one."""
    file, _, member = said["arrangement"].rpartition(":")
    values = said.get("set", {})
    lines = [
        f"made = runpy.run_path({f'files/{file}'!r})[{member!r}]  # code of your own",
        "plant = made if isinstance(made, pam.Plant) else made(muscle)",
    ]
    return [*lines, *([f"plant = plant.with_values({values!r})"] if values else [])]


def plant_code(said: Mapping[str, Any]) -> str:
    """A [plant] table of the library as code, with the muscle named muscle; sensors left out."""
    content = dict(said)
    name = content.pop("arrangement")
    values = content.pop("set", {})
    content.pop("sensors", None)
    arguments = {k: _argument(k, v) for k, v in content.items()}
    made = call(f"pam.{name}", "muscle", **arguments)
    return f"{made}.with_values({values!r})" if values else made


def _argument(name: str, value: Any) -> Any:
    """A value of a [plant] table, or its code."""
    if isinstance(value, Mapping):
        return _component(name, value)
    if isinstance(value, list) and registry_of(name) is not None:
        inside = ", ".join(_component(name, one) for one in value)
        return _Code(f"({inside}{',' if len(value) == 1 else ''})")
    return tuple(value) if isinstance(value, list) else value


def _component(argument: str, content: Mapping[str, Any]) -> _Code:
    import pam_ocp as pam

    kinds = registry_of(argument)
    assert kinds is not None
    given = dict(content)
    kind = kinds.name(argument, given.pop("kind", kinds.default or next(iter(kinds))))
    room = next(r for r in ROOMS if hasattr(getattr(pam, r), kind))
    return _Code(call(f"pam.{room}.{kind}", **{k: _argument(k, v) for k, v in given.items()}))


# ---- motions -------------------------------------------------------------------------------------
METHODS: dict[str, tuple[str, Method | None]] = {
    "usual": ("50 intervals per leg", None),
    "coarse": ("20 intervals per leg", Collocation(20, 3)),
    "fine": ("100 intervals per leg", Collocation(100, 3)),
    "shooting": ("multiple shooting", Shooting(50)),
}
"""{key: (its words, the mesh of a plan; None: the usual one)}."""
TIME_LIMIT = 120.0
"""[s] of a plan."""


def arguments(motion: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords of :func:`pam_ocp.plan` that a motion stands for; stops as plain mappings where
    they say no more. Raises InputError where nothing is to be minimised.
    """
    minimise = {n: float(w) for n, w in motion["minimise"].items() if w}
    if not minimise:
        raise InputError("minimise: all weights are 0; give one of them a weight")
    said: dict[str, Any] = {"stops": [_stop(motion, stop) for stop in motion["stops"]]}
    legs = len(motion["stops"]) - (0 if motion["cyclic"] else 1)
    durations = [*motion["durations"], *[None] * legs][:legs]
    if any(d is not None for d in durations):
        said["duration"] = durations
    if motion["cyclic"]:
        said["cyclic"] = True
    said["minimise"] = next(iter(minimise)) if list(minimise.values()) == [1.0] else minimise
    bounds = {b["name"]: (b["low"], b["high"]) for b in motion["bounds"]}
    if bounds:
        said["bounds"] = bounds
    return said


def _stop(motion: Mapping[str, Any], stop: Mapping[str, Any]) -> dict[str, float] | Stop:
    values = {motion["variable"]: stop["at"]}
    if motion["second"] and stop["second"] is not None:
        values[motion["second"]] = stop["second"]
    if stop["rest"] and not stop["dwell"]:
        return values
    return Stop(values, rest=None if stop["rest"] else False, dwell=stop["dwell"])


def motion_lines(state: Mapping[str, Any]) -> list[str]:
    """Each motion as a call of pam.plan, with its figures."""
    lines: list[str] = []
    if state["muscle"] is None:
        return lines
    for motion in state["motions"]:
        said, id, mesh = arguments(motion), motion["id"], METHODS[motion["method"]][1]
        stops = ", ".join(map(_stop_code, said.pop("stops")))
        method = None if mesh is None else _Code(f"pam.planning.{mesh!r}")
        known = {"time_limit": TIME_LIMIT, "method": method}
        lines += [f"{id} = {call('pam.plan', 'plant', f'[{stops}]', **said, **known)}"]
        lines += [f"print({id})"]
        lines += figure_lines(
            id, {n: f"{id}.{n}" for n in ("duration", "objective", "replay_error")}
        )
        lines += [
            "for v in (*plant.states, *plant.inputs):",
            f'    figures[f"{id}.max({{v.name}})"] = float({id}.trajectory[v.name].max())',
        ]
    return lines


def _stop_code(stop: dict[str, float] | Stop) -> str:
    if not isinstance(stop, Stop):
        return repr(stop)
    return call("pam.Stop", repr(dict(stop.values)), rest=stop.rest, dwell=stop.dwell or None)


# ---- controllers ---------------------------------------------------------------------------------
def can_be_pushed(plant: Mapping[str, Any]) -> bool:
    """Whether an arrangement takes a force from outside among its loads; one's own are as said."""
    name = str(plant["arrangement"])
    return ":" not in name and "loads" in PLANTS.arguments(PLANTS.name("arrangement", name))


def pushed(plant: Mapping[str, Any]) -> dict[str, Any]:
    """The real side of a loop: the plant with a force from outside, where it takes one."""
    if not can_be_pushed(plant):
        return dict(plant)
    return {**plant, "loads": [*plant.get("loads", ()), {"kind": "ExternalForce", "name": PUSH}]}


def law_keywords(
    said: Mapping[str, Any], position: str, velocity: str, rate: Callable[[float], Any]
) -> dict[str, Any]:
    """The keywords of PointPid, lqr or Mpc that a controller stands for. rate : weights of the
    inputs' rates, each of one weight.
    """
    gains, found = said["gains"], {"sample_time": said["sample_time"]}
    if said["kind"] == "pid":
        return {**gains, **found}
    if said["kind"] == "mpc":
        track = {position: gains["position"]}
        horizon = round(gains["horizon"])
        return {"horizon": horizon, **found, "track": track, "rate": rate(gains["rate"])}
    if gains["integral"]:
        found["integral"] = {position: gains["integral"]}
    weights = {position: gains["position"], velocity: gains["velocity"]}
    return {"weights": weights, "effort": gains["effort"], **found}


def run_keywords(said: Mapping[str, Any], position: str, wanted: Any) -> dict[str, Any]:
    """The keywords of closed_loop that a controller's study stands for. wanted : the position that
    is to be reached; None for "not given".
    """
    study = said["study"]
    followed = said["kind"] != "lqr" or said["gains"]["integral"]  # else it has no reference
    return {
        "duration": study["duration"],
        "reference": {position: wanted} if followed else None,
        "disturbances": {PUSH: (study["push"], study["push_from"])} if study["push"] else None,
        "noise": {position: study["noise"]} if study["noise"] else None,
    }


def control_lines(state: Mapping[str, Any]) -> list[str]:
    """Each controller with its run against the plant, which can be pushed."""
    if state["muscle"] is None or not state["point"] or not state["controllers"]:
        return []
    side = pushed(state["plant"])
    lines = [f"side = {plant_code(side) if can_be_pushed(side) else 'plant'}"]
    lines += ["position = next(iter(plant.positions))", "velocity = plant.positions[position]"]
    lines += ["start = {v.name: point[v.name] for v in (*plant.states, *plant.inputs)}"]
    for said in state["controllers"]:
        lines += _run_lines(said)
    return lines


def _run_lines(said: Mapping[str, Any]) -> list[str]:
    id, position = said["id"], _Code("position")

    def rate(weight: float) -> _Code:
        return _Code(f"{{v.name: {weight!r} for v in plant.inputs if not v.disturbance}}")

    made = {"pid": "pam.control.PointPid", "lqr": "pam.lqr", "mpc": "pam.Mpc"}[said["kind"]]
    given = ("plant",) if said["kind"] == "mpc" else ("plant", "point")
    law = call(made, *given, **law_keywords(said, position, _Code("velocity"), rate))
    keywords = run_keywords(said, position, _Code(f"point[position] + {said['study']['step']!r}"))
    duration, reference = keywords.pop("duration"), repr(keywords.pop("reference"))
    known = {"duration": duration, "start": _Code("start"), **keywords}
    run = call("pam.closed_loop", id, "side", reference, **known)
    return [
        f"{id} = {law}",
        f"{id}_run = {run}",
        f"print({id}_run)",
        f'figures[f"{id}.final({{position}})"] = float({id}_run[position][-1])',
        f'figures[f"{id}.max({{position}})"] = float({id}_run[position].max())',
        f'figures[f"{id}.min({{position}})"] = float({id}_run[position].min())',
    ]


# ---- exports -------------------------------------------------------------------------------------
PLATFORMS: dict[str, tuple[str, list[str]]] = {
    "native": ("this machine", ["native"]),
    "windows": ("this machine and Windows, 64 bit", ["native", "x86_64-windows"]),
    "linux": ("this machine and Linux, 64 bit", ["native", "x86_64-linux"]),
    "mac-intel": ("this machine and macOS, Intel", ["native", "x86_64-darwin"]),
    "mac-apple": ("this machine and macOS, Apple", ["native", "aarch64-darwin"]),
    "all": ("all five: Linux (Intel, ARM), Windows, macOS (Intel, Apple)", []),
}
"""What an FMU or SSP is built for: {key: (words, names of pam_ocp.export.PLATFORMS; none: all)}.
This machine is always among them, for here it is checked."""


def platforms_of(said: Mapping[str, Any]) -> list[str] | None:
    """``platforms=`` of an export; of sessions that say none, this machine."""
    return PLATFORMS[said.get("platforms", "native")][1] or None


def exports_of(state: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The exports whose motion or controller is still there."""
    there = {"", *(m["id"] for m in state["motions"])}
    if state["point"]:
        there |= {c["id"] for c in state["controllers"]}
    return [e for e in state["exports"] if {e["motion"], e.get("controller", "")} <= there]


def export_lines(state: Mapping[str, Any]) -> list[str]:
    """Each FMU with its check, each SSP."""
    lines: list[str] = []
    if state["muscle"] is None:
        return lines
    for said in exports_of(state):
        id, motion = said["id"], said["motion"]
        if said["kind"] == "fmu":
            made = call(
                "pam.export_fmu",
                "plant",
                repr(f"{id}.fmu"),
                fmi=said["fmi"],
                platforms=platforms_of(said),
                step_size=said["step_size"],
            )
            lines += [f"{id} = {made}"]
            against = f"{motion}.trajectory" if motion else "None"
            if not motion and state["point"]:
                lines += [
                    f"rest = pam.simulate(plant, start=point, duration=200 * {said['step_size']!r})"
                ]
                against = "rest"
            lines += [f"{id}_check = pam.check_fmu({id}, against={against}, tolerance=1e-3)"]
            lines += [f"print({id}_check)"]
            lines += figure_lines(
                id, {"ok": f"float({id}_check.ok)", "largest": f"{id}_check.largest"}
            )
        elif said["kind"] == "ssp" and motion:
            lines += [
                f'{id} = pam.export_ssp({{"plant": plant, "motion": {motion}.trajectory}}, '
                f'{{f"plant.{{v.name}}": f"motion.{{v.name}}" for v in plant.inputs}}, '
                f"{f'{id}.ssp'!r}, step_size={said['step_size']!r}, "
                f"stop_time={motion}.duration, platforms={platforms_of(said)!r})"
            ]
        elif said["kind"] == "c" and said["controller"]:
            lines += [f"pam.export_c({said['controller']}, {f'{id}_c'!r})"]
    return lines
