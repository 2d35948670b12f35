"""Neighbours of modelDescription.xml, the same in FMI 2 and 3: terminals, build, references."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from .layout import Entry, Layout
from .source import MAIN_SOURCE

__all__ = ["SIGNAL_ICON", "build_description", "experiments", "references", "terminals"]

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
    for type_, source, role, meaning in (
        ("application/xml", "experiments.xml", "experiment/validation", "the reference motion"),
        ("text/csv", f"../../documentation/{identifier}_in.csv", "other", "its inputs"),
        ("text/csv", f"../../documentation/{identifier}_ref.csv", "result", "its outputs"),
    ):
        attributes = {"type": type_, "source": source, "role": role, "description": meaning}
        ET.SubElement(root, "Related", attributes)
    return root


def experiments(
    identifier: str, start: float, stop: float, step: float, tolerance: float
) -> ET.Element:
    """experiments.xml beside the manifest: stimuli and results of the reference motion."""
    root = ET.Element("Experiments")
    experiment = ET.SubElement(
        root,
        "Experiment",
        name="reference",
        description="the reference motion: inputs are joined by straight lines",
        startTime=repr(start),
        stopTime=repr(stop),
        tolerance=repr(tolerance),
        stepSize=repr(step),
    )
    for element, suffix in (("Stimuli", "in"), ("References", "ref")):
        source = f"../../documentation/{identifier}_{suffix}.csv"
        ET.SubElement(experiment, element, type="text/csv", source=source)
    return root
