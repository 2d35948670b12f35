"""What was done on the page, as plain values: chosen, undone, saved, resumed. No page is needed.

A session is a folder: ``session.json`` and ``files/`` with what was dropped on the page. Its state
is a mapping of JSON values that says how everything on the page is made again by public verbs, and
nothing that can be computed from it::

    data         [{"id", "name", "file" | "bundled", "said", "off"}]   what look() and read_table()
                 are called with, and the cells that are switched off
    chosen       id of the data in use, or None
    muscle       None, or {"kind": "catalogue" | "fit" | "file", ...}    (made.py makes the Muscle)
    plant        a [plant] table without its muscle, as plant_of() takes it
    point        the operating point, as keywords of equilibrium()
    motions      [{"id", ...}]      the tab Motion says what stands in one
    controllers  [{"id", ...}]      the tab Control
    exports      [{...}]            the tab Export
    views        {tab: {...}}       what a tab remembers of itself: units, ranges of a map

Whoever changes something calls :meth:`Session.change` with whole parts; that is one step of undo,
and is on the disk when the call returns. Listeners are told the names of the parts that changed.
"""

from __future__ import annotations

import copy
import hashlib
import json
import os
import re
import secrets
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..core.errors import InputError, UnknownNameError
from ..core.files import atomic_path, make_folder, read_json, write_json

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


class FolderLock:
    """Holds the file ``path``, if nobody else does; ``taken`` says whether."""

    def __init__(self, path: Path) -> None:
        self._handle: int | None = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            if sys.platform == "win32":
                msvcrt.locking(self._handle, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._handle)
            self._handle = None

    @property
    def taken(self) -> bool:
        """Whether this process holds it."""
        return self._handle is not None

    def release(self) -> None:
        """Let others have it."""
        if self._handle is None:
            return
        os.close(self._handle)
        self._handle = None


FORMAT = "pam_ocp bench 1"
FILE = "session.json"
MOST_STEPS = 100
"""Steps that can be undone."""
DIGITS = 10
"""Of a stored file's digest, in its name."""
MOST_FILES = 200
"""Files in a session."""

EMPTY: dict[str, Any] = {
    "data": [],
    "chosen": None,
    "muscle": None,
    "plant": {"arrangement": "HangingLoad"},
    "point": {},
    "motions": [],
    "controllers": [],
    "exports": [],
    "views": {},
}
"""The state of a new session."""
PARTS = tuple(EMPTY)

State = dict[str, Any]
Listener = Callable[[frozenset[str]], None]


class SessionInUse(InputError):
    """Another process holds this session."""


class Session:
    """One session: its state, the way back and forth, and its folder.

    folder : of the session; made where it is missing. Raises SessionInUse where another process
    holds it, InputError for a file that is no session.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = make_folder(folder)
        make_folder(folder / "files")
        with suppress(OSError):  # it may be one of before that others can read
            self.folder.chmod(0o700)
        self._lock = FolderLock(folder / "lock")
        if not self._lock.taken:
            raise SessionInUse(f"{folder}: another bench has this session open; close it there")
        self.title = ""
        self.names: dict[str, str] = {}
        """Of files dropped since it was opened, the names that users gave them."""
        self.state: State = copy.deepcopy(EMPTY)
        self._past: list[tuple[str, State]] = []
        self._future: list[tuple[str, State]] = []
        self._listeners: list[Listener] = []
        if (self.folder / FILE).exists():
            try:
                self._read()
            except InputError:
                self._lock.release()
                raise

    @classmethod
    def new(cls, root: Path) -> Session:
        """An empty session in a folder of its own below ``root``."""
        return cls(root / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(4)}")

    @property
    def id(self) -> str:
        """Its name in addresses."""
        return self.folder.name

    def close(self) -> None:
        """Let others open it; a session in which nothing was done leaves no folder."""
        if not self._past and not self._future and not (self.folder / FILE).exists():
            with suppress(OSError):
                (self.folder / "files").rmdir()
                (self.folder / "lock").unlink()
                self.folder.rmdir()
        self._lock.release()

    # ---- changing ------------------------------------------------------------------------------
    def change(self, label: str, **parts: Any) -> None:
        """Replace parts of the state: one step of undo, saved at once.

        label : what was done, as it stands beside "undo". Raises UnknownNameError for no part,
        InputError for what JSON cannot hold; then nothing has changed.
        """
        for name in parts:
            if name not in EMPTY:
                raise UnknownNameError("part of a session", name, PARTS)
        fresh = {name: _plain(f"{label}: {name}", value) for name, value in parts.items()}
        changed = frozenset(n for n, v in fresh.items() if v != self.state[n])
        if not changed:
            return
        self._past.append((label, self.state))
        del self._past[:-MOST_STEPS]
        self._future.clear()
        self.state = {**self.state, **fresh}
        self._settle(changed)

    def remember(self, tab: str, **values: Any) -> None:
        """Keep what a tab shows (units, ranges of a picture): saved, but no step of undo."""
        own = {**self.state["views"].get(tab, {}), **values}
        views = {**self.state["views"], tab: _plain(tab, own)}
        if views != self.state["views"]:
            self.state = {**self.state, "views": views}
            self.save()

    def view(self, tab: str, name: str, default: Any = None) -> Any:
        """What :meth:`remember` kept."""
        return self.state["views"].get(tab, {}).get(name, default)

    @property
    def undo_label(self) -> str | None:
        """What undo would take back."""
        return self._past[-1][0] if self._past else None

    @property
    def redo_label(self) -> str | None:
        """What redo would do again."""
        return self._future[-1][0] if self._future else None

    def undo(self) -> None:
        """Take the last step back, if there is one."""
        self._move(self._past, self._future)

    def redo(self) -> None:
        """Do again what was undone last."""
        self._move(self._future, self._past)

    def _move(self, source: list[tuple[str, State]], target: list[tuple[str, State]]) -> None:
        if not source:
            return
        label, there = source.pop()
        target.append((label, self.state))
        views = self.state["views"]
        changed = frozenset(n for n in PARTS if there[n] != self.state[n] and n != "views")
        self.state = {**there, "views": views}
        self._settle(changed)

    def _settle(self, changed: frozenset[str]) -> None:
        self.save()
        for listener in list(self._listeners):
            listener(changed)

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call ``listener(names of parts)`` after each change; returns what ends it."""
        self._listeners.append(listener)

        def end() -> None:
            with suppress(ValueError):
                self._listeners.remove(listener)

        return end

    # ---- lists of things with an id ------------------------------------------------------------
    def item(self, part: str, id: str | None) -> dict[str, Any] | None:
        """The member of a list (data, motions, controllers) with this id."""
        found: Iterator[dict[str, Any]] = (m for m in self.state[part] if m.get("id") == id)
        return next(found, None)

    def put(self, label: str, part: str, item: dict[str, Any], **parts: Any) -> None:
        """Replace the member with the same id, or add it at the end; further parts as well."""
        members = [item if m.get("id") == item["id"] else m for m in self.state[part]]
        if self.item(part, item["id"]) is None:
            members.append(item)
        self.change(label, **{part: members}, **parts)

    def drop(self, label: str, part: str, id: str) -> None:
        """Take the member with this id out."""
        self.change(label, **{part: [m for m in self.state[part] if m.get("id") != id]})

    def fresh_id(self, part: str) -> str:
        """An id that no member of this list has or, as far as undo goes, has had: "data3"."""
        steps = (state for _, state in (*self._past, *self._future))
        members = (m for state in (self.state, *steps) for m in state[part])
        ids = (re.fullmatch(rf"{part}(\d+)", str(m["id"])) for m in members)
        return f"{part}{max((int(i[1]) for i in ids if i), default=0) + 1}"

    # ---- files ---------------------------------------------------------------------------------
    def store(self, name: str, content: bytes) -> str:
        """Keep what was dropped on the page; returns its name below ``files/``.

        The name is made safe: no folder, no leading dot, no characters but letters, digits and
        ``.-_``; in front of it the content's digest, so that equal names do not meet.
        """
        there = self.folder / "files"
        if sum(1 for _ in there.iterdir()) >= MOST_FILES:
            raise InputError(f"{name}: this session holds {MOST_FILES} files; begin another one")
        kept = safe_name(f"{hashlib.sha256(content).hexdigest()[:DIGITS]}-{safe_name(name)}")
        if not _whole(there / kept):
            with atomic_path(there / kept) as temporary:
                temporary.write_bytes(content)
        self.names[kept] = name
        return kept

    # ---- the disk ------------------------------------------------------------------------------
    def save(self) -> None:
        """Write ``session.json``: as a whole, or not at all."""
        content = {
            "format": FORMAT,
            "title": self.title,
            "state": self.state,
            "past": [list(step) for step in self._past],
            "future": [list(step) for step in self._future],
        }
        write_json(self.folder / FILE, content)

    def _read(self) -> None:
        path = self.folder / FILE
        content = read_json(path, "a session of the bench", FORMAT, "begin a new session")
        self.title = str(content.get("title", ""))
        self.state = _state(path, content.get("state"))
        for name, steps in (("past", self._past), ("future", self._future)):
            for step in content.get(name, ()):
                if not isinstance(step, list) or len(step) != 2:
                    raise InputError(
                        f"{path}: a step of its {name} is damaged; begin a new session"
                    )
                steps.append((str(step[0]), _state(path, step[1])))


def stored_file(folder: Path, file: str) -> Path:
    """Where a file lies that was dropped on the page of the session in ``folder``.

    Raises InputError for a name that leads elsewhere, and for half a file (what a full disk left).
    """
    if file != safe_name(file):
        raise InputError(f"file = {file!r} is no name of a file in this session")
    path = folder / "files" / file
    if re.match(f"[0-9a-f]{{{DIGITS}}}-", file) and path.exists() and not _whole(path):
        raise InputError(f"{file} is not what was dropped on the page; drop the file again")
    return path


def _whole(path: Path) -> bool:
    """Whether a stored file is there and holds what its name says (the content's digest)."""
    with suppress(OSError):
        told = path.stat()
        return _digest(path, told.st_mtime_ns, told.st_size) == path.name.partition("-")[0]
    return False


@lru_cache(maxsize=MOST_FILES)
def _digest(path: Path, changed: int, size: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS]


def saved_sessions(root: Path) -> list[tuple[str, float]]:
    """(id, time of the last change [s since 1970]) of the sessions below ``root``, newest first."""
    found = []
    with suppress(OSError):
        for folder in root.iterdir():
            with suppress(OSError):
                found.append((folder.name, (folder / FILE).stat().st_mtime))
    return sorted(found, key=lambda one: -one[1])


def safe_name(name: str) -> str:
    """A name for a file out of what a browser says: the last part, plain characters, not long."""
    last = re.split(r"[/\\]", name)[-1]
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", last).lstrip(".") or "file"
    stem, dot, ending = plain.rpartition(".")
    return f"{stem[:80]}{dot}{ending[:12]}" if stem else plain[:80]


def _plain(where: str, value: Any) -> Any:
    """The same out of JSON: a copy that nobody else holds, with finite numbers."""
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} cannot be saved: {error}") from None


def _state(path: Path, value: Any) -> State:
    if not isinstance(value, dict):
        raise InputError(f"{path}: its state is damaged; begin a new session")
    for name, usual in EMPTY.items():
        there = value.get(name, usual)
        if usual is not None and type(there) is not type(usual):
            raise InputError(f"{path}: {name} is damaged; begin a new session")
    return {**copy.deepcopy(EMPTY), **{n: v for n, v in value.items() if n in EMPTY}}
