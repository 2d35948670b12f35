"""What a file holds, by itself: whatever one command writes, the others know it by.

Each kind of file says what it can be taken as (a plant, a motion, a muscle, a unit); whoever asks
for one of these and is given another gets told what the file is and who takes it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from ..core.errors import InputError
from ..core.files import read_toml, require_file, said_in
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.units import significant
from ..muscles.muscle_file import load_muscle
from ..muscles.pneumatic_muscle import Muscle
from ..plants.plant import Plant
from ..plants.plant_data import SYSTEM
from ..plants.plant_file import CARRYING, load_plant, named_plant

Role: TypeAlias = Literal["plant", "motion", "muscle", "table", "FMU"]

TAKEN_BY: dict[Role, str] = {
    "plant": "in place of a plant, by simulate, linearize, export, mpc, fit-plant, fit-holds",
    "motion": "as a motion, by simulate --inputs, check --against, compare, fit-plant",
    "muscle": "by --muscle",
    "table": "by look, fit, campaign",
    "FMU": "by check, mpc --against",
}


@shown
@dataclass(frozen=True)
class SavedFacts:
    """What stands in a file of results that is there to be read."""

    title: str
    facts: dict[str, Any]

    def __str__(self) -> str:
        lines = [f"{name}: {_brief(value)}" for name, value in self.facts.items()]
        return "\n".join([self.title, *lines])


def _brief(value: Any) -> str:
    if isinstance(value, list):
        return f"{len(value)} values" if len(value) > 6 else ", ".join(map(_brief, value))
    if isinstance(value, dict):
        return "; ".join(f"{n} {_brief(v)}" for n, v in value.items())
    return significant(value) if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class FileKind:
    """A kind of file. words : what one is. read : its content. roles : what it can be taken as.
    more : another command that takes it.
    """

    words: str
    read: Callable[[Path], Any] | None = None
    roles: tuple[Role, ...] = ()
    more: str = ""

    @property
    def use(self) -> str:
        """Who takes it, in words."""
        ways = [TAKEN_BY[role] for role in self.roles] + ([self.more] if self.more else [])
        shown = ["by report"] if self.read is not None else []
        return "; ".join([*ways, *shown]) or "by no command: it is there to be looked at"


def _plan(path: Path) -> Any:
    from ..planning.saved_plan import load_plan

    try:
        return load_plan(path)
    except InputError:  # of a plant that no file can hold, or of a former version
        return Trajectory.load(path)


def _plant(path: Path) -> Plant:
    return load_plant(path)


def _loop(path: Path) -> Any:
    from ..control.loop import ClosedLoop

    return ClosedLoop.load(path)


def _force_fit(path: Path) -> Any:
    from ..fitting.static.force_fit import ForceFit

    return ForceFit.from_json(path)


def _plant_fit(path: Path) -> Any:
    from ..fitting.dynamic.plant_fit import load_plant_fit

    return load_plant_fit(path) if SYSTEM in said_in(path) else _facts(path)


def _facts(path: Path) -> Any:
    content = said_in(path)
    hidden = ("format", "version", SYSTEM)
    title = str(content.get("format", path.name)).removeprefix("pam_ocp ")
    return SavedFacts(title, {n: v for n, v in content.items() if n not in hidden})


def _motion(path: Path) -> Trajectory:
    """Of a file of ours, or measured."""
    from ..fitting.tables.records import read_record

    try:
        return Trajectory.load(path)
    except InputError:
        if path.suffix.lower() == ".npz":
            raise
        return read_record(path)


def _fmu(path: Path) -> Any:
    from ..export import check_fmu

    return check_fmu(path)


TABLE = FileKind("a table or record", _motion, ("motion", "table"))
MOTION = FileKind("a motion", _motion, ("motion",))
BY_FORMAT: dict[str, FileKind] = {
    "pam_ocp plan": FileKind("a plan", _plan, ("motion",), "by load_plan in Python"),
    "pam_ocp closed loop": FileKind("a closed loop", _loop, ("motion",)),
    "pam_ocp muscle": FileKind("a muscle file", load_muscle, ("muscle",)),
    "pam_ocp force fit": FileKind("a force fit", _force_fit, ("muscle",)),
    "pam_ocp plant fit": FileKind("a fit of a plant", _plant_fit),
    "pam_ocp fit of holds": FileKind("a fit of holds", _facts),
    "pam_ocp linear model": FileKind("a linear model", _facts),
    "pam_ocp plant": FileKind("a plant", _plant),
    "pam_ocp bench": FileKind("a session of the page", None, (), "by the page ('pam-ocp bench')"),
}
BY_ENDING = {
    ".fmu": FileKind("an FMU", _fmu, ("FMU",)),
    ".ssp": FileKind("a system of FMUs (SSP)", None, (), "by tools that simulate an SSP"),
    ".ssv": FileKind("a set of values (SSV)", None, (), "by tools that simulate an FMU"),
    ".html": FileKind("a page for a browser"),
    ".png": FileKind("a picture"),
    ".pdf": FileKind("a picture"),
    ".svg": FileKind("a picture"),
    ".gif": FileKind("a moving picture"),
    ".py": FileKind("a Python file", None, (), "in place of a plant, as FILE.py:NAME"),
    ".c": FileKind("a program in C", None, (), "by a compiler"),
    ".h": FileKind("a header in C", None, (), "by a compiler"),
}
SYSTEM_FILE = FileKind("a system file", None, (), "by export")
PROBLEM = FileKind("a problem file", _plant, ("plant",), "by plan, mpc, study, fit-plant")


def kind_of(path: str | os.PathLike[str]) -> FileKind:
    """What kind of file it is, by its content where ours says that, else by its name's end.

    Raises InputError where there is no file, or one of ours is damaged.
    """
    source = require_file(path)
    ending = source.suffix.lower()
    if ending in BY_ENDING:
        return BY_ENDING[ending]
    if ending == ".toml":
        content = read_toml(source)
        if "format" in content:
            return BY_FORMAT["pam_ocp muscle"]
        return SYSTEM_FILE if "components" in content else PROBLEM
    said = _said(source)
    form = str(said.get("format", "")).rstrip("0123456789. ")
    usual = MOTION if "variables" in said else TABLE
    kind = BY_FORMAT.get(form, usual)
    if SYSTEM not in said:
        return kind
    words = f"{kind.words} with its plant"
    return FileKind(words, kind.read, ("plant", *kind.roles), kind.more)


def _said(source: Path) -> dict[str, Any]:
    """What a file of ours says of itself; nothing in others, which read_record may understand."""
    try:
        return said_in(source) if source.suffix.lower() in CARRYING else {}
    except InputError:
        return {}


def _required(path: Path, role: Role) -> FileKind:
    """The kind of a file that is taken as something. Raises InputError where it cannot be."""
    kind = kind_of(path)
    if role not in kind.roles:
        raise InputError(f"{path} is {kind.words}, no {role}; it is taken {kind.use}")
    return kind


@verb
def load(path: str | os.PathLike[str]) -> Any:
    """What a file holds, whatever verb or command wrote it: a Plan, Trajectory, ClosedLoop, Muscle,
    ForceFit, PlantFit, Plant, the check of an FMU, or the facts that stand in it.

    Plans, loops and fits carry their plant; no code of a file is run, but that of an FMU, in a
    process of its own. Other tables and records are read as :func:`pam_ocp.read_record` does.

    Raises InputError for a file that nothing reads, with what it is.

    Examples
    --------
    >>> pam.load(plan.save("plan.npz")).verified
    True
    """
    kind = kind_of(path)
    if kind.read is None:
        raise InputError(f"{os.fspath(path)} is {kind.words}; it is taken {kind.use}")
    return kind.read(Path(path))


def require_role(path: str | os.PathLike[str], role: Role) -> None:
    """Raises InputError for a file that cannot be taken so; what is no file is somebody else's."""
    if Path(path).is_file():
        _required(Path(path), role)


def plant_in(path: str | os.PathLike[str], *, allow_code: bool = False) -> Plant:
    """The plant that a file describes or carries; see :func:`pam_ocp.plants.load_plant`."""
    _required(Path(path), "plant")
    return load_plant(path, allow_code=allow_code)


def is_plant_file(name: str, folder: Path | None = None) -> bool:
    """Whether a plant is named by a file, which brings its muscle along."""
    return name.lower().endswith((".toml", *CARRYING)) or ((folder or Path()) / name).is_file()


def plant_called(
    name: str, muscle: Muscle, folder: Path | None = None, *, allow_code: bool = False
) -> Plant:
    """A plant of the library, of the user's (FILE.py:NAME), or in a file (relative to the folder).

    muscle : for the first two. Raises InputError.
    """
    if is_plant_file(name, folder):
        return plant_in((folder or Path()) / name, allow_code=allow_code)
    return named_plant(name, muscle, folder, allow_code=allow_code)


def motion_in(path: str | os.PathLike[str]) -> Trajectory:
    """The motion in a file: of a plan, of a loop, simulated or measured; a table or a workbook."""
    _required(Path(path), "motion")
    return _motion(Path(path))


def muscle_in(path: str | os.PathLike[str]) -> Muscle:
    """The muscle in a file: a muscle file, or a fit of its force."""
    kind = _required(Path(path), "muscle")
    assert kind.read is not None
    found = kind.read(Path(path))
    return found if isinstance(found, Muscle) else found.muscle()
