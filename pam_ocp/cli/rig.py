"""``pam-ocp rig`` and ``twin``: rigs on benches, and twins of them; ``bench``: the page."""

from __future__ import annotations

import argparse
import getpass
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pam_ocp as pam

from ..core.errors import InputError
from ..core.files import read_toml
from ..core.quantities import known_keys, quantity
from .command import (
    OneOf,
    choice,
    command,
    count,
    file,
    flag,
    named,
    number,
    option,
    output,
    pairs,
    repeated,
    several,
)
from .options import ALLOW_CODE, PLANT, PLANT_VALUES, plant_named, written
from .output import tell, wrote

if TYPE_CHECKING:
    from ..rig.rig import Rig

RIG = """\
  pam-ocp rig check bench.toml                     # read for a second; nothing moves
  pam-ocp rig home bench.toml --arm                # zeros, range, slack, leaks
  pam-ocp rig identify bench.toml --free mass damping --arm
  pam-ocp rig run bench.toml --motion plan.npz --out run.npz --arm
  pam-ocp rig vent bench.toml                      # vent at any time

A rig's file (docs/rig.md) has tables [driver], [readings], [commands], [guard] and [plant].
Nothing moves without --arm: make sure that nobody is near. No software makes a rig safe; an
emergency stop is hardware. Exit code: 0 success, 1 vented by the guard, or a check failed, 2 bad
input.
"""
TWIN = """\
  pam-ocp twin plant.toml --modbus 5020 --scale 1.2 --noise x='10 um'
  pam-ocp twin bench.toml --serial --faults faults.toml

PLANT may be a rig's file: then its channels are served. A file of faults has tables
[[fault]] with kind, channel, value, at, until; and, besides, [plant] with what differs from the
plant's file (such as losses), and [sensors.NAME] with noise, delay, resolution, bias, ...
"""


@command(
    "rig",
    "check, home, identify, run or vent a real rig",
    choice("what", ("check", "home", "identify", "run", "vent")),
    option("file", "FILE.toml", "the rig"),
    flag("--arm", "allow motion (home, identify, run)"),
    option("--level", "P", "home: highest commands, such as '3 bar'"),
    several("--free", "NAME", "identify: parameters", default=[]),
    count("--rounds", "N", "identify: largest number of rounds", default=3),
    option("--duration", "S", "of an excitation, a check, or a run"),
    file("--motion", "FILE", "run: a trajectory or plan with the inputs"),
    output("--out", "FILE", "run, identify: file for the record or the fit"),
    ALLOW_CODE,
    about="Work with a rig (or its twin) that a file describes.",
    epilog=RIG,
)
def _rig(options: argparse.Namespace) -> int:
    moves = options.what in ("home", "identify", "run")
    if moves and not options.arm:
        raise InputError(
            f"rig {options.what} moves the rig: look that nobody is near, and give --arm"
        )
    if options.what == "run" and options.motion is None:
        raise InputError("rig run: give --motion FILE, a plan or a trajectory with the inputs")
    if options.what == "identify" and not options.free:
        raise InputError("rig identify: give --free NAME ..., the parameters to fit")
    work = {"check": _check, "home": _home, "identify": _identify, "run": _play, "vent": _vent}
    try:
        with pam.rig.load_rig(options.file, allow_code=options.allow_code) as rig:
            if moves:
                rig.arm()
            return work[options.what](rig, options)
    except pam.rig.RigError as error:
        tell(options, f"vented, or not begun: {error}", {"vented": str(error)})
        return 1


def _seconds(options: argparse.Namespace, usual: float) -> float:
    return usual if options.duration is None else quantity("--duration", options.duration, "s")


def _check(rig: Rig, options: argparse.Namespace) -> int:
    seen = rig.check(_seconds(options, 1.0))
    clock = seen.pop("time")
    rows = [f"{'reading':<24}{'mean':>14}{'deviation':>12}{'lowest':>14}{'highest':>14}"]
    for name, v in seen.items():
        its = rig.readings[name].variable(rig.plant)
        shown = [its.shown(v[k]) for k in ("mean", "deviation", "lowest", "highest")]
        rows.append(f"{name:<24}{shown[0]:>14}{shown[1]:>12}{shown[2]:>14}{shown[3]:>14}")
    rows.append(
        f"{clock['rate']:.4g} answers per second, {clock['missing']:g} stayed out, the oldest was "
        f"{1e3 * clock['oldest']:.3g} ms old"
    )
    tell(options, "\n".join(rows), {"readings": seen, "answers": clock})
    return 1 if clock["missing"] else 0


def _home(rig: Rig, options: argparse.Namespace) -> int:
    found = rig.home(level=options.level)
    tell(
        options,
        found.report(),
        lambda: {
            n: getattr(found, n)
            for n in ("noise", "zeros", "rest", "ranges", "slack", "hysteresis", "leak", "doubts")
        },
    )
    return 0 if found.ok else 1


def _identify(rig: Rig, options: argparse.Namespace) -> int:
    found = rig.identify(options.free, duration=_seconds(options, 4.0), rounds=options.rounds)
    tell(options, found.report(), lambda: {"values": found.fit.values, "ended": found.ended})
    if options.out:
        wrote(options, found.fit.save(options.out))
    return 0 if found.adequate else 1


def _play(rig: Rig, options: argparse.Namespace) -> int:
    run = rig.run(pam.Trajectory.load(options.motion))
    last = {v.name: float(run[v.name][-1]) for v in run.variables}
    lines = [f"{n:<24}{run.variable(n).shown(v)}" for n, v in last.items()]
    tell(options, "\n".join([f"{run.duration:g} s, vented; at the end:", *lines]), {"last": last})
    if options.out:
        wrote(options, written(run, options.out))
    return 0


def _vent(rig: Rig, options: argparse.Namespace) -> int:
    done = rig.vent("asked for")
    words = "vented" if done else "the rig does not answer: use the emergency stop"
    tell(options, words, {"vented": done})
    return 0 if done else 1


# ---- twins ---------------------------------------------------------------------------------------
@command(
    "twin",
    "simulate a rig in real time, behind a transport",
    option("plant", "PLANT", PLANT),
    *PLANT_VALUES,
    OneOf(
        (
            *(count(f"--{k}", "PORT", "0: any that is free") for k in ("modbus", "udp", "opcua")),
            flag("--serial", "a pseudo-terminal (not on Windows)"),
        )
    ),
    option("--host", "HOST", default="127.0.0.1"),
    option("--scale", "R", "of the muscles' forces", type=number, default=1.0),
    named("--noise", "of a reading"),
    option("--delay", "S", "of commands, such as '5 ms'", default="0 s"),
    option("--timeout", "S", "vent after this time without a command"),
    file("--faults", "FILE.toml"),
    option("--duration", "S", "duration (default: until Ctrl-C)"),
    about="Serve a plant in real time behind Modbus TCP, a serial line (a "
    "pseudo-terminal), UDP or OPC UA, with noise, delay and faults, until Ctrl-C.",
    epilog=TWIN,
)
def _twin(options: argparse.Namespace) -> int:
    given = _faults(options.faults)
    plant, channels = _plant(options, given.pop("plant", {}))
    twin = pam.rig.Twin(
        plant,
        *channels,
        scale=options.scale,
        delay=quantity("--delay", options.delay, "s"),
        timeout=None if options.timeout is None else quantity("--timeout", options.timeout, "s"),
        faults=given.pop("fault", []),
        sensors=_sensors(options, given.pop("sensors", {})),
    )
    kind = next(
        (k for k in ("modbus", "udp", "opcua") if getattr(options, k) is not None), "serial"
    )
    port = getattr(options, kind) if kind != "serial" else 0
    with pam.rig.serve(twin, kind, port=port, host=options.host) as served:
        inside = ", ".join(f"{n} = {json.dumps(v)}" for n, v in served.address.items())
        tell(options, f"driver = {{ {inside} }}", {"driver": served.address})
        if getattr(options, "json", False):
            print(json.dumps(served.address), flush=True)
            del options.said
        span = None if options.duration is None else quantity("--duration", options.duration, "s")
        served.wait(span)
    return 0


def _faults(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    content = read_toml(path)
    known_keys(str(path), content, ("fault", "plant", "sensors"))
    return dict(content)


def _plant(options: argparse.Namespace, changes: dict[str, Any]) -> tuple[Any, tuple[Any, Any]]:
    """(plant, (readings, commands)) of a name, a plant's file or a rig's file."""
    from ..plants.plant_file import plant_of

    content = read_toml(options.plant) if options.plant.endswith(".toml") else {}
    said, path = content.get("plant"), Path(options.plant)
    if isinstance(said, str):
        said = read_toml(path.parent / said).get("plant")
    if isinstance(said, dict):
        plant = plant_of({**said, **changes}, "plant", path.parent, allow_code=options.allow_code)
    elif changes:
        raise InputError("--faults: its [plant] changes a plant's file; give PLANT as FILE.toml")
    else:
        plant = plant_named(options.plant, options.muscle, options.allow_code)
    plant = plant.with_values(pairs("--set", options.set))
    return plant, (content.get("readings"), content.get("commands"))


def _sensors(options: argparse.Namespace, given: Any) -> dict[str, Any]:
    from ..studies.problem import sensors_of

    found = sensors_of(given)
    for name, noise in pairs("--noise", options.noise).items():
        found[name] = replace(found.get(name, pam.simulation.Instrument()), noise=noise)
    return found


# ---- the page ------------------------------------------------------------------------------------
PASSWORD = "PAM_OCP_BENCH_PASSWORD"


@command(
    "bench",
    "the whole chain on a page in the browser",
    option("--host", None, "to listen at (default: 127.0.0.1)", default="127.0.0.1"),
    count("--port", None, "default: a free one", default=0),
    repeated(
        "--name",
        "HOST",
        "further name by which browsers may ask for the page (may be repeated)",
        default=[],
    ),
    file("--folder", "DIR", "of the sessions (default: the user's own)"),
    file("--rig", "FILE.toml", "a rig's file, for the tab Rig (docs/rig.md)"),
    flag("--no-browser", "only print the address"),
    ALLOW_CODE,
    about="Open an interactive page on this machine: data, muscle, plant, motion, "
    "control and export. Needs pip install 'pam_ocp[bench]'.",
    epilog=f"Another host than this machine needs a password: in {PASSWORD}, or asked for.",
    json=False,
)
def _bench(options: argparse.Namespace) -> int:
    from ..bench.server import require_framework, serve

    require_framework()
    password = os.environ.pop(PASSWORD, None)  # the processes that it starts need not know it
    if password is None and options.host not in ("127.0.0.1", "localhost") and sys.stdin.isatty():
        password = getpass.getpass("password for the page: ")
    serve(
        host=options.host,
        port=options.port,
        password=password,
        names=options.name,
        folder=options.folder,
        allow_code=options.allow_code,
        browser=not options.no_browser,
        rig=options.rig,
        say=lambda text: print(text, flush=True),
    )
    return 0
