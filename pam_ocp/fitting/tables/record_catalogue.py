"""A catalogue of measured records: who measured which muscle, when, how calibrated, free to whom.

On disk it is a folder, or a place in an object store, of pairs of Parquet files:
``records-00000.parquet`` (a row for each record) and ``cells-00000.parquet`` (a row for each
cell). A record counts once its row is there, so an interrupted write leaves no half of one.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np

from ...core.errors import InputError, UnknownNameError, kind_of, require_instance
from ...core.shown import shown
from ...core.stores import Folder, Store, folder_of, opened, write_bytes
from .force_table import ForceTable, require_table

TEXTS = ("name", "muscle", "kind", "who", "when", "calibration", "licence")
CELLS = ("pressure", "contraction", "force")


@shown
@dataclass(frozen=True, eq=False)
class Record:
    """A table of one muscle, and what is to be known of it.

    table : of the force. muscle : which piece was measured. kind : what it is one of ("DMSP-20").
    name : of the record, unique in a catalogue; numbered where not given. who, calibration,
    licence : any text. when : ISO 8601, "2024-05-31" or with a time of day.

    Examples
    --------
    >>> pam.fitting.Record(table, "no. 7", kind="DMSP-20", who="NN", when="2024-05-31")
    <Record no. 7: 126 cells, DMSP-20, NN, 2024-05-31>
    """

    table: ForceTable = field(repr=False)
    muscle: str
    kind: str = ""
    name: str = ""
    who: str = ""
    when: str = ""
    calibration: str = ""
    licence: str = ""

    def __post_init__(self) -> None:
        require_table(self.table)
        for name in TEXTS:
            require_instance(name, getattr(self, name), str, "give a text")
        if not self.muscle:
            raise InputError("muscle = '' must name the piece that was measured")
        if self.when:
            try:
                datetime.fromisoformat(self.when.replace("Z", "+00:00"))
            except ValueError:
                raise InputError(
                    f"when = {self.when!r} is no date of ISO 8601: give 2024-05-31, or "
                    "2024-05-31T14:30"
                ) from None

    def __str__(self) -> str:
        said = [f"{len(self.table)} cells", self.kind, self.who, self.when]
        return f"{self.name or self.muscle}: {', '.join(s for s in said if s)}"


@shown
@dataclass(frozen=True, eq=False)
class Catalogue:
    """Records, in memory or on disk; tables on disk are read when they are asked for.

    entries : of each record, {column: text} with those of :class:`Record`, "rest_length",
    "cells" and, on disk, "part".

    Examples
    --------
    >>> record = pam.fitting.Record
    >>> found = pam.fitting.Catalogue.of([record(table, "no. 1", who="A"), record(table, "no. 2")])
    >>> found.save("fleet")
    >>> found = pam.fitting.Catalogue.open("fleet").select(who="A")
    >>> found, len(next(iter(found)).table)
    (<Catalogue 1 record of 1 muscle>, 126)
    """

    entries: Sequence[Mapping[str, Any]]
    tables: Mapping[str, ForceTable] = field(default_factory=dict, repr=False)
    folder: Folder | None = None

    @classmethod
    def of(cls, records: Iterable[Record]) -> Catalogue:
        """Of records in memory. Raises InputError for none, or two of one name."""
        require_instance("records", records, Iterable, "give records, each a Record(table, ...)")
        entries, tables = [], {}
        for i, record in enumerate(records):
            require_instance("records", record, Record, "give Record(table, muscle, ...)")
            entry = {n: getattr(record, n) for n in TEXTS}
            entry["name"] = record.name or f"{i + 1:06d}"
            entry |= {"rest_length": record.table.rest_length, "cells": len(record.table)}
            entries.append(entry)
            tables[entry["name"]] = record.table
        _require_distinct(entries)
        return cls(entries, tables)

    @classmethod
    def open(cls, store: Store) -> Catalogue:
        """Read what is told of the records in a folder, by :meth:`save`.

        store : a folder, a URL of fsspec's, or a file system; as ``into=`` of ``simulate_many``.
        """
        folder, entries = folder_of("store", store), []
        for part in _parts(folder):
            entries += [e | {"part": part} for e in _read(folder / f"records-{part}.parquet")]
        if not entries:
            raise InputError(f"{folder} holds no records; write some with Catalogue.of(...).save()")
        _require_distinct(entries)
        return cls(entries, folder=folder)

    def save(self, store: Store) -> None:
        """Write the records into a folder or store, beside those that are there.

        Raises InputError where one of them is there already.
        """
        import pyarrow as pa

        folder = folder_of("store", store)
        there = _parts(folder)
        known = {e["name"] for p in there for e in _read(folder / f"records-{p}.parquet")}
        twice = [e["name"] for e in self.entries if e["name"] in known]
        if twice:
            raise InputError(f"{folder} holds a record {twice[0]!r} already; name records apart")
        part = f"{int(there[-1]) + 1 if there else 0:05d}"
        records = list(self)
        columns: dict[str, Any] = {
            n: np.concatenate([getattr(r.table, n) for r in records]) for n in CELLS
        }
        sizes = [len(r.table) for r in records]
        columns["slack"] = np.concatenate([r.table.slack for r in records])
        columns["record"] = pa.array(
            np.repeat([r.name for r in records], sizes)
        ).dictionary_encode()
        for name in ("branch", "run"):
            labels = [getattr(r.table, name) or ("",) * len(r.table) for r in records]
            columns[name] = pa.array([x for own in labels for x in own]).dictionary_encode()
        error = [
            np.full(len(r.table), np.nan) if r.table.error is None else r.table.error
            for r in records
        ]
        columns["error"] = np.concatenate(error)
        write_bytes(folder / f"cells-{part}.parquet", _bytes(pa.table(columns)))
        rows = [{n: e[n] for n in (*TEXTS, "rest_length", "cells")} for e in self.entries]
        write_bytes(folder / f"records-{part}.parquet", _bytes(pa.Table.from_pylist(rows)))

    def select(
        self, *, when: tuple[str | None, str | None] | None = None, **asked: str | Sequence[str]
    ) -> Catalogue:
        """The records that agree with all that is asked for.

        when : (first, last) day or time, both inclusive; None at an open end. Others by column: a
        text, or several of which one must be it (``kind="DMSP-20", who=["A", "B"]``).
        """
        chosen = list(self.entries)
        for name, values in asked.items():
            if name not in TEXTS:
                raise UnknownNameError("column of the catalogue", name, TEXTS)
            wanted = {values} if isinstance(values, str) else set(values)
            chosen = [e for e in chosen if e[name] in wanted]
        if when is not None:
            if isinstance(when, str) or len(when) != 2:
                raise InputError(
                    f"when = {when!r}: give (first, last) as texts, None at an open end"
                )
            low, high = (str(end or "") for end in when)
            chosen = [
                e
                for e in chosen
                if e["when"] >= low and (not high or e["when"][: len(high)] <= high)
            ]
        return replace(self, entries=chosen)

    def to_pandas(self) -> Any:
        """What is told of the records, as a DataFrame."""
        import pandas as pd

        return pd.DataFrame(list(self.entries))

    def __iter__(self) -> Iterator[Record]:
        tables = self.tables if self.folder is None else self._read_tables()
        for entry in self.entries:
            yield Record(tables[entry["name"]], **{n: entry[n] for n in TEXTS})

    def __len__(self) -> int:
        return len(self.entries)

    def __str__(self) -> str:
        muscles = len({(e["kind"], e["muscle"]) for e in self.entries})
        return (
            f"{len(self)} record{'s' * (len(self) != 1)} of {muscles} muscle{'s' * (muscles != 1)}"
        )

    def _read_tables(self) -> dict[str, ForceTable]:
        """The tables of the chosen records, from the parts that hold some."""
        assert self.folder is not None
        found: dict[str, ForceTable] = {}
        for part in sorted({e["part"] for e in self.entries}):
            wanted = {e["name"]: e for e in self.entries if e["part"] == part}
            content = _parquet(self.folder / f"cells-{part}.parquet")
            codes = content["record"].combine_chunks()
            names, place = codes.dictionary.to_pylist(), np.asarray(codes.indices)
            ends = np.concatenate([[0], np.nonzero(np.diff(place))[0] + 1, [len(place)]])
            arrays = {n: content[n].to_numpy() for n in (*CELLS, "slack", "error")}
            labels = {n: content[n].to_pylist() for n in ("branch", "run")}
            for low, high in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
                name = names[place[low]]
                if name in wanted:
                    rest_length = wanted[name]["rest_length"]
                    found[name] = _table(name, rest_length, arrays, labels, slice(low, high))
        return found


def _table(
    name: str, rest_length: float | None, arrays: Mapping[str, Any], labels: Any, rows: slice
) -> ForceTable:
    error = arrays["error"][rows]
    branch, run = (tuple(own) if any(own := labels[n][rows]) else () for n in ("branch", "run"))
    return ForceTable(
        arrays["pressure"][rows],
        arrays["contraction"][rows],
        arrays["force"][rows],
        rest_length=rest_length,
        source=name,
        branch=branch,
        run=run,
        error=None if np.isnan(error).all() else error,
        floor=None,
        censored=arrays["slack"][rows],
    )


# ---- files ---------------------------------------------------------------------------------------
def _parts(folder: Folder) -> list[str]:
    if not folder.exists():
        return []
    names = (p.name for p in folder.iterdir())
    return sorted(
        n[len("records-") : -len(".parquet")]
        for n in names
        if n.startswith("records-") and n.endswith(".parquet")
    )


def _parquet(path: Folder) -> Any:
    from pyarrow import ArrowException, parquet

    try:
        with opened(path) as file:
            return parquet.read_table(file)
    except (OSError, ArrowException) as error:
        words = " ".join(str(error).split())
        raise InputError(f"{path} cannot be read as Parquet: {words}") from None


def _read(path: Folder) -> list[dict[str, Any]]:
    content = _parquet(path)
    missing = [n for n in (*TEXTS, "rest_length", "cells") if n not in content.column_names]
    if missing:
        raise InputError(f"{path} has no column {missing[0]!r}: it is no catalogue's")
    rows: list[dict[str, Any]] = content.to_pylist()
    return rows


def _bytes(content: Any) -> bytes:
    from pyarrow import parquet

    sink = io.BytesIO()
    parquet.write_table(content, sink)
    return sink.getvalue()


def _require_distinct(entries: Sequence[Mapping[str, Any]]) -> None:
    if not entries:
        raise InputError("records: there is none; give at least one")
    names = [e["name"] for e in entries]
    if len(set(names)) < len(names):
        twice = next(n for i, n in enumerate(names) if n in names[:i])
        raise InputError(f"two records are named {twice!r}; give each a name of its own")


def require_catalogue(value: Any) -> Catalogue:
    """A catalogue, or one of the records given."""
    if isinstance(value, Catalogue):
        return value
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise InputError(
            f"records is {kind_of(value)}; give a Catalogue (Catalogue.open(folder)) or records"
        )
    return Catalogue.of(value)
