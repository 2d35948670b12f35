"""export_fmu: a plant as an FMU file."""

from __future__ import annotations

import hashlib
import os
import re
import uuid
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..core.errors import InputError, UnknownNameError, require_positive
from ..core.files import atomic_path, require_ending
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..plants.plant import Plant, require_plant
from . import compile as compiler
from . import description, documentation, interface, source
from .layout import Layout
from .runtime import c_text

__all__ = [
    "FmiVersion",
    "Settings",
    "checked",
    "export_fmu",
    "model_identifier",
    "write_archive",
    "write_fmu",
]

FmiVersion = Literal["2.0", "3.0"]

_DATE = (2000, 1, 1, 0, 0, 0)
_PLACEHOLDER = "{00000000-0000-0000-0000-000000000000}"


@dataclass(frozen=True)
class Settings:
    """What an export was asked for, checked."""

    fmi: str
    tolerance: float
    step_size: float
    fixed_step: float
    stop_time: float


@verb
def export_fmu(
    plant: Plant,
    path: str | os.PathLike[str],
    *,
    fmi: FmiVersion = "2.0",
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    platforms: Iterable[str] | None = None,
    step_size: float = 1e-3,
    tolerance: float = 1e-6,
    fixed_step: float | None = None,
    stop_time: float = 1.0,
    reference: Trajectory | None = None,
) -> Path:
    """Write the plant as an FMU for Model Exchange and Co-Simulation; returns its path.

    Parameters
    ----------
    plant : any Plant. Its parameter values and starts become the FMU's start values.
    path : the file to write, such as "slide.fmu". An existing file is replaced when all is done.
    fmi : "2.0" (default: read by every importer) or "3.0" (adjoint derivatives, terminals,
        intermediate update).
    inputs : which of the plant's inputs are inputs of the FMU, by default all. The others are held:
        they become tunable parameters with their start values (``plant.with_values``).
    outputs : which states and outputs are outputs of the FMU, by default all. The others are local
        variables: to be read and plotted, but not to be connected.
    platforms : names from :data:`PLATFORMS`, or "native" for this machine; by default all five
        (Linux and macOS on x86_64 and aarch64, Windows on x86_64). On request also "x86-linux",
        "x86-windows" and "aarch64-windows".
    step_size : proposed communication step [s]; any step is possible.
    tolerance : largest error of Co-Simulation, in units of each state's nominal. An importer can
        ask for less, not for more. The description proposes a hundredth of it (down to 1e-9) for
        the importer's own solver, whose tolerance is that of one step.
    fixed_step : internal steps of this length [s] without error control, so that the work in a
        step is known beforehand (real time); by default steps follow the tolerance.
    stop_time : proposed end of a simulation [s].
    reference : a motion of this plant, to go into the documentation as reference result: a picture,
        and tables of inputs and outputs (``*_in.csv``, ``*_ref.csv``) to check an importer with.

    The plant's path constraints are not part of an FMU. The same plant gives the same bytes.

    Raises InputError (a value out of range, a folder that does not exist, an input that is none),
    UnknownNameError (a platform, a variable), ExportError (no compiler, a name FMI keeps for
    itself).

    Examples
    --------
    >>> path = pam.export_fmu(plant, "load.fmu", fmi="3.0", platforms=["native"])
    >>> path.name
    'load.fmu'
    """
    settings = checked(plant, fmi, step_size, tolerance, fixed_step, stop_time)
    shown = interface.shown_outputs(plant, outputs)
    offered = interface.with_inputs(plant, inputs)
    if reference is not None:
        interface.check_reference(reference, offered)
    return write_fmu(
        offered,
        path,
        settings,
        platforms,
        lambda: source.plant_sources(offered),
        reference,
        shown=shown,
    )


def write_fmu(
    plant: Plant,
    path: str | os.PathLike[str],
    settings: Settings,
    platforms: Iterable[str] | None,
    code: Callable[[], source.ModelCode],
    reference: Trajectory | None = None,
    equations: Sequence[tuple[str, str]] | None = None,
    shown: frozenset[str] | None = None,
) -> Path:
    """Write an FMU of the variables of ``plant`` and the functions of ``code``.

    equations : for the documentation; by default those of the plant.
    shown : states and outputs that are outputs of the FMU; by default all.
    """
    require_ending(path, ".fmu", "an FMU")
    chosen = compiler.platforms_named(platforms)
    identifier = model_identifier(plant.name)
    with atomic_path(path) as temporary:  # first of all: is there a place to write to?
        layout = Layout(plant, shown)
        files = _contents(layout, settings, identifier, code(), reference, equations)
        content = {name: text.encode() for name, text in files.items()}
        libraries = compiler.compile_all(_c_files(files), source.MAIN_SOURCE, chosen, identifier)
        content |= _binaries(libraries, identifier, settings.fmi)
        content |= _icons(settings.fmi)
        if reference is not None:
            content["documentation/reference.png"] = documentation.picture(reference)
        write_archive(temporary, content)
    return Path(path)


def model_identifier(name: str) -> str:
    """A C identifier of a plant's name."""
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"{identifier}_" if identifier in _C_KEYWORDS else identifier


_C_KEYWORDS = frozenset(
    {
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
        "for",
        "goto",
        "if",
        "inline",
        "int",
        "long",
        "register",
        "restrict",
        "return",
        "short",
        "signed",
        "sizeof",
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
    }
)


def checked(
    plant: Plant,
    fmi: str,
    step_size: float,
    tolerance: float,
    fixed_step: float | None,
    stop_time: float,
) -> Settings:
    require_plant(plant)
    if fmi not in ("2.0", "3.0"):
        raise UnknownNameError("FMI version", fmi, ("2.0", "3.0"))
    step_size = require_positive("step_size", step_size, "s")
    stop_time = require_positive("stop_time", stop_time, "s")
    if not 1e-11 <= require_positive("tolerance", tolerance) <= 1e-2:
        raise InputError(f"tolerance = {tolerance:g} must lie in 1e-11 .. 1e-2")
    fixed = 0.0 if fixed_step is None else require_positive("fixed_step", fixed_step, "s")
    return Settings(fmi, float(tolerance), float(step_size), fixed, float(stop_time))


def _contents(
    layout: Layout,
    settings: Settings,
    identifier: str,
    code: source.ModelCode,
    reference: Trajectory | None,
    equations: Sequence[tuple[str, str]] | None,
) -> dict[str, str]:
    """Every text file of the FMU by its path in the archive, with the token filled in."""
    files = {f"sources/{name}": text for name, text in source.hand_written(settings.fmi).items()}
    files |= {f"sources/{name}": text for name, text in code.files.items()}
    files["sources/model_data.h"] = source.model_data(
        layout,
        code.work,
        identifier=identifier,
        token=_PLACEHOLDER,
        tolerance=settings.tolerance,
        fixed_step=settings.fixed_step,
    )
    files["modelDescription.xml"] = description.to_text(
        description.model_description(
            layout,
            settings.fmi,
            identifier=identifier,
            token=_PLACEHOLDER,
            tolerance=source.proposed_tolerance(settings.tolerance),
            step_size=settings.step_size,
            stop_time=settings.stop_time,
            fixed_step=settings.fixed_step,
            version=_version(),
        )
    )
    token = _token(files)
    files |= _pages(layout, settings, identifier, reference, equations)
    return {name: text.replace(_PLACEHOLDER, token) for name, text in files.items()}


def _version() -> str:
    from .. import __version__

    return str(__version__)


def _token(files: Mapping[str, str]) -> str:
    """GUID or instantiation token: a fingerprint of everything the binary comes from."""
    digest = hashlib.sha256()
    for name, text in sorted(files.items()):
        digest.update(f"{name}\0{len(text)}\0{text}".encode())
    return f"{{{uuid.UUID(bytes=digest.digest()[:16])}}}"


def _pages(
    layout: Layout,
    settings: Settings,
    identifier: str,
    reference: Trajectory | None,
    equations: Sequence[tuple[str, str]] | None,
) -> dict[str, str]:
    solver = (
        f"fixed steps of {settings.fixed_step:g} s"
        if settings.fixed_step
        else f"a tolerance of {settings.tolerance:g} in units of nominal"
    )
    notes = [
        f"FMI {settings.fmi}, Model Exchange and Co-Simulation. Co-Simulation integrates with "
        f"Rodas4 (Rosenbrock method of order 4, L-stable) at {solver}; inputs are held over a "
        "communication step, or run linearly when the importer gives their derivatives.",
        "Fixed parameters can be set until the end of initialization, tunable ones at any "
        "communication point or event. The sources folder holds everything to compile the FMU.",
    ]
    folder = "documentation/licenses"
    pages = {
        "documentation/index.html": documentation.page(
            layout, notes, reference is not None, equations
        ),
        f"{folder}/license.txt": c_text("LICENSE.sources"),
        f"{folder}/fmi-headers.txt": c_text("LICENSE.fmi-headers"),
    }
    if reference is not None:
        for suffix, entries in (("in", layout.of("input")), ("ref", layout.outputs)):
            table = documentation.reference_table(reference, {e.name for e in entries})
            pages[f"documentation/{identifier}_{suffix}.csv"] = table
    if settings.fmi == "3.0":
        build = description.build_description(identifier)
        pages["sources/buildDescription.xml"] = description.to_text(build)
        terminals = description.terminals(layout)
        pages["terminalsAndIcons/terminalsAndIcons.xml"] = description.to_text(terminals)
        pages["terminalsAndIcons/icon.svg"] = documentation.icon_svg()
    return pages


def _c_files(files: Mapping[str, str]) -> dict[str, str]:
    return {
        name.removeprefix("sources/"): text
        for name, text in files.items()
        if name.startswith("sources/") and name.endswith((".c", ".h"))
    }


def _binaries(libraries: Mapping[str, bytes], identifier: str, fmi: str) -> dict[str, bytes]:
    folders: dict[str, dict[str, bytes]] = {}
    for name, library in libraries.items():
        platform = compiler.PLATFORMS[name]
        folder = platform.folder2 if fmi == "2.0" else name
        folders.setdefault(f"binaries/{folder}/{identifier}{platform.suffix}", {})[name] = library
    return {path: compiler.universal(parts) for path, parts in folders.items()}


def _icons(fmi: str) -> dict[str, bytes]:
    png = documentation.icon_png()
    return {"model.png": png} if fmi == "2.0" else {"terminalsAndIcons/icon.png": png}


def write_archive(path: Path, content: Mapping[str, bytes]) -> None:
    """Write a zip archive, sorted, with one fixed date: the same content gives the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name in sorted(content, key=lambda n: (n != "modelDescription.xml", n)):
            info = zipfile.ZipInfo(name, _DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, content[name])
