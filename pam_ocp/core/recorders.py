"""Files of loggers, by the libraries of those who know them: LabVIEW's TDMS (npTDMS), bags of ROS 1
and 2 (rosbags), MCAP (mcap), old and open spreadsheets (python-calamine).

All come as nested mappings of columns; each part has a ``time [s]`` of its own.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .exceptions import InputError
from .files import MOST_ROWS, MOST_SHEET_CELLS, most_unpacked, require_file, require_size
from .foreign import library, sheets_named

Flat = Callable[[Mapping[Any, Any]], Iterable[tuple[str, Any]]]


# ---- TDMS ----------------------------------------------------------------------------------------
def read_tdms(path: str | os.PathLike[str]) -> dict[str, Any]:
    """{group: {channel: values}} of a TDMS file. Waveforms get a time from their increment and
    start; where those of a group differ, each has a part of its own. Raises InputError.
    """
    require_file(path)
    with library(path, "a TDMS file", "files"):
        from nptdms import TdmsFile

        with TdmsFile.open(path) as file:
            size = sum(8 * len(c) for group in file.groups() for c in group.channels())
            if size > most_unpacked(os.path.getsize(path)):
                raise InputError("it unpacks to more than is allowed; save it as CSV in parts")
            starts = [
                s
                for group in file.groups()
                for c in group.channels()
                if (s := c.properties.get("wf_start_time")) is not None
            ]
            first = min(starts, default=None)
            return {g.name: _group(g, first) for g in file.groups() if g.channels()}


def _group(group: Any, first: Any) -> dict[str, Any]:
    """Columns of a group, or {channel: columns} where their clocks differ."""
    parts: dict[Any, dict[str, Any]] = {}
    for channel in group.channels():
        told, count = channel.properties, len(channel)
        if not count:
            continue
        said = str(
            told.get("unit_string") or told.get("NI_UnitDescription") or told.get("unit", "")
        )
        header = f"{channel.name} [{said}]" if said and "[" not in channel.name else channel.name
        step = float(told.get("wf_increment") or 0.0)
        start = told.get("wf_start_time")
        zero = float(told.get("wf_start_offset") or 0.0)
        if start is not None and first is not None:
            zero += float((start - first) / np.timedelta64(1, "ns")) * 1e-9
        values = channel[:]
        part = parts.setdefault((step, zero, count), {})
        if step > 0:
            part.setdefault("time [s]", zero + step * np.arange(count))
        part[header] = values if values.dtype.kind in "biuf" else [str(v) for v in values]
    if len(parts) == 1:
        return next(iter(parts.values()))
    return {", ".join(n for n in part if n != "time [s]"): part for part in parts.values()}


# ---- bags and MCAP -------------------------------------------------------------------------------
def is_bag(path: str | os.PathLike[str]) -> bool:
    """Whether a folder is a bag of ROS 2."""
    return (Path(path) / "metadata.yaml").is_file()


class _Topics:
    """Messages by topic, as columns: stamps, and all numbers and words of the messages."""

    def __init__(self, flat: Flat, most: int) -> None:
        self.flat, self.left = flat, most
        self.stamps: dict[str, list[tuple[int, int | None]]] = {}
        self.cells: dict[str, dict[str, list[Any]]] = {}

    def add(self, topic: str, logged: int, size: int, message: Any) -> None:
        self.left -= size
        if self.left < 0:
            raise InputError("it unpacks to more than is allowed; record fewer topics")
        record = _plain(message)
        if not isinstance(record, Mapping):
            return
        stamps = self.stamps.setdefault(topic, [])
        columns = self.cells.setdefault(topic, {})
        require_size(topic, len(stamps), len(columns))
        header = record.get("header")
        stamps.append((logged, _stamp(header) if isinstance(header, Mapping) else None))
        for name, value in self.flat({k: v for k, v in record.items() if k != "header"}):
            column = columns.setdefault(name, [])
            column += [None] * (len(stamps) - 1 - len(column))
            column.append(value)

    def tree(self) -> dict[str, Any]:
        """{topic: {"time [s]": ..., column: ...}} of topics that hold numbers."""
        zero = min((logged for s in self.stamps.values() for logged, _ in s), default=0)
        found = {}
        sole = {topic: _of_numbers(columns) for topic, columns in self.cells.items()}
        stamped = all(h for t, s in self.stamps.items() if sole[t] for _, h in s)
        if stamped:  # of their sensors, if all topics have them: two clocks may differ
            zero = min((h or 0 for t, s in self.stamps.items() if sole[t] for _, h in s), default=0)
        tails = [_header(topic, "", 1) for topic, columns in sole.items() if columns]
        for topic, columns in sole.items():
            if not columns or len(self.stamps[topic]) < 2:
                continue
            count = len(self.stamps[topic])
            times = [((h or 0) if stamped else logged) - zero for logged, h in self.stamps[topic]]
            order = np.argsort(np.array(times), kind="stable")
            part: dict[str, Any] = {"time [s]": [times[i] * 1e-9 for i in order]}
            for name, column in columns.items():
                column += [None] * (count - len(column))
                header = _header(topic, name, len(columns), tails.count(_header(topic, "", 1)) > 1)
                part[header] = [column[i] for i in order]
            found[topic] = part
        if not found:
            raise InputError("it holds no topic with numbers; say which, or save them as CSV")
        return found


def _of_numbers(columns: Mapping[str, list[Any]]) -> dict[str, list[Any]]:
    return {
        n: c
        for n, c in columns.items()
        if any(isinstance(v, int | float) and not isinstance(v, bool) for v in c[:50])
        and n.rpartition(".")[2] not in ("seq", "data_offset", "offset", "stride", "size")
    }


def _header(topic: str, name: str, width: int, whole: bool = False) -> str:
    """``pressure`` of the only number of /rig/pressure; ``state.position.0`` of several.

    whole : with the whole path, ``left.pressure``, where topics end alike.
    """
    tail = topic.strip("/").rpartition("/")[2] or "topic"
    tail = topic.strip("/").replace("/", ".") if whole else tail
    return tail if width == 1 else f"{tail}.{name}"


def _stamp(header: Mapping[str, Any]) -> int | None:
    """Nanoseconds of a header; None where it was never set."""
    stamp = header.get("stamp")
    if not isinstance(stamp, Mapping):
        return None
    seconds = stamp.get("sec", stamp.get("secs", 0))
    rest = stamp.get("nanosec", stamp.get("nsec", stamp.get("nsecs", 0)))
    return int(seconds) * 10**9 + int(rest) or None


def _plain(value: Any, level: int = 0) -> Any:
    """A message of rosbags as mappings, lists, numbers and texts."""
    if level > 12:
        return None
    if isinstance(value, np.ndarray):
        return value.ravel().tolist() if value.size <= 64 else None
    if isinstance(value, list | tuple):
        return [_plain(v, level + 1) for v in value] if len(value) <= 64 else None
    if isinstance(value, Mapping):
        return {str(k): _plain(v, level + 1) for k, v in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return {
            k: _plain(getattr(value, k), level + 1)
            for k in value.__dataclass_fields__
            if not k.startswith("__")
        }
    return value if isinstance(value, str | int | float | np.generic) else None


def read_bag(path: str | os.PathLike[str], flat: Flat) -> dict[str, Any]:
    """{topic: columns} of a bag of ROS 1 (.bag) or of ROS 2 (its folder, or the .db3 in it).

    flat : gives (path, value) of all in a record. Raises InputError.
    """
    source = Path(path)
    if source.suffix.lower() == ".db3" and source.is_file():
        source = source.parent
        if not is_bag(source):
            raise InputError(
                f"{os.fspath(path)} lacks the metadata.yaml that stands beside it in a bag of ROS "
                "2; give the folder of the bag, or run 'ros2 bag reindex' on it"
            )
    if not source.is_dir():
        require_file(source)
    size = sum(f.stat().st_size for f in ([source] if source.is_file() else source.iterdir()))
    with library(path, "a bag of ROS", "files"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        topics = _Topics(flat, most_unpacked(size))
        with AnyReader([source], default_typestore=store) as reader:
            for connection, logged, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                topics.add(connection.topic, logged, len(raw), message)
        return topics.tree()


def read_mcap(path: str | os.PathLike[str], flat: Flat) -> dict[str, Any]:
    """{topic: columns} of an MCAP file whose messages are JSON, or of ROS 1 or 2.

    flat : gives (path, value) of all in a record. Raises InputError.
    """
    require_file(path)
    with library(path, "an MCAP file", "files"):
        from mcap.reader import make_reader

        topics, decoders = _Topics(flat, most_unpacked(os.path.getsize(path))), {}
        unread: dict[str, str] = {}
        with open(path, "rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(channel.message_encoding, schema)
                decode = decoders[channel.id]
                if decode is None:
                    unread[channel.topic] = channel.message_encoding
                    continue
                data = decode(message.data)
                topics.add(channel.topic, message.log_time, len(message.data), data)
        if unread and not topics.cells:
            raise InputError(
                f"its messages are encoded as {', '.join(sorted(set(unread.values())))}, which is "
                "not read here (JSON and those of ROS are); save the topics as CSV"
            )
        return topics.tree()


def _decoder(encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    """What makes a mapping of a message; None where it cannot be made."""
    if encoding == "json":
        return json.loads
    if encoding not in ("cdr", "ros1") or schema is None:
        return None
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    text = schema.data.decode("utf-8")
    store = get_typestore(Stores.EMPTY)
    if "idl" in schema.encoding:
        store.register(get_types_from_idl(text))
    else:
        store.register(get_types_from_msg(text, schema.name))
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
    if encoding == "cdr":
        return lambda data: store.deserialize_cdr(data, name)
    return lambda data: store.deserialize_ros1(data, name)


# ---- spreadsheets --------------------------------------------------------------------------------
def read_calamine(
    path: str | os.PathLike[str], sheet: str | int | None = None
) -> dict[str, list[Any]]:
    """{name: rows} of the sheets of an .xls, .xlsb or .ods file, all or one. Raises InputError."""
    require_file(path)
    with library(path, "a spreadsheet", "files"):
        from python_calamine import CalamineWorkbook

        book = CalamineWorkbook.from_path(os.fspath(path))
        found, budget = {}, MOST_SHEET_CELLS
        for name in sheets_named(path, list(book.sheet_names), sheet):
            one = book.get_sheet_by_name(name)
            budget -= one.total_height * one.total_width
            if budget < 0:
                raise InputError(
                    f"it has more than the {MOST_SHEET_CELLS} cells allowed; save it as CSV"
                )
            require_size(Path(path).name, min(one.total_height, MOST_ROWS + 1), one.total_width)
            rows = one.to_python(skip_empty_area=False)
            found[name] = [[None if c == "" else c for c in row] for row in rows]
        return found
