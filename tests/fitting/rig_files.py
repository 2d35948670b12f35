"""Files as rigs write them, with the truth that stands in them.

    python tests/fitting/rig_files.py FOLDER        # writes them all, to look at

The muscle is McKibben's ideal one, F = pi r^2 p (a (1 - kappa)^2 - b), never below zero. Each case
says what the reader is given at first, and, where the file cannot say all, what a user answers to
the sentence that asks for it.
"""

from __future__ import annotations

import csv
import gzip
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

REST = 0.3
KAPPAS = np.array([0.0, 0.05, 0.10, 0.15])
BARS = np.array([0.5, 1.5, 3.0, 4.5, 6.0])
HEAD = ["length [mm]", "pressure [bar]", "force [N]"]
FROM_SENTENCE = "the literal that stands in the sentence"


def mckibben(p: Any, kappa: Any) -> Any:
    """Force [N] of a muscle of radius 10 mm and a braid of 20 degrees."""
    braid = np.radians(20.0)
    a, b = 3 / np.tan(braid) ** 2, 1 / np.sin(braid) ** 2
    return np.maximum(np.pi * 0.01**2 * p * (a * (1 - kappa) ** 2 - b), 0.0)


@dataclass
class Case:
    """A file. truth : {name: SI values}. given : keywords at first; asks : the keyword that the
    sentence must ask for, answer : its value.
    """

    name: str
    source: Any
    truth: dict[str, Any]
    kind: str = "table"
    given: dict[str, Any] = field(default_factory=dict)
    asks: str = ""
    answer: Any = FROM_SENTENCE
    rtol: float = 1e-4
    says: str = ""


def grid() -> dict[str, Any]:
    """The cells of the static test, row after row."""
    kappa, p = (a.ravel() for a in np.meshgrid(KAPPAS, BARS * 1e5, indexing="ij"))
    return {"contraction": kappa, "pressure": p, "force": mckibben(p, kappa)}


def without(truth: dict[str, Any], rows: Any) -> dict[str, Any]:
    """The same but for some rows."""
    return {k: np.delete(v, list(rows)) for k, v in truth.items()}


def in_bench_units() -> dict[str, Any]:
    """Lengths in mm, pressures in bar, forces in N."""
    t = grid()
    return {"l": (1 - t["contraction"]) * 300, "p": t["pressure"] / 1e5, "F": t["force"]}


def text(rows: Any, between: str = ",", form: Callable[[Any], str] = lambda v: f"{v:.7g}") -> str:
    return "\n".join(between.join(c if isinstance(c, str) else form(c) for c in r) for r in rows)


def rows(*more: Any) -> list[list[Any]]:
    b = in_bench_units()
    return [list(r) for r in zip(b["l"], b["p"], b["F"], *more, strict=True)]


def german(v: Any) -> str:
    """1.234,567"""
    return f"{v:,.3f}".replace(",", "_").replace(".", ",").replace("_", ".")


# ---- texts ---------------------------------------------------------------------------------------
def texts(folder: Path) -> list[Case]:
    truth, made = grid(), []

    def add(name: str, content: str | bytes, encoding: str = "utf-8", **case: Any) -> Case:
        file = folder / name
        file.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
        given = {"rest_length": REST, **case.pop("given", {})}
        made.append(Case(name, file, case.pop("truth", truth), given=given, **case))
        return made[-1]

    plain = [HEAD, *rows()]
    add("english.csv", text(plain))
    add("german.csv", text([["Länge in mm", "Druck in bar", "Kraft in N"], *rows()], ";", german))
    add("latin.csv", text([["Länge/mm", "Druck/bar", "Kraft/N"], *rows()], ";", german), "latin-1")
    umlauts = text([["Länge [mm]", "Druck [bar]", "Kraft [N]"], *rows()], "\t", german)
    add("utf16.txt", "\ufeff" + umlauts, "utf-16-le")
    french = ["Longueur (mm)", "Pression (bar)", "Force (N)"]
    add("french.csv", text([french, *rows()], ";", german))
    add("spanish.txt", text([["Longitud (mm)", "Presión (bar)", "Fuerza (N)"], *rows()], "\t"))
    add("units_row.csv", text([["length", "pressure", "force"], ["mm", "bar", "N"], *rows()]))
    titles = [["Rig 7, muscle 3"], ["date", "2024-03-12"], ["l0", "300", "mm"], [""]]
    titles += [["Länge", "Druck", "Kraft"], ["[mm]", "[bar]", "[N]"]]
    add("titles.csv", text([*titles, *rows()], ";", german))
    add("no_header.csv", text(rows()), asks="columns", answer=HEAD)
    add("blanks.dat", "% rig 7\n%  l [mm]   p [bar]   F [N]\n" + text(rows(), "   "))
    add("savetxt.txt", "# length_mm pressure_bar force_N\n" + text(rows(), " "))
    words = "muscle length [mm]  gauge pressure [bar]  pulling force [N]\n"
    add("words.txt", words + text(rows(), "  "))
    add("packed.csv.gz", gzip.compress(text(plain).encode()))
    thousands = [[f"{r[0]:.3f}", f"{r[1]:.3f}", f'"{r[2]:,.4f}"'] for r in rows()]
    add("commas_in_thousands.csv", text([["l [mm]", "p [bar]", "F [N]"], *thousands]))
    holes = [["l [mm]", "p [bar]", "F [N]"], *rows()]
    holes[4], holes[9] = [*holes[4][:2], ""], [holes[9][0], "NaN", holes[9][2]]
    dropped = "2 of 20 rows dropped for empty cells"
    add("empty_cells.csv", text(holes), truth=without(truth, [3, 8]), says=dropped)
    add("cut_off.csv", text(plain)[:-9], truth=without(truth, [19]), says="the last, is cut off")
    absolute = [[r[0], r[1] + 1.01325, r[2]] for r in rows()]
    heads = {"absolute": "p_abs [bar]", "absolute0": "p_bar_abs", "absolute1": "p [bar] (abs)"}
    heads |= {"absolute2": "Druck absolut [bar]", "absolute3": "p_bara", "bar_a": "p [bar(a)]"}
    for name, head in heads.items():
        add(f"{name}.csv", text([["l [mm]", head, "F [N]"], *absolute]))
    volts = [["l [mm]", "p [V]", "F [N]"], *([r[0], (r[1] + 0.3) / 2, r[2]] for r in rows())]
    add("volts.csv", text(volts), asks="units", answer={"pressure": "V * 2 bar/V - 0.3 bar"})
    loop = [["l [mm]", "p [bar]", "F [mA]"], *([r[0], r[1], 4 + r[2] / 100] for r in rows())]
    add("loop.csv", text(loop), asks="units", answer={"force": "(mA - 4 mA) * 100 N/mA"})
    counts = [["l [mm]", "p [counts]", "F [N]"], *([r[0], r[1] * 400, r[2]] for r in rows())]
    add("counts.csv", text(counts), asks="units", answer={"pressure": "counts / 400 * 1 bar"})
    add("channel.csv", text([["length [mm]", "ch1 [bar]", "force [N]"], *rows()]), asks="columns")
    both = [[r[0], r[1] + 0.05, r[1], r[2]] for r in rows()]
    add("set_and_measured.csv", text([["l [mm]", "p_soll [bar]", "p_ist [bar]", "F [N]"], *both]))
    add("excel.csv", "sep=;\n" + text(plain, ";", german))
    left_out = "2 rows of words below the numbers left out"
    add("footer.csv", text([*plain, ["mean", "", ""], ["end of file"]]), says=left_out)
    numbered = [["no.", *HEAD], *([i, *r] for i, r in enumerate(rows()))]
    sums = [["Mean:", 280.0, 3.1, 500.0], ["Std", 17.0, 2.0, 400.0]]
    add("sums.csv", text([*numbered, *sums]), says="2 rows that sum up left out ('Mean:'")
    add("bars.psv", text(plain, " | "))
    lab = "LabVIEW Measurement\t\t\nSeparator\tTab\t\n***End_of_Header***\t\t\n"
    add("labview.lvm", lab + text(plain, "\t"))
    odd = "3 12 2024\n" + text(plain, " ").replace(" [", "_[")
    add("numbers_in_title.txt", odd, given={"skip": 1})
    return made


def tables(folder: Path) -> list[Case]:
    """Pivots and labels."""
    truth, made = grid(), []
    force = truth["force"].reshape(4, 5)

    def add(name: str, content: str, **case: Any) -> None:
        (folder / name).write_text(content, "utf-8")
        made.append(Case(name, folder / name, case.pop("truth", truth), **case))

    cells = [[100 * k, *f] for k, f in zip(KAPPAS, force, strict=True)]
    add("pivot.csv", text([["kappa [%] \\ p [bar]", *BARS], *cells]))
    heads = [f"{b:g} bar" for b in BARS]
    add("pivot_titles.csv", text([["Force [N]"], ["kontraktion [%]", *heads], *cells], ";", german))
    named = ("contraction [%]", "pressure [bar]", "force [N]")
    add("pivot_bare.csv", text([["", *BARS], *cells]), asks="pivot", answer=named)
    holes = [[*r] for r in cells]
    holes[3][1] = holes[3][2] = ""
    told = {"truth": without(truth, [15, 16]), "says": "2 empty cells of the pivot"}
    add("pivot_holes.csv", text([["contraction [%]", *heads], *holes]), **told)
    folder = folder / "per_length"
    folder.mkdir()
    for k, forces in zip(KAPPAS, force, strict=True):
        part = [[100 * k, *pair] for pair in zip(BARS, forces, strict=True)]
        name = f"kappa{100 * k:02.0f}.csv"
        (folder / name).write_text(text([["kappa [%]", "p [bar]", "F [N]"], *part]))
    made.append(Case("folder", folder, truth))
    made.append(Case("pattern", str(folder / "kappa*.csv"), truth))
    return made


# ---- workbooks -----------------------------------------------------------------------------------
def workbooks(folder: Path) -> list[Case]:
    from openpyxl import Workbook

    truth, made = grid(), []

    def add(name: str, sheets: dict[str, Any], **case: Any) -> None:
        book = Workbook()
        book.remove(book.active)
        for title, content in sheets.items():
            sheet = book.create_sheet(title)
            for row in content:
                sheet.append(row)
        book.save(folder / name)
        given = {"rest_length": REST, **case.pop("given", {})}
        made.append(Case(name, folder / name, truth, given=given, **case))

    add("plain.xlsx", {"Tabelle1": [HEAD, *rows()]})
    add("texts.xlsx", {"Tabelle1": [HEAD, *[[german(c) for c in r] for r in rows()]]})
    titles = [["Rig 7"], [], [None, "l", "p", "F"], [None, "mm", "bar", "N"]]
    add("titles.xlsx", {"S": [*titles, *[[None, *r] for r in rows()]]})
    add("second_sheet.xlsx", {"Info": [["muscle", "DMSP"], ["by", "me"]], "Data": [HEAD, *rows()]})
    two = {"zero": [["t", "v"], [0, 1], [1, 2]], "M3": [HEAD, *rows()]}
    add("two_sheets.xlsx", two, asks="sheet")
    force = truth["force"].reshape(4, 5).tolist()
    pivot = [[k, *f] for k, f in zip(KAPPAS.tolist(), force, strict=True)]
    head = [["Force [N]", None, "pressure [bar]"], ["contraction", *BARS.tolist()]]
    add("pivot.xlsx", {"F": [*head, *pivot]})
    return made


# ---- nested and binary ---------------------------------------------------------------------------
def binaries(folder: Path) -> list[Case]:
    from scipy.io import savemat

    truth, made = grid(), []
    b = in_bench_units()
    matrix, named = np.array(rows()), HEAD
    fields = {"length_mm": b["l"], "pressure_bar": b["p"], "force_N": b["F"]}

    def add(name: str, **case: Any) -> None:
        given = {"rest_length": REST, **case.pop("given", {})}
        made.append(Case(name, folder / name, truth, given=given, **case))

    savemat(folder / "matrix.mat", {"data": matrix})
    add("matrix.mat", asks="columns", answer=named)
    savemat(folder / "structure.mat", {"rig": {"no": 7.0, "run": fields}}, do_compression=True)
    add("structure.mat")
    scaled = {**fields, "force_N": 2 * b["F"]}
    savemat(folder / "two.mat", {"a": {"run": scaled}, "b": {"run": fields}})
    add("two.mat", asks="pick", answer="b.run")
    cells = np.empty((21, 3), object)
    cells[0], cells[1:] = named, matrix
    savemat(folder / "cells.mat", {"T": cells})
    add("cells.mat")
    records = np.zeros((1, 20), [("length_mm", "O"), ("pressure_bar", "O"), ("force_N", "O")])
    for i, row in enumerate(matrix):
        records[0, i] = tuple(row)
    savemat(folder / "array_of_structures.mat", {"S": records})
    add("array_of_structures.mat")
    np.save(folder / "matrix.npy", matrix)
    add("matrix.npy", asks="columns", answer=named)
    typed = np.zeros(20, [("l_mm", "f8"), ("p_bar", "f4"), ("F_N", "f8")])
    typed["l_mm"], typed["p_bar"], typed["F_N"] = b["l"], b["p"], b["F"]
    np.save(folder / "typed.npy", typed)
    add("typed.npy")
    np.savez(folder / "arrays.npz", **fields, rig=7, l0=0.3)
    add("arrays.npz")
    objects = [dict(zip(fields, row, strict=True)) for row in matrix.tolist()]
    (folder / "objects.json").write_text(json.dumps(objects))
    add("objects.json")
    lists = {"rig": "7", "data": {k: list(v) for k, v in fields.items()}}
    (folder / "lists.json").write_text(json.dumps(lists))
    add("lists.json")
    (folder / "lines.jsonl").write_text("\n".join(map(json.dumps, objects)))
    add("lines.jsonl")
    (folder / "rows.json").write_text(json.dumps([named, *matrix.tolist()]))
    add("rows.json")
    split = {"columns": named, "index": list(range(20)), "data": matrix.tolist()}
    (folder / "split.json").write_text(json.dumps(split))
    add("split.json")
    savemat(folder / "headed.mat", {"names": np.array(list(fields), object), "data": matrix})
    add("headed.mat")
    return [*made, *_optional(folder, fields, truth)]


def _optional(folder: Path, fields: dict[str, Any], truth: dict[str, Any]) -> list[Case]:
    """HDF5 as MATLAB writes it, and Parquet."""
    import h5py
    import pandas as pd

    with h5py.File(folder / "v73.mat", "w", userblock_size=512) as file:
        group = file.create_group("rig").create_group("run")
        for name, values in fields.items():
            data = group.create_dataset(name, data=np.atleast_2d(values))
            data.attrs["MATLAB_class"] = np.bytes_("double")
    with (folder / "v73.mat").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    pd.DataFrame(fields).to_parquet(folder / "frame.parquet")
    given = {"rest_length": REST}
    return [Case(n, folder / n, truth, given=given) for n in ("v73.mat", "frame.parquet")]


# ---- records -------------------------------------------------------------------------------------
def records(folder: Path) -> list[Case]:
    t = np.arange(300) * 0.02
    p, x = 3e5 + 1e5 * np.sin(3 * t), 0.01 * np.sin(3 * t - 0.5)
    truth = {"t": t, "p": p, "x": x}
    start = datetime(2024, 3, 12, 23, 59, 57)
    stamps = [start + timedelta(seconds=float(s)) for s in t]
    made: list[Case] = []

    def add(name: str, clock: Any, head: str = "time", **case: Any) -> None:
        kept = case.pop("rows", range(len(clock)))
        content = [[clock[i], p[i] / 1e5, 1e3 * x[i]] for i in kept]
        with (folder / name).open("w", newline="") as file:
            writer = csv.writer(file, delimiter=case.pop("between", ","))
            writer.writerow([*head.split("|"), "p [bar]", "x [mm]"])
            for stamp, *values in content:
                cells = stamp if isinstance(stamp, list) else [stamp]
                writer.writerow([*cells, *(f"{v:.8g}" for v in values)])
        made.append(Case(name, folder / name, case.pop("truth", truth), "record", **case))

    from scipy.io import savemat

    signals = np.array([(p, "p"), (x, "x")], [("values", "O"), ("label", "O")])
    savemat(folder / "simulink.mat", {"out": {"time": t, "signals": signals}})
    made.append(Case("simulink.mat", folder / "simulink.mat", truth, "record"))
    nested = {"time": t.tolist(), "signals": {"p [Pa]": p.tolist(), "x [mm]": (1e3 * x).tolist()}}
    (folder / "nested.json").write_text(json.dumps(nested))
    made.append(Case("nested.json", folder / "nested.json", truth, "record"))

    add("seconds.csv", t)
    add("milliseconds.csv", 1e3 * t, "Zeit [ms]")
    add("iso.csv", [s.isoformat(timespec="milliseconds") + "Z" for s in stamps], "timestamp")
    dates = [f"{s:%d.%m.%Y %H:%M:%S}.{s.microsecond // 1000:03d}" for s in stamps]
    add("german_dates.csv", dates, "Datum", between=";")
    add("hungarian.csv", [f"{s:%Y. %m. %d. %H:%M:%S.%f}" for s in stamps], "time")
    month = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"]
    matlab = [f"{s:%d}-{month[s.month - 1]}-{s:%Y %H:%M:%S.%f}" for s in stamps]
    add("matlab_dates.csv", matlab, "time")
    add("two_columns.csv", [[f"{s:%d.%m.%Y}", f"{s:%H:%M:%S.%f}"] for s in stamps], "Datum|Uhrzeit")
    half = ("AM", "PM")  # %p is empty in some locales
    american = [f"{s:%m/%d/%Y %I:%M:%S.%f} {half[s.hour // 12]}" for s in stamps]
    add("american.csv", american, "Date")
    add("time_of_day.csv", [f"{s:%H:%M:%S.%f}" for s in stamps], "Time")
    add("epoch.csv", [f"{1e3 * s.timestamp():.0f}" for s in stamps], "timestamp")
    add("days.csv", [f"{45363 + (86397 + s) / 86400:.10f}" for s in t], "Date", rtol=2e-3)
    add("coarse.csv", [f"{s:%H:%M:%S}" for s in stamps], "time", says="the clock ticks every 1 s")
    still = t.copy()
    still[[40, 90, 91]] = still[[39, 89, 89]]
    rest = without(truth, [40, 90, 91])
    add("stands_still.csv", still, truth=rest, says="the clock stands still: 3 rows")
    counter, later = (np.round(1e3 * t) + 62_000) % 65_536, {**truth, "t": t + 62.0}
    add("counter.csv", counter, "time [ms]", truth=later, says="begins anew after 65.536 s")
    wrong = t.copy()
    wrong[120] = 99.0
    rest = without(truth, [120])
    add("wrong_stamp.csv", wrong, truth=rest, says="1 rows of a single wrong time")
    jumps = t + np.where(np.arange(300) >= 200, 60.0, 0.0)
    rest = without(truth, range(200, 300))
    add("jumps.csv", jumps, truth=rest, asks="clock", says="the clock jumps")
    back = t - np.where(np.arange(300) >= 100, 1.5, 0.0)
    rest = {**without(truth, range(100)), "t": back[100:]}
    add("back.csv", back, truth=rest, asks="clock", says="the clock jumps: cut into 2 parts")
    rng = np.random.default_rng(5)
    uneven = t + np.where(np.arange(300) % 299 == 0, 0.0, 0.002 * rng.uniform(-1, 1, 300))
    values = {"p": np.interp(t, uneven, p), "x": np.interp(t, uneven, x)}
    add("jitter.csv", uneven, given={"sample_time": 0.02}, truth={"t": t, **values}, rtol=2e-3)
    return made


# ---- ramps ---------------------------------------------------------------------------------------
def ramp_rows(seed: int = 3, clip: float = 0.0, held: str = "contraction") -> dict[str, Any]:
    """A slow ramp of some 15 000 rows: five levels, two cycles each, dwells, noise that follows
    itself, hysteresis of 4 % between the branches.
    """
    rng = np.random.default_rng(seed)
    parts, level = [], 0.0
    for level in (0.0, 0.05, 0.10, 0.15, 0.20):
        dwell = np.zeros(100)
        up = np.linspace(0, 1, 600)
        for _ in range(2):
            course = np.concatenate([dwell, up, dwell + 1, up[::-1], dwell])
            branch = np.concatenate([dwell + 1, np.ones(700), -np.ones(600), -dwell - 1])[:1500]
            parts.append(np.column_stack([np.full(1500, level), course, branch]))
    k, course, branch = np.concatenate(parts).T
    if held == "contraction":
        p = 6e5 * course
        kappa = k + 2e-4 * rng.standard_normal(k.size)
    else:
        p, kappa = 1e5 + 2.5e6 * k, 0.2 * course
        branch = -branch
    noise = rng.standard_normal(k.size)
    for i in range(1, noise.size):
        noise[i] = 0.8 * noise[i - 1] + 0.6 * noise[i]
    force = mckibben(p, kappa) * (1 - 0.02 * branch) + noise
    force = np.where(mckibben(p, kappa) > 0, force, noise) + 2.0
    shown = p + 300 * rng.standard_normal(k.size)
    return {"p": shown, "kappa": kappa, "F": np.maximum(force, clip)}


def all_cases(folder: Path) -> list[Case]:
    """Writes all files into a folder."""
    made = []
    for write in (texts, tables, workbooks, binaries, records):
        (folder / write.__name__).mkdir(parents=True)
        made += write(folder / write.__name__)
    return made


if __name__ == "__main__":
    print(f"{len(all_cases(Path(sys.argv[1])))} files")
