"""What all studies share: their command line, their cases one after the other, tables, seconds.

A study asks a question in its docstring and ends with

    if __name__ == "__main__":
        harness.main(__doc__, cases, summary, count=100)

``cases(given)`` yields (key, work) pairs: a number or a name, and a function that returns a *row*,
a dictionary of values that JSON knows. Some entries of a row have a meaning here: ``verdict`` (a
word that is counted), ``text`` (printed behind it), ``why`` (a list of lines below). What a case
refuses (a PamError) or raises is a row, too. ``summary(rows)`` returns the text at the end.

Every study takes a seed (from the clock where none is given; it is printed), one whose cases have
numbers a count, and

    --only 3,17 or WORD ...     these cases alone
    --start N, --end N          the first number, and the number before which it ends
    --table FILE                rows are added to it as JSON lines; cases that it has are not run
                                again, but are in the summary
    --seconds S                 each case in a process of its own, given up after that many
                                processor seconds of all processes that it starts
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

Row = dict[str, Any]
Work = Callable[[], Row]
Given = argparse.Namespace
Keyed = Iterator[tuple[object, Work]]
Cases = Callable[[Given], Keyed]


# ---- seconds -------------------------------------------------------------------------------------
def spent() -> float:
    """Processor seconds of this process and of its children that have ended."""
    each = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in each)


class Took(NamedTuple):
    """Of a call: processor seconds of all processes, seconds by the clock, what it returned."""

    processor: float
    clock: float
    result: Any


def took(work: Callable[[], Any]) -> Took:
    """A call, and what it took."""
    begin, clock = spent(), time.perf_counter()
    result = work()
    return Took(spent() - begin, time.perf_counter() - clock, result)


def repeated(work: Callable[[], Any], repeats: int = 3) -> Took:
    """Medians of some calls, after one for warming up, and the last result."""
    work()
    processor, clock, results = zip(*(took(work) for _ in range(repeats)), strict=True)
    return Took(median(processor), median(clock), results[-1])


def timed(work: Callable[[], Any], repeats: int = 3) -> float:
    """Median processor seconds of a call, after one for warming up."""
    return repeated(work, repeats).processor


def process(*command: str) -> Took:
    """A Python process with its children, and what it prints; RuntimeError where it fails."""

    def run() -> str:
        words = [sys.executable, *command]
        done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parent)
        if done.returncode:
            raise RuntimeError(done.stderr.strip()[-500:])
        return done.stdout

    return took(run)


SINGLE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""In the environment of a process: one thread."""


def printed(
    command: Sequence[str], mark: str, limit: float, environment: dict[str, str]
) -> dict[str, Any] | str:
    """The JSON that a process prints behind ``mark``, or why it printed none within ``limit`` s."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=limit, env=environment
        )
    except subprocess.TimeoutExpired:
        return f"no end in {limit:.0f} s"
    line = next((li for li in done.stdout.splitlines() if li.startswith(f"{mark} ")), None)
    if done.returncode or line is None:
        return last_line(done.stderr or done.stdout or "it printed nothing")
    found: dict[str, Any] = json.loads(line.removeprefix(mark))
    return found


def last_line(text: str) -> str:
    """The last line that says something."""
    return next((li.strip() for li in reversed(text.splitlines()) if li.strip()), "no message")


def session_seconds(session: int) -> float:
    """Processor seconds of all processes of a session, and of their children that have ended."""
    ticks = 0
    for each in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = each.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[3]) == session:
            ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


# ---- a case --------------------------------------------------------------------------------------
def judged(work: Work) -> Row:
    """The row of a case, with its seconds; of what it refuses or raises, the words.

    pam_ocp is not imported here: a study may ask about another copy of it.
    """
    begin, clock = spent(), time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            row = work()
        except Exception as error:
            refusal = getattr(sys.modules.get("pam_ocp"), "PamError", ())
            if isinstance(error, refusal):
                row = {"verdict": "refused", "why": [" ".join(str(error).split())[:400]]}
            else:  # a finding of its own
                row = {"verdict": "RAISED", "why": [f"{type(error).__name__}: {error}"]}
    taken = {"processor": round(spent() - begin, 2), "clock": round(time.monotonic() - clock, 2)}
    return {**taken, **row}


_PARENT: list[Any] = []
"""The connection of a process of its own."""


def about(text: str) -> None:
    """What a case is about, told before it ends: it stands in the row of one given up, too."""
    for connection in _PARENT:
        connection.send({"text": text})


def _child(connection: Any, work: Work, seconds: float) -> None:
    os.setsid()  # the processes that it starts are counted and ended with it
    if seconds < math.inf:  # it ends where its parent is no more, too
        limit = math.ceil(seconds) + 5
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    _PARENT[:] = [connection]
    connection.send(judged(work))


def limited(work: Work, seconds: float) -> Row:
    """``judged`` in a process of its own, given up after so many seconds of the processor."""
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(
        target=_child, args=(there, work, seconds)
    )
    process.start()
    there.close()
    row: Row = {}
    verdict = "over time"
    while "clock" not in row and session_seconds(process.pid or 0) <= seconds:
        if not here.poll(0.2):
            continue
        try:
            row |= here.recv()
        except EOFError:
            verdict = "DIED"
            break
    if "clock" not in row:  # the last message has it
        row |= {"verdict": verdict, "processor": seconds}
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid or 0, signal.SIGKILL)  # what it has left running, too
    process.join(5)
    return row


# ---- a study -------------------------------------------------------------------------------------
def parser(
    doc: str | None, count: int | None = None, seed: int | None = None
) -> argparse.ArgumentParser:
    """The options of every study. count : without --only, where cases have numbers. seed : where
    the clock's shall not be taken.
    """
    made = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if count is not None:
        made.add_argument("count", nargs="?", type=int, default=count, help=f"of cases ({count})")
        made.add_argument("seed", nargs="?", type=_seed, default=argparse.SUPPRESS)
    clock = time.time_ns() // 10**9
    made.add_argument("--seed", type=int, default=clock if seed is None else seed)
    made.add_argument("--only", nargs="+", default=[], metavar="CASE")
    made.add_argument("--start", type=int, default=0, help="first number")
    made.add_argument("--end", type=int, help="before this number")
    made.add_argument("--table", type=Path, help="JSON lines: written, and not run again")
    made.add_argument("--seconds", type=float, help="of the processor, for a case")
    return made


def _seed(word: str) -> int | str:
    """A number; what stands for "not given" passes, so that ``--seed`` counts then."""
    return word if word is argparse.SUPPRESS else int(word)


def chosen(given: Given, key: object) -> bool:
    """Whether ``--only`` names a case: its number, or a part of its name."""
    words = [part for word in given.only for part in _parts(word)]
    return not words or str(key) in words or any(w in str(key) for w in words if not w.isdigit())


def _parts(word: str) -> list[str]:
    return word.split(",") if re.fullmatch(r"[\d,]+", word) else [word]


def numbers(given: Given, wanted: Callable[[int], bool] = lambda number: True) -> Iterator[int]:
    """Numbers of cases: those of ``--only``, or as many as are asked for of those wanted."""
    if given.only:
        yield from (int(part) for word in given.only for part in _parts(word))
        return
    number, left = given.start, given.count
    while left and (given.end is None or number < given.end):
        if wanted(number):
            yield number
            left -= 1
        number += 1


def stored(table: Path | None, seed: int) -> dict[str, Row]:
    """Rows of a table, by key; those of another seed are left out."""
    if table is None or not table.exists():
        return {}
    rows = (json.loads(line) for line in table.read_text("utf-8").splitlines())
    return {row["case"]: row for row in rows if row["seed"] == seed}


def show(row: Row) -> None:
    """A line for a case, and what belongs below it."""
    key, verdict = str(row["case"]), row.get("verdict", "")
    key = f"{key:>4}" if key.isdigit() else f"{key:<32}"
    text = str(row.get("text", ""))[:400]
    print(f"{key} {verdict:<17} {row['processor']:6.1f} s  {text}", flush=True)
    for each in row.get("why", ())[:6]:
        print(f"       {each[:300]}", flush=True)


def run(cases: Cases, given: Given) -> list[Row]:
    """All cases that are asked for, those of the table included."""
    rows, known = [], stored(given.table, given.seed)
    for key, work in cases(given):
        if not chosen(given, key):
            continue
        row = known.get(str(key))
        if row is None:
            found = limited(work, given.seconds) if given.seconds else judged(work)
            row = {"case": str(key), "seed": given.seed, **found}
            if given.table is not None:
                with given.table.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row, default=float) + "\n")
            show(row)
        rows.append(row)
    return rows


def tally(rows: Sequence[Row]) -> str:
    """How many of each verdict, and processor seconds of a case."""
    if not rows:
        return "no case is asked for: see --only, --start, --end and the count"
    counts = Counter(row.get("verdict", "") for row in rows)
    lines = [f"{n:4d} of {len(rows)} {verdict}" for verdict, n in sorted(counts.items()) if verdict]
    seconds = [row["processor"] for row in rows]
    lines.append(f"seconds a case: median {median(seconds):.2f}, worst {max(seconds):.1f}")
    return "\n".join(lines)


def main(
    doc: str | None,
    cases: Cases,
    summary: Callable[[list[Row]], str] | None = None,
    *,
    count: int | None = None,
    seed: int | None = None,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    **usual: Any,
) -> list[Row]:
    """Run a study from the command line.

    options : of its own, {name: arguments of add_argument}. usual : values of the usual ones where
    none are given.
    """
    made = parser(doc, count, seed)
    made.set_defaults(**usual)
    for name, arguments in (options or {}).items():
        made.add_argument(name, **arguments)
    given = made.parse_args()
    print(f"seed {given.seed}", flush=True)
    rows = run(cases, given)
    print(tally(rows))
    if summary is not None and rows and (text := summary(rows)):
        print(text)
    return rows


def flag(text: str) -> dict[str, Any]:
    """An option that is given or not."""
    return {"action": "store_true", "help": text}


def asked(count: int | None = None, seed: int = 0, **options: Any) -> Given:
    """What the command line would give, for a study that is called from Python."""
    usual = parser(None, count, seed).parse_args([])
    return Given(**{**vars(usual), **options})


# ---- what is written -----------------------------------------------------------------------------
def table(heads: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; numbers to three digits."""

    def cell(value: object) -> str:
        text = f"{value:.3g}" if isinstance(value, float) else str(value)
        return " ".join(text.replace("|", "\\|").split())

    head, *lines = ("| " + " | ".join(cell(c) for c in line) + " |" for line in (heads, *rows))
    return "\n".join([head, "|" + "---|" * len(heads), *lines])


def share(parts: Iterable[bool]) -> float:
    """Percentage of what holds; NaN of nothing."""
    kept = list(parts)
    return 100 * sum(kept) / len(kept) if kept else float("nan")


def write(path: Path, text: str) -> None:
    """A file at once: into a new one beside it, which then takes its name."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, "utf-8")
    part.replace(path)


def importable(folder: str) -> None:
    """Let modules of another folder of the tree be imported: ``importable("tests/rig")``."""
    path = str(Path(__file__).resolve().parents[1] / folder)
    if path not in sys.path:
        sys.path.append(path)  # behind those of this folder: names stand twice
