"""export_fmu: a plant or a sampled block as an FMU file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np

from ..core.block import Block
from ..core.errors import InputError, renamed, require_flag
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..muscles.pneumatic_muscle import Muscle
from ..operating.linear import chosen_signals
from ..plants.alone import muscle_alone
from ..plants.damping import Loss
from ..plants.feeds import Feed
from ..plants.plant import Plant, require_plant
from ..plants.undelayed import attributes_of
from ..simulation import simulate
from . import description, sampled, source
from .assembly import Content, write_fmu
from .layout import FmiVersion, PlantLayout, Settings, checked, checked_about
from .sampled import as_block

ANOTHER = 1e-2
"""Of a state's nominal: by more a reference deviates that is no motion of the plant. A plan's keeps
its tolerance, a thousandth.
"""
TOLERANCE = 1e-6
"""Of Co-Simulation."""


@renamed("0.3", plant="system")
@verb
def export_fmu(
    system: Plant | Block | Any,
    path: str | os.PathLike[str],
    *,
    fmi: FmiVersion = "2.0",
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    platforms: Iterable[str] | str | None = None,
    step_size: float | None = None,
    tolerance: float | None = None,
    fixed_step: float | None = None,
    clock: bool = True,
    stop_time: float = 1.0,
    reference: Trajectory | None = None,
    share: bool = False,
    matrices: bool = False,
    booleans: bool = False,
    enumerations: bool = False,
    precision: Literal["double", "single"] = "double",
    author: str | None = None,
    version: str | None = None,
    copyright: str | None = None,
    license: str | None = None,
    date: str | datetime | None = None,
) -> Path:
    """Write a plant, or a sampled block such as a controller, as an FMU; returns its path.

    A plant's FMU is for Model Exchange and Co-Simulation, a block's for Co-Simulation: it makes its
    samples inside, at start + k sample_time exactly, whatever the steps of the importer, or on the
    ticks of a clock in FMI 3 (docs/fmu.md). Its memory is in the saved state, not among the
    variables.

    Parameters
    ----------
    system : any Plant (its parameter values and starts become the FMU's start values), a Block, or
        a controller, of which ``pam_ocp.control.block`` makes one.
    path : the file to write, such as "slide.fmu". An existing file is replaced when all is done.
    fmi : "2.0" (default: read by every importer) or "3.0" (adjoint derivatives, event mode, a
        block's clock, intermediate update).
    inputs : which of the plant's inputs are inputs of the FMU, by default all. The others are held:
        they become tunable parameters with their start values (``plant.with_values``).
    outputs : which states and outputs are outputs of the FMU, by default all. The others are local
        variables: to be read and plotted, but not to be connected.
    platforms : names from :data:`PLATFORMS`, or "native" for this machine; by default all five
        (Linux and macOS on x86_64 and aarch64, Windows on x86_64). On request also "x86-linux",
        "x86-windows" and "aarch64-windows". "source" alone gives an FMU without binaries, whose
        importer compiles it as sources/buildDescription.xml says.
    step_size : proposed communication step [s]; any step is possible. By default 1 ms, for a block
        its sample time.
    tolerance : largest error of Co-Simulation, in units of each state's nominal, by default 1e-6;
        a block has none. An importer can ask for less, not for more. The description proposes a
        hundredth of it (down to 1e-9) for the importer's own solver, whose tolerance is that of one
        step.
    fixed_step : internal steps of this length [s] without error control, so that the work in a
        step is known beforehand (real time); by default steps follow the tolerance.
    clock : False leaves the clock out of a block's FMI 3 description, for importers that cannot
        read one (ecos 0.7.2 crashes); the samples are the same.
    stop_time : proposed end of a simulation [s].
    reference : a motion of this plant from its start values, as reference result: a picture, tables
        of inputs and outputs (``*_in.csv``, ``*_ref.csv``) to check an importer with, and the
        experiment as the layered standard FMI-LS-REF describes it.
    share : True gives muscles with equal constants one parameter for each (``muscle.a1``), and
        makes theirs (``muscle1.a1``, ...) calculated ones.
    matrices : True shows a block's gains in FMI 3 as array parameters (``K``), tunable as a whole
        while it runs; by default, and in FMI 2, each entry is a parameter
        (``K.muscle1.command.x``), with its unit.
    booleans : True makes a block's ``enable`` a Boolean, and its ``status`` one Boolean for each
        bit: ``status.off``, ``.missing``, ``.lost``, ``.at_range``, ``.at_rate``, ``.no_number``.
    enumerations : True makes variables with codes enumerations, such as an Mpc's ``solver.status``.
    precision : "single" makes a block's numbers Float32 (FMI 3), computed with floats as
        :func:`export_c` has them.
    author, version, copyright, license : of the model, for its description.
    date : of the model, ISO 8601 or a datetime; by default a fixed one, so that the same plant
        gives the same bytes.

    The plant's path constraints are not part of an FMU.

    Raises InputError (a value out of range, a folder that does not exist, an input that is none),
    UnknownNameError (a platform, a variable), ExportError (no compiler, a name FMI keeps for
    itself, a block whose step is not bounded).

    Examples
    --------
    >>> path = pam.export_fmu(plant, "load.fmu", fmi="3.0", platforms=["native"])
    >>> path.name
    'load.fmu'
    """
    about = checked_about(author, version, copyright, license, date)
    shapes = checked_shapes(fmi, matrices=matrices, booleans=booleans, enumerations=enumerations)
    for argument, flag in (("share", share), ("clock", clock)):
        require_flag(argument, flag)
    if precision not in ("double", "single"):
        raise InputError(f"precision = {precision!r}: choose 'double' or 'single'")
    if precision == "single" and (fmi == "2.0" or matrices):
        raise InputError(
            "precision = 'single': FMI 2 and arrays of gains have no such numbers; give fmi='3.0' "
            "and leave out matrices"
        )
    block = as_block(system)
    if block is not None:
        refused = {"inputs": inputs, "outputs": outputs, "fixed_step": fixed_step}
        refused |= {"tolerance": tolerance, "share": share or None}
        for argument, value in {**refused, "reference": reference}.items():
            if value is not None:
                raise InputError(f"{argument}: a block has none; leave it out")
        size = block.sample_time if step_size is None else step_size
        settings = checked(fmi, size, TOLERANCE, None, stop_time, about)
        shapes["single"] = precision == "single"
        _require_codes(enumerations, (*block.inputs, *block.parameters, *block.outputs))
        return write_block(block, path, settings, platforms, clock, None, **shapes)
    for argument in ("matrices", "booleans"):
        if shapes[argument]:
            raise InputError(f"{argument} = True: a plant has none; leave it out")
    if precision == "single":
        raise InputError("precision = 'single': only blocks compute so; leave it out")
    plant = require_plant(system)
    _require_codes(enumerations, (*plant.inputs, *plant.parameters))
    size = 1e-3 if step_size is None else step_size
    most = TOLERANCE if tolerance is None else tolerance
    settings = checked(fmi, size, most, fixed_step, stop_time, about)
    shown = _shown_outputs(plant, outputs)
    offered = _with_inputs(plant, inputs)
    if reference is not None:
        _check_reference(reference, offered)
    calculated: frozenset[str] = frozenset()
    if share:
        offered, calculated = with_shared(offered)
    content = Content(
        "fmu",
        lambda: source.plant_sources(offered),
        lambda: description.equations(offered),
        reference=reference,
    )
    return write_fmu(
        PlantLayout(offered, shown, calculated, enumerations), path, settings, platforms, content
    )


def _require_codes(wanted: bool, variables: Iterable[Variable]) -> None:
    if wanted and not any(v.codes for v in variables):
        raise InputError(
            "enumerations = True: no variable has codes (see Variable; outputs of plants stay "
            "numbers); leave it out"
        )


def checked_shapes(fmi: FmiVersion, **shapes: bool) -> dict[str, bool]:
    """Arguments that give a block's variables another form, by name. Raises InputError."""
    for argument, wanted in shapes.items():
        require_flag(argument, wanted)
    if shapes.get("matrices") and fmi == "2.0":
        raise InputError("matrices = True: FMI 2 has no arrays; give fmi='3.0', or leave it out")
    return shapes


@verb
def export_muscle(
    muscle: Muscle | str,
    path: str | os.PathLike[str],
    *,
    feed: Feed | None = None,
    losses: Loss | Sequence[Loss] = (),
    name: str = "muscle",
    **options: Any,
) -> Path:
    """Write a muscle alone as an FMU, for multibody tools; returns its path.

    Inputs are ``<name>.length`` between its ends [m], ``<name>.speed`` at which it grows longer
    [m/s] and the commands of its feed; the output ``<name>.force`` pulls the ends together [N]
    (docs/worlds.md). muscle, feed, losses, name : as :func:`pam_ocp.plants.muscle_alone` takes
    them. options : of :func:`export_fmu`.

    Raises InputError, UnknownNameError, ExportError as these do.

    Examples
    --------
    >>> path = pam.export.export_muscle(muscle, "muscle.fmu", platforms=["native"])
    >>> path.name
    'muscle.fmu'
    """
    return export_fmu(muscle_alone(muscle, feed=feed, losses=losses, name=name), path, **options)


def write_block(
    block: Block,
    path: str | os.PathLike[str],
    settings: Settings,
    platforms: Iterable[str] | str | None,
    clock: bool,
    first: Mapping[str, float] | None = None,
    **shapes: bool,
) -> Path:
    """Write a block as an FMU. first, shapes : see BlockLayout."""
    block = sampled.as_booleans(block) if shapes.get("booleans") else block
    layout = sampled.BlockLayout(block, clock, first, **shapes)
    content = Content(
        "block",
        lambda: sampled.block_sources(block, layout.single),
        lambda: [("(memory, outputs)", "step(memory, inputs, parameters)")],
        sampled.block_notes(block),
        sampled.block_data(layout),
    )
    return write_fmu(layout, path, settings, platforms, content)


# ---- which inputs and outputs are shown ----------------------------------------------------------
def _with_inputs(plant: Plant, inputs: Sequence[str] | None) -> Plant:
    """The plant with these inputs only; the others become tunable parameters at their start values.

    Path constraints, which are not part of an FMU, are left out.
    Raises InputError, UnknownNameError for names that are no inputs.
    """
    chosen = chosen_signals("inputs", plant, inputs, ("input",))
    left_out = {v.name for v in plant.inputs} - set(chosen)
    if not left_out:
        return plant
    other, symbols = _begun(plant)
    for v in plant.inputs:
        if v.name in left_out:
            symbols[v.name] = _parameter(other, v, tunable=True)
        else:
            symbols[v.name] = other.input(v.name, **attributes_of(v))
    symbols |= {v.name: _parameter(other, v) for v in plant.parameters}
    _define(other, plant, symbols)
    return other


def with_shared(plant: Plant) -> tuple[Plant, frozenset[str]]:
    """The plant with one parameter (``muscle.a1``) where parts that are numbered (``muscle1.a1``,
    ``muscle2.a1``) have equal ones; those become outputs. Returns the names of these, too.
    """
    groups: dict[str, list[Variable]] = {}
    for v in plant.parameters:
        part, _, constant = v.name.rpartition(".")
        family = part.rstrip("0123456789")
        if family and family != part:
            groups.setdefault(f"{family}.{constant}", []).append(v)
    taken = {v.name for v in plant.variables}
    shared = {
        name: members
        for name, members in groups.items()
        if len(members) > 1
        and name not in taken
        and all(_like(m) == _like(members[0]) for m in members)
    }
    one = {m.name: name for name, members in shared.items() for m in members}
    if not one:
        return plant, frozenset()
    other, symbols = _begun(plant)
    symbols |= {v.name: other.input(v.name, **attributes_of(v)) for v in plant.inputs}
    for v in plant.parameters:
        name = one.get(v.name, v.name)
        if name not in symbols:
            part, family = v.name.rpartition(".")[0], name.rpartition(".")[0]
            words = v.description
            if name != v.name:
                words = words.replace(part, f"each {family}")
            symbols[name] = _parameter(other, v, name, description=words)
        symbols[v.name] = symbols[name]
    _define(other, plant, symbols)
    for v in plant.parameters:
        if v.name in one:
            about = attributes_of(v) | {"start": None, "widest": 0.0, "relaxed": 0.0}
            other.output(v.name, symbols[v.name], **about)
    return other, frozenset(one)


def _like(variable: Variable) -> Variable:
    """All but the name and what is said of it."""
    return replace(variable, name="x", description="")


def _begun(plant: Plant) -> tuple[Plant, dict[str, ca.SX]]:
    """Another plant of this name with these states, and their symbols."""
    other = Plant(plant.name, plant.description)
    return other, {v.name: other.state(v.name, **attributes_of(v)) for v in plant.states}


def _parameter(plant: Plant, variable: Variable, name: str = "", **changed: Any) -> ca.SX:
    about = attributes_of(variable) | changed
    del about["disturbance"]
    return plant.parameter(name or variable.name, about.pop("start"), **about)


def _define(other: Plant, plant: Plant, symbols: Mapping[str, ca.SX]) -> None:
    """The equations and outputs of ``plant`` in the symbols of another."""
    columns = [
        ca.vertcat(*(symbols[v.name] for v in group))
        for group in (plant.states, plant.inputs, plant.parameters)
    ]
    xdot, y, _ = plant.function(*columns)
    for i, v in enumerate(plant.states):
        other.der(symbols[v.name], xdot[i])
    for i, v in enumerate(plant.outputs):
        other.output(v.name, y[i], **{**attributes_of(v), "start": None})


def _shown_outputs(plant: Plant, outputs: Sequence[str] | None) -> frozenset[str] | None:
    """Names of the states and outputs that the FMU gives as outputs; None for all.

    Raises InputError, UnknownNameError for names that are neither, and for an empty list.
    """
    if outputs is None:
        return None
    chosen = chosen_signals("outputs", plant, outputs, ("state", "output"))
    if not chosen:
        raise InputError("outputs is empty; name at least one state or output")
    return frozenset(chosen)


def _check_reference(reference: Trajectory, plant: Plant) -> None:
    """Refuse a reference motion that plays what the FMU holds, or begins where it does not.

    Raises InputError.
    """
    for v in plant.states:
        start, first = v.start or 0.0, reference[v.name][0] if v.name in reference else None
        if first is not None and abs(first - start) > 1e-6 * v.nominal:
            raise InputError(
                f"reference: it begins at {v.name} = {v.shown(first)}, the FMU at "
                f"{v.shown(start)}; export plant.with_values({{...}}) with the states of its "
                "first row"
            )
    constants = {v.name: v.start for v in plant.parameters}
    for name in reference.named("input"):
        if name in constants and not np.all(reference[name] == constants[name]):
            raise InputError(
                f"reference: its input {name} is left out of the FMU, which holds it at "
                f"{plant.variable(name).shown(constants[name] or 0.0)}; name it in inputs"
            )
    known = [v for v in plant.states if v.name in reference]
    own = simulate(plant, reference, start={v.name: v.start or 0.0 for v in plant.states})
    for v in known:
        off = np.abs(own[v.name] - reference[v.name])
        if off.max() > ANOTHER * v.nominal:
            raise InputError(
                f"reference: at t = {reference.t[off.argmax()]:g} s its {v.name} is "
                f"{v.shown(reference[v.name][off.argmax()])}, this plant's "
                f"{v.shown(own[v.name][off.argmax()])} under the same inputs: it is a motion of "
                "another plant; simulate this one"
            )
