"""The commands ``pam-ocp components`` (what there is to build with, read from the registries) and
``completion`` (by a shell).
"""

from __future__ import annotations

import argparse
import inspect
from dataclasses import fields, is_dataclass
from typing import Any

from ..core.registry import Argument, Registry
from .command import choice, command, flag, option
from .output import tell


@command(
    "components",
    "list the components of plants and problems",
    option("noun", "NOUN", "only these, such as 'load'", nargs="?"),
    flag("--markdown", "as the page docs/components.md"),
    about="Plants, loads, feeds, losses, laws, costs, solvers, ...: their names as "
    "problem files take them, with arguments, units and defaults.",
)
def _components(options: argparse.Namespace) -> int:
    from ..core.errors import UnknownNameError

    if options.markdown:
        tell(options, page().rstrip("\n"))
        return 0
    nouns = [_plain(registry.noun) for registry, _ in groups()]
    if options.noun not in (None, *nouns):
        raise UnknownNameError("kind of component", options.noun, nouns)
    for registry, _ in groups():
        if options.noun in (None, _plain(registry.noun)):
            lines = [registry.noun]
            for name in registry:
                lines.append(f"  {name}: {registry.words(name)}")
                lines += [f"    {argument}" for argument in _arguments(registry, name)]
            known = {n: _arguments(registry, n) for n in registry}
            tell(options, "\n".join(lines), {registry.noun: known})
    return 0


def _plain(noun: str) -> str:
    return noun.replace(" ", "-").lower()


def groups() -> tuple[tuple[Registry[Any], str], ...]:
    """(registry, where its names are given), in the order of the page."""
    from ..control.kinds import BLOCKS, CONTROLLERS, ESTIMATORS
    from ..control.mpc.sqp import QP_SOLVERS
    from ..export.worlds.registry import WORLDS
    from ..judge.statement import COSTS
    from ..muscles.gas import GASES, HEATS, RUBBERS, VOLUMES
    from ..muscles.law import LAWS
    from ..planning.solvers.solver import SOLVERS
    from ..plants.kinds import (
        DAMPINGS,
        DEAD_TIMES,
        FEEDS,
        LOADS,
        LOSSES,
        PLANTS,
        QUICK_EXHAUSTS,
        SENSORS,
        SOURCES,
        SPOOLS,
        SUPPLIES,
        TUBES,
    )
    from ..rig.drivers.driver import DRIVERS
    from ..studies.steps.step import STEPS

    return (
        (PLANTS, "`arrangement` of a `[plant]`, or named on the command line"),
        (LOADS, "of plants: `loads = [{ kind = ... }]`"),
        (FEEDS, "of plants: `feed = { kind = ... }`"),
        (LOSSES, "of plants: `losses = [{ kind = ... }]`"),
        (DAMPINGS, "of plants: `damping = { kind = ... }`"),
        (DEAD_TIMES, "of regulators: `dead_time = { ... }`, or its time alone"),
        (SENSORS, "of a state or output of a plant: `sensors = { x = { ... } }`"),
        (TUBES, "of valves: `tube = { ... }`"),
        (SPOOLS, "of a spool valve: `spool = { kind = ... }`"),
        (SUPPLIES, "of valves, in place of a constant pressure: `supply = { ... }`"),
        (SOURCES, "of a receiver: `source = { kind = ... }`"),
        (QUICK_EXHAUSTS, "of valves with a tube: `quick_exhaust = { ... }`"),
        (GASES, "of valves: `gas = { ... }`"),
        (HEATS, "of a gas: `heat = { kind = ... }`"),
        (RUBBERS, "of a gas with heat: `rubber = { ... }`"),
        (VOLUMES, "of a gas: `volume = { kind = ... }`"),
        (LAWS, "`law` of a muscle file, of `fit_force` and `pam-ocp fit`"),
        (COSTS, "terms of `minimise` and `budgets`"),
        (SOLVERS, "`solver` of a plan"),
        (CONTROLLERS, "`kind` of a `[controller]` of `pam-ocp mpc`"),
        (ESTIMATORS, "`kind` of an `[estimator]` of `pam-ocp mpc`"),
        (BLOCKS, "what `pam.control.block` makes of, by class"),
        (QP_SOLVERS, "`solver` of a `[controller]`, besides ipopt"),
        (DRIVERS, "of a rig's file: `driver = { kind = ... }`; `pam.rig.driver`"),
        (WORLDS, "`world` of `pam.export`, where a file's ending does not tell it"),
        (STEPS, "`kind` of a `[steps.NAME]` of a study; its keys"),
    )


def page() -> str:
    """docs/components.md."""
    lines = [
        "# Components",
        "",
        "What plants, muscles and problems can be built of, by the names that problem files take.",
        "Arguments stand with their SI units and defaults; in files a text with a unit will do,",
        'such as `"40 ms"`. This page is what `pam-ocp components --markdown` reads from what',
        "registers itself; CONTRIBUTING.md says how to add to it.",
        "",
    ]
    for registry, where in groups():
        lines += [f"## {registry.noun}", "", f"{where[0].upper()}{where[1:]}.", ""]
        lines += ["| name | what it is | arguments |", "|---|---|---|"]
        for name in registry:
            arguments = ", ".join(f"`{a}`" for a in _arguments(registry, name))
            lines.append(f"| `{name}` | {_cell(registry.words(name))} | {_cell(arguments)} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("``", "`")


def _arguments(registry: Registry[Any], name: str) -> list[str]:
    """As "mass = 2 [kg]"; of costs the unit of their integral, of laws the coefficients."""
    made = registry[name]
    if hasattr(made, "coefficient_variables"):
        return [f"{v.name} [{v.unit}]" for v in made.coefficient_variables()]
    if hasattr(made, "offers"):
        return list(dict.fromkeys((*made.needs, *made.parts, *made.keys)))
    if hasattr(made, "total"):
        return [f"[{made.total.unit}]"]
    passed = ("muscle", "plant", "program", "self")
    return [
        _shown(made, a)
        for a in registry.arguments(name).values()
        if a.name not in passed and not (a.name == "name" and registry.noun == "plant")
    ]


def _shown(made: Any, argument: Argument) -> str:
    default = argument.default
    if is_dataclass(made):  # of what is made anew each time
        factories: dict[str, Any] = {f.name: f.default_factory for f in fields(made)}
        own = factories.get(argument.name)
        if callable(own):
            default = own()
    text = argument.name
    if default is not inspect.Parameter.empty:
        shown = f"{default:.4g}" if isinstance(default, float) else repr(default)
        text += f" = {shown if len(shown) <= 40 else type(default).__name__ + '(...)'}"
    units = [u for u in argument.units if u != "1"]
    return f"{text} [{' or '.join(units)}]" if units else text


# ---- completion by tab ---------------------------------------------------------------------------
SHELLS = ("bash", "zsh", "tcsh")
EPILOG = """\
  pam-ocp completion bash > ~/.local/share/bash-completion/completions/pam-ocp
  pam-ocp completion zsh > ~/.zfunc/_pam-ocp          # a folder of $fpath
  pam-ocp completion tcsh >> ~/.tcshrc
"""


@command(
    "completion",
    "print a script by which a shell completes commands and options",
    choice("shell", SHELLS),
    about="Print a completion script for a shell.",
    epilog=EPILOG,
    json=False,
)
def _completion(options: argparse.Namespace) -> int:
    import shtab

    print(shtab.complete(_with_files(options.parser), options.shell))
    return 0


def _with_files(made: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Arguments that are files complete as files."""
    import shtab

    for action in made._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in dict.fromkeys(action.choices.values()):
                _with_files(command)
        elif action.nargs != 0 and not action.choices:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    return made
