"""A study by the jobs of an array: each runs its share of the steps, the last word merges them.

A shard leaves what it made among the kept results, and a record of itself in ``OUT/shards``. A
merge sees that every shard came to its end, names those that did not, and then runs the study as
always: everything is there already but the tables of sweeps and the report.
"""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.atomic import in_use, make_folder
from ..core.errors import InputError
from ..core.files import read_json, write_json
from .study_file import Entry

FORMAT = "pam_ocp shard 1"
FOLDER = "shards"
MOST = 100_000
"""Shards of a study."""
NAMED = 10
"""That an error names."""


@dataclass(frozen=True)
class Shard:
    """The ``number``-th of ``of`` shards, counted from 1."""

    number: int
    of: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @property
    def name(self) -> str:
        """Of its record."""
        width = len(str(self.of))
        return f"{self.number:0{width}d}-of-{self.of}"

    def share(self, entries: Mapping[str, Entry]) -> frozenset[str]:
        """The steps that this shard runs: every ``of``-th one, and what those stand on.

        Tables of sweeps, and what stands on them, are made when all shards are merged.
        """
        late: set[str] = set()
        for name, entry in entries.items():  # each comes after what it stands on
            if entry.cases or late & set(entry.above):
                late.add(name)
        own = [n for n in entries if n not in late]
        chosen = set(own[self.number - 1 :: self.of])
        for name in reversed(list(entries)):
            if name in chosen:
                chosen |= set(entries[name].above)
        return frozenset(chosen)


def shard_of(text: str) -> Shard:
    """``"17/200"``: the 17th of 200. Raises InputError."""
    found = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", str(text))
    number, of = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= number <= of <= MOST:
        raise InputError(
            f"shard = {text!r}: give K/N with K from 1 to N, such as 17/200 (N at most {MOST})"
        )
    return Shard(number, of)


class ShardRecord:
    """What a shard says of itself while it works, and at its end."""

    def __init__(self, out: Path, shard: Shard, study: str, cache: str) -> None:
        self.folder = make_folder(out / FOLDER / shard.name)
        self.content: dict[str, Any] = {
            "format": FORMAT,
            "shard": str(shard),
            "study": study,
            "cache": cache,
            "state": "at work",
            "process": os.getpid(),
            "host": platform.node(),
            "done": {},
        }

    @contextmanager
    def working(self) -> Iterator[None]:
        """For the time of its work; another process with the same shard is told of this one."""
        with in_use(self.folder):
            self.write()
            yield
            self.content["state"] = "done"
            self.write()

    def ended(self, step: str, state: str) -> None:
        """Note a step that has come to its end."""
        self.content["done"][step] = state
        self.write()

    def write(self) -> None:
        """The record as it is."""
        write_json(self.folder / "shard.json", self.content)


def merged_cache(out: Path, study: str) -> str:
    """The folder of kept results that all shards had. Raises InputError where one is missing."""
    records = _records(out)
    if not records:
        raise InputError(f"{out / FOLDER}: no shard has run here; run it with shard='1/N' first")
    counts = sorted({shard.of for shard in records})
    if len(counts) > 1:
        raise InputError(
            f"{out / FOLDER} holds shards of different arrays (of {', '.join(map(str, counts))}); "
            "delete it, and run one array"
        )
    missing = []
    for number in range(1, counts[0] + 1):
        shard = Shard(number, counts[0])
        said = _amiss(out, shard, records.get(shard), study)
        if said:
            missing.append(f"{shard} {said}")
    if missing:
        more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
        told = "; ".join(missing[:NAMED]) + more
        raise InputError(
            f"{len(missing)} of {counts[0]} shards are not there: {told}; run those, then merge"
        )
    caches = sorted({str(r["cache"]) for r in records.values()})
    gone = [c for c in caches if not Path(c).is_dir()]
    if gone or len(caches) > 1:
        raise InputError(
            f"the shards kept their results in {', '.join(caches)}; give all of them one folder "
            "that this machine sees (cache=, --cache)"
        )
    return caches[0]


def _records(out: Path) -> dict[Shard, dict[str, Any]]:
    found = {}
    for path in sorted((out / FOLDER).glob("*/shard.json")):
        with suppress(InputError):
            record = read_json(path, "a shard's record", FORMAT, "")
            found[shard_of(record["shard"])] = record
    return found


def _amiss(out: Path, shard: Shard, record: dict[str, Any] | None, study: str) -> str:
    """Why a shard cannot be merged; empty where it can."""
    if record is None:
        return "never began"
    if record["study"] != study:
        return "ran another version of the study"
    if record["state"] == "done":
        return ""
    where = f"process {record['process']} on {record['host']}, {len(record['done'])} steps done"
    try:
        with in_use(out / FOLDER / shard.name):
            return f"died at work ({where})"
    except InputError:
        return f"is still at work ({where})"
