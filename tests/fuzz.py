"""Damaged files: every reader answers with one sentence of our own, or reads what is there.

    python tests/fuzz.py --count 4000 --seed 7 [--only load_plan] [--keep DIR]

Sound files of all formats are damaged at random and read. What counts as a failure: an exception
that is no InputError, one that does not name the file or is no single line, a warning of a library,
more than 5 s of processor time. ``--keep`` writes the files that failed there.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import gzip
import io
import json
import random
import re
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parent / "fitting"))
import rig_files
from conftest import benchmark_slide
from scipy.io import savemat

import pam_ocp as pam
from pam_ocp.cli import plan as motion_commands
from pam_ocp.cli.main import _parser
from pam_ocp.core.errors import InputError, PlanWarning
from pam_ocp.core.quantities import UnitWarning
from pam_ocp.fitting import ReadingWarning, fit_plant, look, read_record
from pam_ocp.fitting.dynamic.plant_fit import load_plant_fit
from pam_ocp.fitting.static.force_fit import ForceFit
from pam_ocp.studies.problem import guarded, set_up

LONGEST_SENTENCE = 1500
SLOWEST = 5.0
"""Seconds of processor time of one reading; a stopwatch would measure the machine."""


# ---- sound files ---------------------------------------------------------------------------------
@dataclass(frozen=True)
class Reader:
    """A reader and a sound file for it; ``weight`` is how often it is chosen."""

    name: str
    file: Path
    read: Callable[[Path], Any]
    weight: float = 1.0


def cart() -> pam.Plant:
    plant = pam.Plant("cart")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    f = plant.input("force", unit="N")
    m = plant.parameter("mass", 2.0, unit="kg", min=0.0)
    plant.der(x, v)
    plant.der(v, f / m)
    return plant


PROBLEM = """\
cyclic = true
minimise = { time = 1.0, effort = 1e-4 }
duration = { min = "20 ms", max = "1 s" }
options = { max_iter = 50 }
starts = 1
[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
mass = "2 kg"
pre_contraction = "10 %"
feed = { kind = "Regulator", lag = "50 ms", max_pressure = "6 bar", max_rate = "40 bar/s" }
[[stops]]
x = "-15 mm"
[[stops]]
x = "15 mm"
dwell = "0.1 s"
[bounds]
"muscle1.force" = { min = "20 N" }
[track]
x = { aim = 0.0, weight = 2 }
[[constraints]]
expression = "muscle1.force - muscle2.force"
max = 900
[method]
kind = "Collocation"
degree = 7
"""
STUDY = """\
records = ["run.csv"]
free = ["damping"]
noise = { x = "0.02 mm" }
bounds = { damping = [1.0, 100.0] }
columns = { x = "x" }
delay = ["0 ms", "5 ms"]
[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
mass = "2 kg"
feed = { kind = "Regulator", lag = "50 ms", max_pressure = "6 bar" }
"""
LOOP = """\
duration = "0.1 s"
real = { mass = "2.6 kg" }
start = { x = 0.0, stiffness = 2e4 }
noise = { x = "0.02 mm" }
[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
mass = "2 kg"
[reference]
x = { stops = ["10 mm", "-10 mm"], dwell = "0.4 s", rest = 0.0, rest_from = "1.2 s" }
[controller]
kind = "mpc"
horizon = 4
sample_time = 0.005
track = { x = 1.0 }
[estimator]
kind = "none"
"""


def readers(folder: Path, planned: bool = True) -> list[Reader]:
    """All readers with sound files in a folder. planned : also of plans, which take a solve."""
    slide = benchmark_slide()
    motion = pam.simulate(slide, t=np.linspace(0.0, 0.05, 11))
    found = [
        Reader(f"Trajectory.load {e}", motion.save(folder / f"run{e}"), pam.Trajectory.load)
        for e in (".csv", ".npz", ".parquet")
    ]
    table = {
        "pressure [bar]": np.repeat([1.0, 3.0, 5.0], 6),
        "contraction": np.tile(np.linspace(0, 0.2, 6), 3),
        "force [N]": np.linspace(10, 900, 18),
    }
    record = {"time [s]": motion.t, "x [mm]": 1e3 * motion["x"], "v": motion["v"]}
    for kind, columns, read in (
        ("read_table", table, lambda f: pam.read_table(f, rest_length=0.3)),
        ("read_record", record, read_record),
    ):
        frame = pd.DataFrame(columns)
        for ending, write in (
            (".csv", lambda f, d=frame: d.to_csv(f, index=False)),
            (".tsv", lambda f, d=frame: d.to_csv(f, index=False, sep="\t")),
            (".xlsx", lambda f, d=frame: d.to_excel(f, index=False)),
            (".parquet", lambda f, d=frame: d.to_parquet(f)),
            (".npz", lambda f, c=columns: np.savez(f, **c)),
            (".mat", lambda f, c=columns: savemat(f, {_plain(n): v for n, v in c.items()})),
            (".mat z", lambda f, c=columns: _packed_mat(f, c)),
        ):
            file = folder / f"{kind}{'_z' if ' ' in ending else ''}{ending.split()[0]}"
            write(file)
            found.append(Reader(f"{kind} {ending}", file, read))
    found += _of_rigs(folder)
    found += _toml_readers(folder)
    found += _fits(folder)
    loop = pam.closed_loop(
        lambda t, y: {"muscle1.command": 2e5, "muscle2.command": 2e5},
        slide,
        duration=0.02,
        sample_time=5e-3,
    )
    found.append(Reader("ClosedLoop.load", loop.save(folder / "loop.npz"), type(loop).load))
    if planned:
        plan = pam.plan(slide, [{"x": -0.01}, {"x": 0.01}])
        plan.save(folder / "plan.npz")
        load = lambda f: pam.load_plan(f, slide)  # noqa: E731
        found.append(Reader("load_plan", folder / "plan.npz", load, weight=0.5))
    return found


def _of_rigs(folder: Path) -> list[Reader]:
    """What rigs write, in all shapes; the first reading answers what the sentence asks for."""
    found = []
    for case in rig_files.all_cases(folder / "rig"):
        if not isinstance(case.source, Path) or case.source.is_dir():
            continue
        options = dict(case.given)
        if case.asks and case.answer != rig_files.FROM_SENTENCE:
            options[case.asks] = case.answer
        elif case.asks:
            options |= {"clock": "cut"} if case.kind == "record" else {"kind": "record"}
        read = read_record if case.kind == "record" else pam.read_table
        if "kind" in options:
            read = look
        chosen = lambda f, r=read, o=options: r(f, **o)  # noqa: E731
        found.append(Reader(f"rig {case.name}", case.source, chosen, weight=0.25))
    return found


def _plain(header: str) -> str:
    return re.sub(r"\W+", "_", header).strip("_")


def _packed_mat(file: Path, columns: dict[str, Any]) -> None:
    savemat(file, {_plain(n): v for n, v in columns.items()}, do_compression=True)


def _toml_readers(folder: Path) -> list[Reader]:
    muscle = pam.muscle("DMSP-20-200N")
    found = []
    for ending in (".toml", ".json"):
        file = folder / f"muscle{ending}"
        pam.save_muscle(muscle, file)
        found.append(Reader(f"load_muscle {ending}", file, pam.load_muscle))
    for name, text, read in (
        ("problem", PROBLEM, pam.planning.load_problem),
        ("study", STUDY, _study),
        ("loop", LOOP, _loop),
    ):
        file = folder / f"{name}.toml"
        file.write_text(text, "utf-8")
        found.append(Reader(f"{name}.toml", file, read))
    return found


def _study(file: Path) -> None:
    options = _parser().parse_args(["fit-plant", "--plant", str(file), "--variables"])
    with contextlib.redirect_stdout(io.StringIO()):
        options.run(options)


def _loop(file: Path) -> None:
    study = motion_commands._study(_parser().parse_args(["mpc", str(file)]))
    with guarded(study):
        set_up(study)


def _fits(folder: Path) -> list[Reader]:
    plant, t = cart(), np.arange(0, 1.01, 0.05)
    force = np.sign(np.sin(9 * t))
    run = pam.simulate(plant, {"force": (t, force)}, t=t)
    x = run["x"] + 1e-4 * np.random.default_rng(1).standard_normal(t.size)
    variables = [plant.variable("force"), plant.variable("x")]
    record = pam.Trajectory(t, {"force": force, "x": x}, variables, "previous")
    fit = fit_plant(plant.with_values(mass=1.5), [record], ["mass"])
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    force_fit = pam.fit_force(table)
    force_fit.to_json(folder / "force.json")
    return [
        Reader("load_plant_fit", fit.save(folder / "fit.json"), lambda f: load_plant_fit(f, plant)),
        Reader("ForceFit.from_json", folder / "force.json", ForceFit.from_json),
    ]


# ---- damage --------------------------------------------------------------------------------------
Damage = Callable[[random.Random, bytes], bytes]
ODD: list[Any] = [
    None, True, False, -1, 0, 3, 10**9, 10**400, 1e308, -1e-320, float("nan"), float("inf"),
    "", "x", "a" * 3000, "\ud800", "nan", [], {}, [[]], [1, "x"], {"a": {"b": [None]}}, [1e9] * 40,
]  # fmt: skip
WORDS = ["nan", "inf", "-inf", "1e400", "", "x", "true", "[]", "{}", "-1", "9" * 5000, '"', "1,2"]


def _truncated(r: random.Random, data: bytes) -> bytes:
    return data[: r.randrange(len(data))]


def _flipped(r: random.Random, data: bytes) -> bytes:
    made = bytearray(data)
    for _ in range(r.choice([1, 1, 2, 8, 64])):
        made[r.randrange(len(made))] ^= 1 << r.randrange(8)
    return bytes(made)


def _swapped(r: random.Random, data: bytes) -> bytes:
    made = bytearray(data)
    i, j = r.randrange(len(made)), r.randrange(len(made))
    made[i], made[j] = made[j], made[i]
    return bytes(made)


def _chunk(r: random.Random, data: bytes) -> tuple[int, int]:
    start = r.randrange(len(data))
    return start, min(len(data), start + r.choice([1, 4, 16, 100, 1000]))


def _deleted(r: random.Random, data: bytes) -> bytes:
    a, b = _chunk(r, data)
    return data[:a] + data[b:]


def _doubled(r: random.Random, data: bytes) -> bytes:
    a, b = _chunk(r, data)
    return data[:b] + data[a:b] * r.choice([1, 3, 50]) + data[b:]


def _inserted(r: random.Random, data: bytes) -> bytes:
    a, b = _chunk(r, data)
    return data[:a] + r.choice([r.randbytes(b - a), b"\0" * (b - a), b"[" * 300]) + data[a:]


def _worded(r: random.Random, data: bytes) -> bytes:
    """A number or word replaced."""
    found = list(re.finditer(rb"[\w.+-]+", data))
    if not found:
        return data
    at = r.choice(found)
    return data[: at.start()] + r.choice(WORDS).encode() + data[at.end() :]


def _encoded(r: random.Random, data: bytes) -> bytes:
    text = data.decode("utf-8", "replace") + r.choice(["", "ä€", "\0"])
    return text.encode(r.choice(["utf-16", "utf-16-le", "latin-1", "utf-32"]), "replace")


def _json(r: random.Random, data: bytes) -> bytes:
    """A value of a wrong kind somewhere, or a key less."""
    content = json.loads(data)
    at, places = content, []
    while isinstance(at, dict | list) and at:
        key = r.choice(list(at) if isinstance(at, dict) else range(len(at)))
        places.append((at, key))
        at = at[key]
    where, key = r.choice(places)
    if r.random() < 0.2:
        del where[key]
    else:
        where[key] = r.choice(ODD)
    return json.dumps(content).encode()


def _toml(r: random.Random, data: bytes) -> bytes:
    """A value of a wrong kind behind one of its signs of equality."""
    odd = ["true", "-1", "1e400", "nan", "inf", '""', '"x"', "[]", "{}", '"1e400 m"', "[[1], 2]",
           '{ kind = "x" }', "1979-05-27", '["5 mm", 3]', "9" * 400, "[nan, inf]"]  # fmt: skip
    at = r.choice(list(re.finditer(rb"= *([^\n]*?)(?=\n|,| \})", data)))
    return data[: at.start(1)] + r.choice(odd).encode() + data[at.end(1) :]


def _archive(r: random.Random, data: bytes) -> bytes:
    """A member of a zip less, renamed, exchanged or damaged inside."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {n: archive.read(n) for n in archive.namelist()}
    name = r.choice(list(members))
    action = r.randrange(4)
    if action == 0:
        del members[name]
    elif action == 1:
        members["x" + name] = members.pop(name)
    elif action == 2:
        members[name] = members[r.choice(list(members))]
    elif members[name]:
        inside = [_truncated, _flipped, _swapped, _deleted, _doubled, _inserted, _worded]
        members[name] = r.choice(inside)(r, members[name])
    return _zipped(members)


def _zipped(members: dict[str, bytes]) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return made.getvalue()


def _gzipped(r: random.Random, data: bytes) -> bytes:
    """Damaged before it was packed."""
    return gzip.compress(r.choice([_truncated, _worded, _doubled])(r, gzip.decompress(data)))


def _arrays(r: random.Random, data: bytes) -> bytes:
    """An array of another kind, shape or value; or what stands beside them as JSON."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {n: file[n] for n in file.files}
    name = "meta" if "meta" in arrays and r.random() < 0.6 else r.choice(list(arrays))
    old = arrays[name]
    if name == "meta":
        arrays[name] = np.array(_json(r, str(old).encode()).decode())
    elif old.size:
        odd, row = np.array(old, dtype=float), np.atleast_1d(old)
        odd.flat[r.randrange(odd.size)] = r.choice([np.nan, np.inf, 1e308, -1.0])
        arrays[name] = r.choice(
            [odd, old.astype(str), old.astype(complex), row[:-1], old.T, old[None], row[:0], -old,
             np.array(3.0), np.array("x"), old.astype("M8[s]"), np.array([None, {}])]
        )  # fmt: skip
    made = io.BytesIO()
    np.savez(made, **arrays)
    return made.getvalue()


BYTES: list[Damage] = [
    _truncated, _flipped, _swapped, _deleted, _doubled, _inserted, _worded, _encoded,
]  # fmt: skip
SPECIAL: dict[str, list[Damage]] = {
    ".json": [_json] * 8,
    ".toml": [_toml] * 8,
    ".xlsx": [_archive] * 6,
    ".npz": [_archive] * 3 + [_arrays] * 6,
    ".csv": [_worded] * 4,
    ".gz": [_gzipped] * 6,
    ".tsv": [_worded] * 4,
}


# ---- reading -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Outcome:
    """What a reader made of a damaged file."""

    reader: str
    damage: str
    kind: str
    words: str = ""

    @property
    def failed(self) -> bool:
        return self.kind not in ("sentence", "read")


def outcome(reader: Reader, damage: str, file: Path) -> Outcome:
    """Read a file and judge the answer."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            reader.read(file)
            kind, words = "read", ""
        except InputError as error:
            kind, words = "sentence", str(error)
            if file.name not in words:
                kind = "unnamed"
            elif "\n" in words or len(words) > LONGEST_SENTENCE:
                kind = "flood"
            elif "please report it" in words:
                kind = "reported"
        except Exception as error:
            kind = "raw"
            words = f"{type(error).__name__}: {error} " + traceback.format_exc()[-300:]
    own = (PlanWarning, pam.muscles.ValidityWarning, UnitWarning, ReadingWarning)
    foreign = [w for w in warned if not issubclass(w.category, own)]
    if foreign and kind in ("sentence", "read"):
        kind, words = "warning", f"{foreign[0].category.__name__} {foreign[0].message}"
    return Outcome(reader.name, damage, kind, words[:600])


def outcomes(
    chosen: list[Reader], count: int, seed: int, folder: Path, keep: Path | None = None
) -> Iterator[Outcome]:
    """So many damaged files, read one by one."""
    r = random.Random(seed)
    contents = {reader.name: reader.file.read_bytes() for reader in chosen}
    for number in range(count):
        reader = r.choices(chosen, [c.weight for c in chosen])[0]
        suffix = reader.file.suffix
        damage = r.choice(BYTES + SPECIAL.get(suffix, []))
        made = damage(r, contents[reader.name])
        file = folder / f"damaged{number}{suffix}"  # what reads the last one may still map it
        file.write_bytes(made)
        found = outcome(reader, damage.__name__, file)
        if keep and found.failed:
            (keep / f"{number}_{found.kind}{suffix}").write_bytes(made)
        file.unlink()
        yield found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a reader's name")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        chosen = [x for x in readers(folder) if options.only in x.name]
        table: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
        failed = []
        begin = time.process_time()  # here only: tests read no clock
        for found in outcomes(chosen, options.count, options.seed, folder, options.keep):
            took, begin = time.process_time() - begin, time.process_time()
            if took > SLOWEST:
                found = replace(found, kind="slow", words=f"{took:.1f} s; {found.words}")
            table[found.reader][found.kind] += 1
            if found.failed:
                failed.append(found)
                print(f"{found.reader} {found.damage} {found.kind}: {found.words}", flush=True)
    kinds = ["sentence", "read", *sorted({f.kind for f in failed})]
    print(f"{'':<24}" + "".join(f"{k:>10}" for k in kinds))
    for reader, counts in sorted(table.items()):
        print(f"{reader:<24}" + "".join(f"{counts[k]:>10}" for k in kinds))
    total = sum(table.values(), collections.Counter[str]())
    print(f"{'all':<24}" + "".join(f"{total[k]:>10}" for k in kinds))
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
