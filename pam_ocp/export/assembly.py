"""The files of an FMU, put together and written: the same for plants, blocks and motions."""

from __future__ import annotations

import hashlib
import os
import re
import uuid
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..core.files import atomic_path, require_ending
from ..core.trajectory import Trajectory
from . import compile as compiler
from . import description, source
from .layout import Entry, Layout, Settings
from .source import C_KEYWORDS, MAIN_SOURCE, c_text

_DATE = (2000, 1, 1, 0, 0, 0)
_PLACEHOLDER = "{00000000-0000-0000-0000-000000000000}"


@dataclass(frozen=True)
class Content:
    """What goes into an FMU beside its variables."""

    kind: str
    """Of the C runtime: "fmu" for a plant, "block"."""
    code: Callable[[], source.ModelCode]
    equations: Callable[[], Sequence[tuple[str, str]]]
    """For the documentation."""
    notes: Sequence[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    """More for model_data.h."""
    reference: Trajectory | None = None


def write_fmu(
    layout: Layout,
    path: str | os.PathLike[str],
    settings: Settings,
    platforms: Iterable[str] | str | None,
    content: Content,
) -> Path:
    """Write an FMU of these variables and this content."""
    require_ending(path, ".fmu", "an FMU")
    chosen = compiler.platforms_named(platforms)
    identifier = model_identifier(layout.name)
    with atomic_path(path) as temporary:  # first of all: is there a place to write to?
        texts = _contents(layout, settings, identifier, content)
        files = {name: text.encode() for name, text in texts.items()}
        libraries = compiler.compile_all(_c_files(texts), source.MAIN_SOURCE, chosen, identifier)
        files |= _binaries(libraries, identifier, settings.fmi)
        files |= _icons(settings.fmi)
        if content.reference is not None:
            files["documentation/reference.png"] = description.picture(content.reference)
        write_archive(temporary, files)
    return Path(path)


def model_identifier(name: str) -> str:
    """A C identifier of a plant's name."""
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"{identifier}_" if identifier in C_KEYWORDS else identifier


def _contents(
    layout: Layout, settings: Settings, identifier: str, content: Content
) -> dict[str, str]:
    """Every text file of the FMU by its path in the archive, with the token filled in."""
    code = content.code()
    texts = source.hand_written(settings.fmi, content.kind)
    files = {f"sources/{name}": text for name, text in texts.items()}
    files |= {f"sources/{name}": text for name, text in code.files.items()}
    names: dict[str, Any] = {"identifier": identifier, "token": _PLACEHOLDER}
    files["sources/model_data.h"] = source.model_data(
        layout, code.work, settings, **names, **content.data
    )
    tool = f"pam_ocp {__version__}"
    root = description.model_description(layout, settings, **names, tool=tool)
    files["modelDescription.xml"] = description.to_text(root)
    token = _token(files)
    files |= _pages(layout, settings, identifier, content)
    return {name: text.replace(_PLACEHOLDER, token) for name, text in files.items()}


def _token(files: Mapping[str, str]) -> str:
    """GUID or instantiation token: a fingerprint of everything the binary comes from."""
    digest = hashlib.sha256()
    for name, text in sorted(files.items()):
        digest.update(f"{name}\0{len(text)}\0{text}".encode())
    return f"{{{uuid.UUID(bytes=digest.digest()[:16])}}}"


def _pages(layout: Layout, settings: Settings, identifier: str, content: Content) -> dict[str, str]:
    folder = "documentation/licenses"
    icons, extra = "terminalsAndIcons", "extra/org.fmi-standard.fmi-ls-ref"
    reference = content.reference
    trees = {
        "sources/buildDescription.xml": build_description(identifier),
        f"{icons}/terminalsAndIcons.xml": terminals(layout),
    }
    pages = {
        "documentation/index.html": description.page(
            layout, _notes(settings, content), content.equations(), reference is not None
        ),
        f"{folder}/license.txt": c_text("LICENSE.sources"),
        f"{folder}/fmi-headers.txt": c_text("LICENSE.fmi-headers"),
        f"{icons}/icon.svg": description.icon_svg(),
    }
    if reference is not None:
        for suffix, entries in (("in", layout.of("input")), ("ref", layout.outputs)):
            shown = {e.name for e in entries}
            names = [v.name for v in reference.variables if v.name in shown]
            rows = np.column_stack([reference.t, reference.array(names)])
            pages[f"documentation/{identifier}_{suffix}.csv"] = description.table(names, rows)
        trees[f"{extra}/fmi-ls-manifest.xml"] = references(identifier)
        trees[f"{extra}/experiments.xml"] = experiments(identifier, reference, settings)
    return pages | {name: description.to_text(tree) for name, tree in trees.items()}


def _notes(settings: Settings, content: Content) -> list[str]:
    """Paragraphs of the documentation."""
    solver = (
        f"fixed steps of {settings.fixed_step:g} s"
        if settings.fixed_step
        else f"a tolerance of {settings.tolerance:g} scaled by nominals"
    )
    first = content.notes or [
        f"FMI {settings.fmi}, Model Exchange and Co-Simulation. Co-Simulation integrates with "
        f"Rodas5P (Rosenbrock method of order 5, L-stable) at {solver}; inputs are held over a "
        "communication step, or run linearly when the importer gives their derivatives.",
    ]
    return [
        *first,
        "Fixed parameters can be set until the end of initialization, tunable ones at any "
        "communication point or event. The sources folder holds everything to compile the FMU.",
    ]


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
    pictures = {name: description.stored(name) for name in ("icon.png", f"{SIGNAL_ICON}.png")}
    icons = {f"terminalsAndIcons/{name}": content for name, content in pictures.items()}
    return icons | ({"model.png": pictures["icon.png"]} if fmi == "2.0" else {})


def write_archive(path: Path, content: Mapping[str, bytes]) -> None:
    """Write a zip archive, sorted, with one fixed date: the same content gives the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name in sorted(content, key=lambda n: (n != "modelDescription.xml", n)):
            info = zipfile.ZipInfo(name, _DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, content[name])


# ---- neighbours of modelDescription.xml, the same in FMI 2 and 3 -----------------------------
SIGNAL_ICON = "signal"
"""Base name of the picture of a terminal."""
_KIND = "org.pam_ocp"
_COLOUR = "51 68 85"


def build_description(identifier: str) -> ET.Element:
    """sources/buildDescription.xml: how to compile the sources. FMI 2.0.4 took it from FMI 3."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(
        root,
        "BuildConfiguration",
        modelIdentifier=identifier,
        description="one translation unit, C11, no library but the mathematical one",
    )
    files = ET.SubElement(configuration, "SourceFileSet", language="C11")
    ET.SubElement(files, "SourceFile", name=MAIN_SOURCE)
    return root


def terminals(layout: Layout) -> ET.Element:
    """terminalsAndIcons.xml: the icon, and one terminal for each part with inputs and outputs.

    A terminal gathers the variables ``part.*`` (a muscle's command, force, ...), and one more the
    inputs and outputs of the whole. They match as buses do: members of one name belong together,
    so the terminal ``muscle1`` of a controller fits the terminal ``muscle1`` of a plant. Parts
    stand on the right border of the icon, the whole on the left. FMI 2.0.4 took the file from
    FMI 3.
    """
    root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    drawing = ET.SubElement(root, "GraphicalRepresentation")
    square = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
    ET.SubElement(drawing, "CoordinateSystem", {**square, "suggestedScalingFactorTo_mm": "0.1"})
    ET.SubElement(drawing, "Icon", square)
    groups: dict[str, list[Entry]] = {}
    for entry in layout.entries:
        if entry.is_output or entry.role == "input":
            groups.setdefault(entry.name.rpartition(".")[0] or layout.name, []).append(entry)
    if not groups:
        return root
    parent = ET.SubElement(root, "Terminals")
    parts = [name for name in groups if name != layout.name]
    for name, members in groups.items():
        part = name in parts
        kind = name.rpartition(".")[2].rstrip("0123456789") if part else "model"
        terminal = ET.SubElement(
            parent, "Terminal", name=name, matchingRule="bus", terminalKind=f"{_KIND}.{kind}"
        )
        for entry in members:
            ET.SubElement(
                terminal,
                "TerminalMemberVariable",
                variableName=entry.name,
                memberName=entry.name.rpartition(".")[2],
                variableKind="signal",
            )
        height = 0.0
        if part:
            height = 100.0 - 200.0 * (parts.index(name) + 1) / (len(parts) + 1)
        x = 100 if part else -100
        place = {"x1": x - 10, "y1": height - 10, "x2": x + 10, "y2": height + 10}
        ET.SubElement(
            terminal,
            "TerminalGraphicalRepresentation",
            {
                "defaultConnectionColor": _COLOUR,
                "defaultConnectionStrokeSize": "1.0",
                **{corner: f"{value:g}" for corner, value in place.items()},
                "iconBaseName": SIGNAL_ICON,
            },
        )
    return root


# ---- fmi-ls-ref: which of the files are reference results ---------------------------------------


def references(identifier: str) -> ET.Element:
    """fmi-ls-manifest.xml of the layered standard FMI-LS-REF (1.0.0-alpha.1)."""
    space = "fmi-ls:"
    root = ET.Element(
        "fmiReferences",
        {
            "xmlns:fmi-ls": "http://fmi-standard.org/fmi-ls-manifest",
            f"{space}fmi-ls-name": "org.fmi-standard.fmi-ls-ref",
            f"{space}fmi-ls-version": "1.0.0-alpha.1",
            f"{space}fmi-ls-description": "Layered Standard providing information on related "
            "files included in an FMU.",
        },
    )
    for type_, file, role, meaning in (
        ("application/xml", "experiments.xml", "experiment/validation", "the reference motion"),
        ("text/csv", f"../../documentation/{identifier}_in.csv", "other", "its inputs"),
        ("text/csv", f"../../documentation/{identifier}_ref.csv", "result", "its outputs"),
    ):
        attributes = {"type": type_, "source": file, "role": role, "description": meaning}
        ET.SubElement(root, "Related", attributes)
    return root


def experiments(identifier: str, motion: Trajectory, settings: Settings) -> ET.Element:
    """experiments.xml beside the manifest: stimuli and results of the reference motion."""
    root = ET.Element("Experiments")
    experiment = ET.SubElement(
        root,
        "Experiment",
        name="reference",
        description="the reference motion: inputs are joined by straight lines",
        startTime=repr(float(motion.t[0])),
        stopTime=repr(float(motion.t[-1])),
        tolerance=repr(settings.proposed_tolerance),
        stepSize=repr(settings.step_size),
    )
    for element, suffix in (("Stimuli", "in"), ("References", "ref")):
        file = f"../../documentation/{identifier}_{suffix}.csv"
        ET.SubElement(experiment, element, type="text/csv", source=file)
    return root
