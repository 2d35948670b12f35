"""What a command says: text for people, or one JSON document; and where it wrote."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.files import spelled
from .words import command_words

__all__ = [
    "add_json",
    "coefficients",
    "escaping",
    "finish",
    "logged",
    "tell",
    "wrote",
]


def add_json(command: argparse.ArgumentParser) -> None:
    """--json, of every command that has something to tell."""
    command.add_argument(
        "--json", action="store_true", help="print one JSON document instead of text; SI"
    )


def tell(
    options: argparse.Namespace,
    text: object,
    data: Mapping[str, Any] | Callable[[], Any] | None = None,
) -> None:
    """Print ``text``, or keep ``data`` (or what it returns) for the JSON document."""
    if getattr(options, "json", False):
        said = data() if callable(data) else data
        if said is None:
            return
        if isinstance(said, Mapping):
            options.said = {**getattr(options, "said", {}), **said}
        else:
            options.said = said
    elif not options.quiet:
        print(command_words(str(text), options), flush=True)


@contextmanager
def escaping() -> Iterator[None]:
    """What the terminal's encoding lacks (LC_ALL=C, names that are no text) is printed escaped."""
    out: Any = sys.stdout
    if not hasattr(out, "reconfigure"):
        yield
        return
    before = out.errors
    out.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        ours = sys.stdout is out  # it may have been given up
        if ours:
            out.reconfigure(errors=before)


def wrote(options: argparse.Namespace, path: object) -> None:
    """A file was written."""
    if getattr(options, "json", False):
        said = getattr(options, "said", {})
        if isinstance(said, dict):
            said.setdefault("written", []).append(str(path))
            options.said = said
    elif not options.quiet:
        print(f"-> {spelled(str(path))}")


def finish(options: argparse.Namespace) -> None:
    """Print the JSON document, if there is one."""
    if getattr(options, "json", False) and hasattr(options, "said"):
        encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
        ascii_only = "utf" not in encoding.lower()
        print(json.dumps(plain(options.said), ensure_ascii=ascii_only))


def plain(value: Any) -> Any:
    """As JSON has it: no NaN, no infinity, no arrays."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str | int | bool) or value is None:
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Sequence):
        return [plain(v) for v in value]
    return str(value)


def coefficients(fit: Any) -> dict[str, Any]:
    """Of any fit: {name: value, standard error, interval, unit}."""
    intervals = fit.intervals()
    return {
        n: {
            "value": c.value,
            "stderr": c.stderr,
            "interval": list(intervals.get(n, (c.value, c.value))),
            "unit": c.unit,
        }
        for n, c in fit.coefficients.items()
    }


@contextmanager
def logged(level: int) -> Iterator[None]:
    """For this block, the loggers ``pam_ocp.*`` print to the error stream: 1 info, 2 all."""
    if not level:
        yield
        return
    import logging

    logger = logging.getLogger(__package__.partition(".")[0])
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(name)s: %(message)s"))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO if level == 1 else logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
