"""Are files read as laboratories have them?

    python benchmarks/files_study.py 100 --seed 7 [--keep FOLDER] [--show]

Files of a static test or of a record in time, in the shapes of MATLAB, Simulink, dSPACE, LabVIEW,
ROS, spreadsheets, loggers and scripts, with names, units, separators, languages and encodings drawn
at random, written by the libraries of others. Each is read without a word; where reading asks for a
keyword, the user's answer is given if it is the keyword that the sentence names, and so on.

Counted: right at the first call; right with the keywords named; refused by a sentence that names a
keyword or what to do; refused otherwise; wrong with a warning that names the column; wrong in
silence. --keep leaves the files in a folder, --show prints what was said of each. Exit code 1 if
one is wrong in silence.
"""

from __future__ import annotations

import datetime as dt
import json
import re
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import harness
import numpy as np
import scipy.io

import pam_ocp as pam

TO_SI = {
    **{"Pa": 1.0, "kPa": 1e3, "bar": 1e5, "MPa": 1e6, "psi": 6894.757293168, "mbar": 1e2},
    **{"kgf/cm2": 98066.5, "at": 98066.5, "mmHg": 133.322387415, "Torr": 101325 / 760},
    **{"N": 1.0, "kN": 1e3, "daN": 10.0, "kp": 9.80665, "kgf": 9.80665, "lbf": 4.4482216152605},
    **{"mm": 1e-3, "m": 1.0, "cm": 1e-2, "%": 1e-2, "1": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6},
}
NAMES = {
    "pressure": ("p", "pressure", "Druck", "pression", "Pressure", "presión"),
    "force": ("F", "force", "Kraft", "Force", "fuerza", "Zugkraft"),
    "contraction": ("kappa", "contraction", "Kontraktion", "Contraction"),
    "x": ("x", "pos", "Weg", "displacement", "Position"),
    "command": ("p_set", "command", "Sollwert", "setpoint"),
    "time": ("time", "t", "Zeit", "Time"),
}
UNITS = {
    "pressure": ("kPa", "bar", "MPa", "psi", "kgf/cm2", "mmHg", "Torr"),
    "force": ("N", "kN", "daN", "kp", "lbf"),
    "contraction": ("%", "1"),
    "x": ("mm", "m", "cm"),
    "command": ("bar", "kPa"),
}


@dataclass
class Case:
    """What was written. truth : {kind: SI values, or a function of time}; names : {kind: header}.
    answers : what the user knows, by keyword. first : time of the first row [s].
    """

    source: Any
    truth: dict[str, Any]
    names: dict[str, str] = field(default_factory=dict)
    answers: dict[str, Any] = field(default_factory=dict)
    record: bool = False
    first: float = 0.0
    tolerance: float = 2e-3


PX = {"pressure": "p", "x": "x"}
"""Usual names."""
CLOCK = {"units": {"time": "s"}}
"""What a user answers who is asked for the unit of a clock."""
SHAPES: dict[str, Callable[[Any, Path], Case]] = {}


def shape(function: Callable[[Any, Path], Case]) -> Callable[[Any, Path], Case]:
    SHAPES[function.__name__] = function
    return function


class Draw:
    """Random choices, and what is measured."""

    def __init__(self, seed: Any) -> None:
        self.random = np.random.default_rng(seed)
        self.phase = self.random.uniform(0, 6)

    def of(self, *choices: Any) -> Any:
        return choices[int(self.random.integers(len(choices)))]

    def name(self, kind: str) -> str:
        return str(self.of(*NAMES[kind]))

    def unit(self, kind: str) -> str:
        return str(self.of(*UNITS[kind]))

    def header(self, name: str, unit: str) -> str:
        if "/" in unit:
            return f"{name} [{unit}]"
        return str(self.of(f"{name} [{unit}]", f"{name} ({unit})", f"{name}/{unit}"))

    # ---- a static test ---------------------------------------------------------------------------
    def table(self) -> dict[str, np.ndarray]:
        kappas = np.arange(0, 0.21, self.of(0.04, 0.05))
        p = np.linspace(1e5, 6e5, int(self.random.integers(5, 9)))
        k, p = (a.ravel() for a in np.meshgrid(kappas, p, indexing="ij"))
        force = 3.14e-4 * p * (22.6 * (1 - k) ** 2 - 8.5) * self.random.uniform(0.8, 1.2)
        return {"contraction": k, "pressure": p, "force": force}

    # ---- a record --------------------------------------------------------------------------------
    def signals(self) -> dict[str, Callable[[Any], Any]]:
        a = self.phase
        return {
            "pressure": lambda t: 3e5 + 1e5 * np.sin(2.0 * t + a),
            "x": lambda t: 0.02 * np.sin(2.0 * t + a - 0.4),
            "force": lambda t: 400 + 150 * np.cos(1.5 * t + a),
        }

    def seen(self, kind: str, t: Any, unit: str) -> Any:
        """A signal at some times in a unit."""
        return self.signals()[kind](t) / TO_SI[unit]

    def times(self, rate: float | None = None) -> np.ndarray:
        rate = rate or self.of(100.0, 200.0, 250.0)
        return np.arange(int(self.random.integers(400, 900))) / rate


def columns(draw: Draw, t: np.ndarray) -> tuple[dict[str, Any], dict[str, str]]:
    """({header: numbers}, {kind: header}) of a record, without its clock."""
    made, names = {}, {}
    for kind, signal in draw.signals().items():
        unit = draw.unit(kind)
        names[kind] = draw.header(draw.name(kind), unit)
        made[names[kind]] = signal(t) / TO_SI[unit]
    return made, names


def record(
    draw: Draw,
    source: Any,
    names: dict[str, str],
    answers: dict[str, Any] | None = None,
    **more: Any,
) -> Case:
    """The case of a record whose columns are called so."""
    signals = draw.signals()
    return Case(source, {k: signals[k] for k in names}, names, answers or {}, True, **more)


def cells(draw: Draw) -> Any:
    """The same of a static test: ({header: numbers}, truth)."""
    truth = draw.table()
    made = {}
    for kind, values in truth.items():
        unit = draw.unit(kind)
        name = draw.name(kind)
        header = name if kind == "contraction" and unit == "1" else draw.header(name, unit)
        made[header] = values / TO_SI[unit]
    return made, truth


def shown(value: float, sign: str = ".") -> str:
    return f"{value:.7g}".replace(".", sign)


# ---- text ----------------------------------------------------------------------------------------
def line_of(row: Any, cut: str, sign: str = ".") -> str:
    cells = ("" if v is None else v if isinstance(v, str) else shown(v, sign) for v in row)
    return cut.join(cells)


def text_of(made: dict[str, Any], cut: str, sign: str) -> list[str]:
    return [line_of(row, cut, sign) for row in (made, *zip(*made.values(), strict=True))]


def written(file: Path, lines: list[str]) -> Path:
    file.write_text("\n".join(lines))
    return file


@shape
def csv_in_any_encoding(draw: Draw, path: Path) -> Case:
    made, truth = cells(draw)
    cut, sign = draw.of((",", "."), (";", ","), ("\t", ","), ("\t", "."), (";", "."), ("|", "."))
    lines = text_of(made, cut, sign)
    if draw.of(True, False):
        lines = ["Test rig 4", "recorded 2024", *lines]
    file = path / f"static.{draw.of('csv', 'txt', 'dat')}"
    encoding = draw.of("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1")
    file.write_bytes(draw.of("\n", "\r\n").join(lines).encode(encoding))
    return Case(file, truth)


@shape
def cyrillic(draw: Draw, path: Path) -> Case:
    _made, truth = cells(draw)
    units = ("kPa", "N", "%")
    heads = [f"{n} [{u}]" for n, u in zip(("давление", "сила", "kappa"), units, strict=True)]
    values = (truth["pressure"] / 1e3, truth["force"], truth["contraction"] * 100)
    file = path / "данные.csv"
    lines = text_of(dict(zip(heads, values, strict=True)), ";", ",")
    file.write_bytes("\n".join(lines).encode(draw.of("cp1251", "utf-8")))
    return Case(file, truth)


@shape
def two_header_rows(draw: Draw, path: Path) -> Case:
    truth = draw.table()
    kinds, units = list(truth), [draw.unit(k) for k in truth]
    cut, sign = draw.of((",", "."), (";", ","), ("\t", "."))
    rows = zip(*(truth[k] / TO_SI[u] for k, u in zip(kinds, units, strict=True)), strict=True)
    said = [("-" if u == "1" else draw.of(u, u) if sign == "," else f"[{u}]") for u in units]
    heads = [draw.name(k) for k in kinds]
    lines = [line_of(row, cut, sign) for row in (heads, said, *rows)]
    return Case(written(path / "static.csv", lines), truth)


@shape
def stray_lines(draw: Draw, path: Path) -> Case:
    t = draw.times()
    made, names = columns(draw, t)
    lines = text_of({"time [s]": t, **made}, ",", ".")
    bad = sorted(draw.random.choice(np.arange(20, len(lines) - 20), 6, replace=False), reverse=True)
    for i, kind in zip(bad, ("cut", "stray", "head", "cut", "stray", "glued"), strict=True):
        if kind == "cut":
            lines[i] = lines[i][: lines[i].rindex(",") - 1]
        elif kind == "glued":
            lines[i : i + 2] = [lines[i] + lines[i + 1]]
        else:
            lines.insert(i, lines[0] if kind == "head" else "--- sensor restarted ---")
    file = written(path / "log.txt", [*lines, ""])
    return record(draw, file, names, {"bad_lines": "drop", "max_gap": 1.0})


@shape
def key_value(draw: Draw, path: Path) -> Case:
    t = draw.times()
    equal, cut = draw.of("=", ": ", ":"), draw.of(" ", ", ", "; ", "\t")
    seen = (draw.seen("pressure", t, "kPa"), draw.seen("x", t, "mm"), draw.seen("force", t, "N"))
    form = cut.join(("t={:.4f}", "p={:.5g}kPa", "x={:.5g} mm", "F={:.6g}"))
    form = form.replace("=", equal)
    lines = [form.format(*row) for row in zip(t, *seen, strict=True)]
    names = {"pressure": "p", "x": "x", "force": "F"}
    return record(draw, written(path / "serial.log", lines), names, CLOCK)


@shape
def zones_across_a_change(draw: Draw, path: Path) -> Case:
    t = draw.times(1.0) if draw.of(True, False) else draw.times(10.0)
    zone = ZoneInfo(draw.of("Europe/Berlin", "America/New_York"))
    day = dt.datetime(2024, *draw.of((10, 27), (3, 31), (11, 3), (3, 10)), 0, 59, 0, tzinfo=dt.UTC)
    if zone.key.startswith("America"):
        day = day.replace(hour=6)
    stamps = [(day + dt.timedelta(seconds=float(u))).astimezone(zone) for u in t]
    told = [s.isoformat(draw.of("T", " "), "milliseconds") for s in stamps]
    made, names = columns(draw, t)
    lines = text_of({"timestamp": told, **made}, ";", ".")
    return record(draw, written(path / "stamped.csv", lines), names)


@shape
def clock_in_other_units(draw: Draw, path: Path) -> Case:
    t = draw.times()
    unit, factor = draw.of(("us", 1e6), ("ms", 1e3), ("days", 1 / 86400), ("d", 1 / 86400))
    made, names = columns(draw, t)
    clock = f"time [{unit}]" if draw.of(True, False) else "time"
    lines = [",".join([clock, *made])]
    rows = zip(t * factor, *made.values(), strict=True)
    lines += [",".join(f"{v:.12g}" for v in row) for row in rows]
    return record(draw, written(path / "clock.csv", lines), names, {"units": {"time": unit}})


@shape
def without_a_clock(draw: Draw, path: Path) -> Case:
    made, names = columns(draw, np.arange(600) * 0.004)
    file = written(path / "even.csv", text_of(made, ",", "."))
    return record(draw, file, names, {"sample_time": 0.004})


@shape
def constant_contraction(draw: Draw, path: Path) -> Case:
    truth = draw.table()
    one = truth["contraction"] == np.unique(truth["contraction"])[2]
    truth = {k: v[one] for k, v in truth.items()}
    unit = draw.unit("pressure")
    made = {f"p [{unit}]": truth["pressure"] / TO_SI[unit], "F [N]": truth["force"]}
    level = float(truth["contraction"][0])
    file = written(path / f"M1_{100 * level:g}pct_run2.csv", text_of(made, ";", ","))
    answers = draw.of(
        {"constants": {"contraction": level}},
        {"pattern": "M1_{contraction [%]}pct_run{run}.csv"},
        {"constants": {"contraction": f"{100 * level:g} %", "run": 2}},
    )
    return Case(file, truth, answers=answers)


# ---- spreadsheets --------------------------------------------------------------------------------
def book(path: Path, rows: list[list[Any]], merge: list[str] | None = None) -> Path:
    import openpyxl

    made = openpyxl.Workbook()
    sheet = made.active
    for row in rows:
        sheet.append([None if c is None else c if isinstance(c, str) else float(c) for c in row])
    for span in merge or ():
        sheet.merge_cells(span)
    made.save(path)
    return path


@shape
def merged_head_in_excel(draw: Draw, path: Path) -> Case:
    t, name = draw.times(), draw.of("Druck", "Pressure")
    rows: list[list[Any]] = [["time", name, None, "Position"], ["s", "bar", "bar", "mm"]]
    seen = draw.seen("pressure", t, "bar"), 2 + 0.1 * t, draw.seen("x", t, "mm")
    rows += zip(t, *seen, strict=True)
    file = book(path / "merged.xlsx", rows, ["B1:C1"])
    return record(draw, file, {"pressure": f"{name} 1", "x": "Position"})


@shape
def groups_in_excel(draw: Draw, path: Path) -> Case:
    t = draw.times()
    rows: list[list[Any]] = [["", "Muscle 1", None, "Muscle 2", None]]
    rows += [["t", "p", "F", "p", "F"], ["s", "bar", "N", "bar", "N"]]
    seen = draw.seen("pressure", t, "bar"), draw.seen("force", t, "N")
    rows += zip(t, *seen, np.full(len(t), 1.5), 20 + t, strict=True)
    file = book(path / "groups.xlsx", rows, ["B1:C1", "D1:E1"])
    return record(draw, file, {"pressure": "Muscle 1 p", "force": "Muscle 1 F"})


@shape
def blocks_side_by_side(draw: Draw, path: Path) -> Case:
    truth = draw.table()
    levels = np.unique(truth["contraction"])
    say = draw.of("contraction {} %", "{} %", "kappa = {} %")
    gap, unit = draw.of(0, 1), draw.unit("pressure")
    rows: list[list[Any]] = [[], []]
    parts = [truth["contraction"] == k for k in levels]
    for k in levels:
        rows[0] += [say.format(f"{100 * k:g}"), None, *[None] * gap]
        rows[1] += [f"p [{unit}]", "F [N]", *[None] * gap]
    for i in range(int(parts[0].sum())):
        row: list[Any] = []
        for part in parts:
            cell = truth["pressure"][part][i] / TO_SI[unit], truth["force"][part][i]
            row += [*cell, *[None] * gap]
        rows.append(row)
    if draw.of(True, False):
        return Case(book(path / "blocks.xlsx", rows), truth)
    return Case(written(path / "blocks.csv", [line_of(r, ";", ",") for r in rows]), truth)


@shape
def clocks_side_by_side(draw: Draw, path: Path) -> Case:
    slow, fast = np.arange(0, 6, 0.02), np.arange(0, 6, 0.005)
    seen = slow, draw.seen("pressure", slow, "kPa"), fast, draw.seen("x", fast, "mm")
    rows: list[Any] = [["t [s]", "p [kPa]", "t [s]", "x [mm]"], *zip_longest(*seen)]
    return record(draw, book(path / "clocks.xlsx", rows), PX, tolerance=5e-3)


@shape
def html_that_calls_itself_xls(draw: Draw, path: Path) -> Case:
    made, truth = cells(draw)
    sign = draw.of(".", ",")
    head = "".join(f"<{draw.of('th', 'td')}>{h}</td>" for h in made)
    rows = zip(*made.values(), strict=True)
    body = "".join(
        "<tr>" + "".join(f"<td>{shown(v, sign)}&nbsp;</td>" for v in r) + "</tr>\n" for r in rows
    )
    title = draw.of("", f"<tr><td colspan={len(made)}><b>Export 12</b></td></tr>")
    file = path / "export.xls"
    file.write_text(
        f"<html><head><style>td {{color: red}}</style></head><body><table>{title}<tr>{head}</tr>"
        f"{body}</table></body></html>",
        encoding="utf-8",
    )
    return Case(file, truth)


# ---- MATLAB, Simulink, dSPACE --------------------------------------------------------------------
@shape
def matlab_level_4(draw: Draw, path: Path) -> Case:
    t = draw.times()
    made = {"time": t, "p_kPa": draw.seen("pressure", t, "kPa"), "x_mm": draw.seen("x", t, "mm")}
    made = {k: v[:, None] if draw.of(True, False) else v[None, :] for k, v in made.items()}
    file = path / "level4.mat"
    scipy.io.savemat(file, made, format="4")
    return record(draw, file, PX, CLOCK)


def fields(count: int, *names: str) -> np.ndarray:
    """A structure array of MATLAB's, in a row."""
    return np.empty((1, count), dtype=[(n, "O") for n in names])


def structure(t: Any, several: dict[str, Any], three: bool = False) -> dict[str, Any]:
    made = fields(len(several), "values", "dimensions", "label")
    for i, (label, values) in enumerate(several.items()):
        values = np.asarray(values)
        made[0, i] = (values.reshape(1, 1, -1) if three else values.reshape(len(t), -1), 1.0, label)
    return {"time": np.asarray(t)[:, None], "signals": made, "blockName": "rig/To Workspace"}


def of_a_scope(draw: Draw, t: np.ndarray) -> dict[str, Any]:
    return {"p [bar]": draw.seen("pressure", t, "bar"), "x [mm]": draw.seen("x", t, "mm")}


@shape
def to_workspace(draw: Draw, path: Path) -> Case:
    t, file = draw.times(), path / "out.mat"
    name = draw.of("ScopeData", "simout")
    scipy.io.savemat(file, {name: structure(t, of_a_scope(draw, t), draw.of(True, False))})
    return record(draw, file, PX)


@shape
def several_to_workspace(draw: Draw, path: Path) -> Case:
    a, b = np.arange(0, 5, 0.004), np.arange(0, 5, draw.of(0.004, 0.01))
    held: dict[str, Any] = {"p_bar": structure(a, {"": draw.seen("pressure", a, "bar")})}
    held["x_mm"] = structure(b, {"": draw.seen("x", b, "mm")})
    held |= draw.of({}, {"tout": a[:, None]})
    file = path / "out.mat"
    scipy.io.savemat(file, held)
    names = {"pressure": "p_bar", "x": "x_mm"}
    return record(draw, file, names, {"pick": ["p_bar", "x_mm"]}, tolerance=5e-3)


@shape
def structure_without_time(draw: Draw, path: Path) -> Case:
    t, file = np.arange(500) * 0.002, path / "out.mat"
    made = structure(t, of_a_scope(draw, t)) | {"time": np.zeros((0, 0))}
    scipy.io.savemat(file, {"simout": made})
    return record(draw, file, PX, {"sample_time": 0.002})


@shape
def dspace(draw: Draw, path: Path) -> Case:
    rasters = [np.arange(0, 4, 0.001), np.arange(0, 4, draw.of(0.001, 0.01))]
    two = not np.array_equal(*rasters)
    paths = {
        "pressure": draw.of('Model Root/"p1"/Out1', "p1", "Model Root/Sensors/p1"),
        "x": draw.of("Model Root/x/Out1", "x"),
    }
    y = fields(2, "Name", "Type", "Data", "Unit", "XIndex", "Path")
    for i, (kind, unit) in enumerate((("pressure", "bar"), ("x", "mm"))):
        values = draw.seen(kind, rasters[i if two else 0], unit)[None, :].astype(np.float32)
        y[0, i] = (paths[kind], "Signal", values, unit, float(1 + i * two), "")
    x = fields(1 + two, "Name", "Type", "Data", "Raster")
    for i in range(1 + two):
        x[0, i] = ("time", "Double", rasters[i][None, :], f"HostService{i}")
    file = path / "capture.mat"
    told = {"Application": "ControlDesk", "Version": 7.0}
    held = {"X": x, "Y": y, "Description": told, "RTProgram": "rig.sdf"}
    scipy.io.savemat(file, {"rec_001": held})
    return record(draw, file, {"pressure": "p1", "x": "x"}, tolerance=5e-3)


@shape
def hdf5(draw: Draw, path: Path) -> Case:
    import h5py

    t, file = draw.times(), path / "run.h5"
    with h5py.File(file, "w") as made:
        group = made.create_group("run/signals") if draw.of(True, False) else made
        for name, values, unit in (
            ("time", t, "s"),
            ("p1", draw.seen("pressure", t, "kPa"), "kPa"),
            ("x", draw.seen("x", t, "m"), "m"),
        ):
            group.create_dataset(name, data=values).attrs["unit"] = unit
    return record(draw, file, {"pressure": "p1", "x": "x"})


# ---- LabVIEW -------------------------------------------------------------------------------------
@shape
def lvm(draw: Draw, path: Path) -> Case:
    t = np.arange(500) * 0.002
    sign, kind = draw.of(".", ","), draw.of("One", "No", "Multi")
    names = draw.of(("Pressure", "Position"), ("p", "x"))
    made = draw.seen("pressure", t, "bar"), draw.seen("x", t, "mm")
    lines = ["LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab"]
    lines += [f"Decimal_Separator\t{sign}", "Multi_Headings\tNo", f"X_Columns\t{kind}"]
    lines += ["Time_Pref\tAbsolute", "Operator\tlab", "Date\t2024/03/12", f"Time\t14:05:01{sign}25"]
    lines += ["***End_of_Header***\t", "\t", "Channels\t2\t\t", "Samples\t500\t500\t"]
    lines += ["Y_Unit_Label\tbar\tmm\t", "X_Dimension\tTime\tTime\t"]
    lines += [f"X0\t0{sign}0E+0\t0{sign}0E+0\t", f"Delta_X\t0{sign}002\t0{sign}002\t"]
    lines += ["***End_of_Header***\t\t\t"]
    second = "X_Value\t" if kind == "Multi" else ""
    lines += [f"X_Value\t{names[0]}\t{second}{names[1]}\tComment"]
    for i, u in enumerate(t):
        p, x = (f"{v[i]:.6f}".replace(".", sign) for v in made)
        clock = "" if kind == "No" else f"{u:.6f}".replace(".", sign)
        lines.append(f"{clock}\t{p}\t{clock}\t{x}" if kind == "Multi" else f"{clock}\t{p}\t{x}")
    file = path / "test.lvm"
    file.write_text("\r\n".join(lines), encoding="latin-1")
    return record(draw, file, dict(zip(("pressure", "x"), names, strict=True)), tolerance=5e-3)


@shape
def tdms(draw: Draw, path: Path) -> Case:
    from nptdms import ChannelObject, TdmsWriter

    steps = (0.001, draw.of(0.001, 0.01))
    kind = draw.of("waveform", "waveform", "time channel")
    start = np.datetime64("2024-03-12T14:05:01.250000")
    made = []
    if kind == "time channel":
        t = np.arange(0, 4, 0.001)
        made.append(ChannelObject("Data", "Time", t, {"unit_string": "s"}))
    both = (("p", "bar", "pressure"), ("x", "mm", "x"))
    for (name, unit, what), step in zip(both, steps, strict=True):
        t = np.arange(0, 4, 0.001 if kind == "time channel" else step)
        told: dict[str, Any] = {"unit_string": unit}
        if kind == "waveform":
            told |= {"wf_increment": step, "wf_start_offset": 0.0, "wf_start_time": start}
            told["wf_samples"] = len(t)
        made.append(ChannelObject("Data", name, draw.seen(what, t, unit), told))
    file = path / "log.tdms"
    with TdmsWriter(file) as writer:
        writer.write_segment(made)
    return record(draw, file, PX, tolerance=5e-3)


# ---- ROS -----------------------------------------------------------------------------------------
START = 1_710_252_301_250_000_000


def topics(draw: Draw) -> list[tuple[str, np.ndarray, Callable[[Any], Any]]]:
    signals = draw.signals()
    rates = draw.of((100.0, 100.0), (200.0, 100.0), (250.0, 50.0))
    late = draw.random.uniform(0, 0.02)
    return [
        (draw.of("/rig/pressure", "/pressure"), np.arange(0, 5, 1 / rates[0]), signals["pressure"]),
        ("/rig/x", late + np.arange(0, 5, 1 / rates[1]), signals["x"]),
    ]


def of_topics(draw: Draw, file: Path, several: Any) -> Case:
    (_, a, _), (_, b, _) = several
    main = a if a.size >= b.size else b
    first = float(main[main >= max(a[0], b[0]) - 1e-9][0])
    return record(draw, file, {"pressure": "pressure", "x": "x"}, first=first, tolerance=1e-2)


def write_ros(writer: Any, store: Any, several: Any, serialize: Any) -> None:
    """Numbers, and two remarks."""
    remarks = ("/remarks", [0.1, 3.0], lambda u: "valve opened")
    for topic, t, f in (*several, remarks):
        kind = store.types[f"std_msgs/msg/{'String' if topic == '/remarks' else 'Float64'}"]
        connection = writer.add_connection(topic, kind.__msgtype__, typestore=store)
        for u in t:
            value = f(u)
            message = kind(data=value if isinstance(value, str) else float(value))
            raw = serialize(message, kind.__msgtype__)
            writer.write(connection, START + round(u * 1e9), raw)


@shape
def rosbag_1(draw: Draw, path: Path) -> Case:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    several, store = topics(draw), get_typestore(Stores.ROS1_NOETIC)
    file = path / "run.bag"
    with Writer(file) as writer:
        write_ros(writer, store, several, store.serialize_ros1)
    return of_topics(draw, file, several)


@shape
def rosbag_2(draw: Draw, path: Path) -> Case:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    several, store = topics(draw), get_typestore(Stores.ROS2_HUMBLE)
    file = path / "run"
    plugin = draw.of(StoragePlugin.SQLITE3, StoragePlugin.MCAP)
    with Writer(file, version=9, storage_plugin=plugin) as writer:
        write_ros(writer, store, several, store.serialize_cdr)
    inside = draw.of(None, "*.db3" if plugin is StoragePlugin.SQLITE3 else "*.mcap")
    return of_topics(draw, file if inside is None else next(file.glob(inside)), several)


@shape
def joint_states(draw: Draw, path: Path) -> Case:
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    t, signals = np.arange(0, 5, 0.01), draw.signals()
    state, header = kinds["sensor_msgs/msg/JointState"], kinds["std_msgs/msg/Header"]
    time = kinds["builtin_interfaces/msg/Time"]
    file = path / "joints"
    with Writer(file, version=9) as writer:
        connection = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for u in t:
            ns = START + round(u * 1e9)
            message = state(
                header=header(stamp=time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id=""),
                name=["slide", "arm"],
                position=np.array([signals["x"](u), 0.1]),
                velocity=np.array([0.0, 0.0]),
                effort=np.array([signals["force"](u), 0.0]),
            )
            late = ns + int(draw.random.uniform(0, 3e6))  # when it arrived
            writer.write(connection, late, store.serialize_cdr(message, state.__msgtype__))
    names = {"x": "joint_states.position.slide", "force": "joint_states.effort.slide"}
    return record(draw, file, names)


@shape
def mcap_of_json(draw: Draw, path: Path) -> Case:
    from mcap.writer import Writer

    several = topics(draw)
    file = path / "run.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, t, f in several:
            text = json.dumps({"type": "object", "properties": {"data": {"type": "number"}}})
            schema = writer.register_schema("Number", "jsonschema", text.encode())
            channel = writer.register_channel(topic, "json", schema)
            for u in t:
                ns = START + round(u * 1e9)
                data = json.dumps({"data": float(f(u))}).encode()
                writer.add_message(channel, log_time=ns, publish_time=ns, data=data)
        writer.finish()
    return of_topics(draw, file, several)


# ---- JSON and pandas -----------------------------------------------------------------------------
@shape
def nested_json(draw: Draw, path: Path) -> Case:
    t = draw.times()
    p, x = draw.seen("pressure", t, "kPa"), draw.seen("x", t, "mm")
    kind = draw.of("channels", "mapping", "records", "lines", "united records")
    file = path / "run.json"
    several = (("time", "s", t.tolist()), ("p", "kPa", p.tolist()), ("x", "mm", x.tolist()))
    if kind == "channels":
        channels = [{"name": n, "unit": u, "data": v} for n, u, v in several]
        made: Any = {"meta": {"rig": 4, "by": "lab"}, "channels": channels}
    elif kind == "mapping":
        data = {n: {"unit": u, "values": v} for n, u, v in several}
        made = {"info": {"rate": 100}, "data": data}
    elif kind == "united records":
        made = [
            {"t": u, "p": {"value": a, "unit": "kPa"}, "x": {"value": b, "unit": "mm"}}
            for u, a, b in zip(t, p, x, strict=True)
        ]
    else:
        made = [{"t": u, "rig": {"p_kPa": a, "x_mm": b}} for u, a, b in zip(t, p, x, strict=True)]
    if kind == "lines":
        file = path / draw.of("run.jsonl", "run.log")
        file.write_text("\n".join(map(json.dumps, made)))
    else:
        file.write_text(json.dumps(made, indent=draw.of(None, 1)))
    nested = kind in ("records", "lines")
    names = {"pressure": "rig.p_kPa" if nested else "p", "x": "rig.x_mm" if nested else "x"}
    return record(draw, file, names, CLOCK)


@shape
def frame_with_an_index_of_times(draw: Draw, path: Path) -> Case:
    import pandas as pd

    t = draw.times()
    made, names = columns(draw, t)
    since = pd.to_timedelta(t, unit="s")
    begin = pd.Timestamp("2024-10-27 00:59:59", tz=draw.of(None, "UTC")) + since
    if begin.tz is not None:
        begin = begin.tz_convert(draw.of("Europe/Berlin", "UTC"))
    index = draw.of(begin, since, pd.Index(t, name="time [s]"))
    frame = pd.DataFrame(made, index=index)
    if draw.of(True, False):
        return record(draw, frame, names)
    frame.to_parquet(path / "run.parquet")
    return record(draw, path / "run.parquet", names)


# ---- reading -------------------------------------------------------------------------------------
def plain(name: str) -> str:
    """A name without its unit, as records call their variables."""
    text = re.sub(r"\s*[\[(][^\])]*[\])]$|/[^/\s]+$", "", name)
    text = re.sub(r"_(kPa|mm|bar)$", "", text) if "effort" not in text else text
    return re.sub(r"\W", "_", text).lower()


def is_right(case: Case, result: Any) -> bool:
    if isinstance(result, pam.fitting.ForceTable):
        if case.record or len(result) != len(case.truth["pressure"]):
            return False
        order, wanted = (
            np.lexsort((np.round(a["pressure"]), np.round(a["contraction"], 6)))
            for a in ({"pressure": result.pressure, "contraction": result.contraction}, case.truth)
        )
        return all(
            np.allclose(getattr(result, k)[order], v[wanted], rtol=1e-5, atol=1e-6)
            for k, v in case.truth.items()
        )
    t = result.t - result.t[0] + case.first
    names = {plain(v.name): v.name for v in result.variables}
    for kind, truth in case.truth.items():
        name = names.get(plain(case.names[kind]), names.get(kind))
        if name is None:
            return False
        wanted = truth(t)
        if np.max(np.abs(result[name] - wanted)) > case.tolerance * np.ptp(wanted):
            return False
    return len(result) > 200


def asked(sentence: str, answers: dict[str, Any], given: dict[str, Any]) -> str | None:
    """The keyword that a sentence names and the user can answer."""
    named = [k for k in answers if k not in given and re.search(rf"\b{k}\b", sentence)]
    return named[0] if named else None


def read(case: Case) -> tuple[str, str]:
    """(outcome, what was said)."""
    given: dict[str, Any] = {}
    for _ in range(5):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                result = (pam.read_record if case.record else pam.read_table)(case.source, **given)
            except pam.PamError as error:
                sentence = str(error)
                keyword = asked(sentence, case.answers, given)
                if keyword is None:
                    helped = re.search(r"\w+=|give |save |say |name ", sentence)
                    return ("refused, helped" if helped else "refused"), sentence
                given[keyword] = case.answers[keyword]
                continue
        words = " ".join(str(w.message) for w in told)
        if is_right(case, result):
            return ("right with " + ", ".join(given) if given else "right"), words
        doubt = " ".join(str(w.message) for w in told if w.category is pam.UnitWarning)
        keyword = asked(doubt, case.answers, given)
        if keyword is None:
            return ("wrong, doubted" if doubt else "WRONG IN SILENCE"), words or repr(result)
        given[keyword] = case.answers[keyword]
    return "refused", sentence


def one(number: int, seed: int, folder: Path, show: bool = False) -> harness.Row:
    """A file of the next shape, read."""
    name = list(SHAPES)[number % len(SHAPES)]
    place = folder / f"{number:03d}_{name}"
    place.mkdir(parents=True)
    outcome, words = read(SHAPES[name](Draw([seed, number]), place))
    right = outcome.startswith("right with")
    row = {"verdict": "right with a keyword" if right else outcome, "text": f"{name}: {outcome}"}
    return {**row, "why": [words] if show or not outcome.startswith("right") else []}


def cases(given: harness.Given) -> harness.Keyed:
    with tempfile.TemporaryDirectory() as scratch:
        for number in harness.numbers(given):
            yield number, partial(one, number, given.seed, given.keep or Path(scratch), given.show)


OPTIONS = {
    "--keep": {"type": Path, "help": "folder in which the files stay"},
    "--show": harness.flag("what was said of each file"),
}

if __name__ == "__main__":
    rows = harness.main(__doc__, cases, count=100, seed=0, options=OPTIONS)
    sys.exit(any(row["verdict"] == "WRONG IN SILENCE" for row in rows))
