"""The page and the icon that go into an FMU."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Container, Iterable, Sequence
from importlib import resources

import casadi as ca
import numpy as np

from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.plant import Plant
from .layout import Layout


def equations(plant: Plant) -> list[tuple[str, str]]:
    """(left side, right side) of every equation as text; shared parts first, named w0, w1, ..."""
    names = [f"der({v.name})" for v in plant.states] + [v.name for v in plant.outputs]
    sides, symbols, parts = ca.shared([plant.expression(n) for n in names], "w", "")
    found = [(_text(s), _text(e)) for s, e in _ordered(list(zip(symbols, parts, strict=True)))]
    return found + [(n, _text(e)) for n, e in zip(names, sides, strict=True)]


def _ordered(parts: list[tuple[ca.SX, ca.SX]]) -> list[tuple[ca.SX, ca.SX]]:
    """Parts so that each one stands behind those it uses."""
    waiting = {symbol.name(): (symbol, part) for symbol, part in parts}
    needs = {n: {s.name() for s in ca.symvar(p)} & waiting.keys() for n, (_, p) in waiting.items()}
    ordered: list[tuple[ca.SX, ca.SX]] = []
    while waiting:
        ready = [n for n in waiting if not needs[n] & waiting.keys()]
        ordered += [waiting.pop(n) for n in ready]
    return ordered


def _text(expression: ca.SX) -> str:
    """An expression in one line, CasADi's abbreviations (@1=6, ...) written out."""
    text = str(expression)
    numbers = {}
    while match := re.match(r"(@\d+)=(.*?), (?=@\d+=|[^,]*$|.)", text):
        numbers[match[1]] = match[2]
        text = text[match.end() :]
    for _ in numbers:
        text = re.sub(r"@\d+", lambda m: numbers.get(m[0], m[0]), text)
    if text.startswith("(") and text.endswith(")") and _closes_last(text):
        text = text[1:-1]
    return text


def _closes_last(text: str) -> bool:
    """Whether the first bracket is closed by the last one."""
    depth = 0
    for position, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return position == len(text) - 1
    return False


_STYLE = (
    "body{font-family:sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:.2em .6em;text-align:left}"
    "pre{white-space:pre-wrap;overflow-wrap:anywhere;background:#f4f4f4;padding:.5em}"
)


def _range(variable: Variable) -> str:
    low, high = (
        variable.exactly(bound) if math.isfinite(bound) else ""
        for bound in (variable.min, variable.max)
    )
    return f"{low} .. {high}" if low or high else ""


def _table(title: str, variables: Iterable[Variable]) -> str:
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td>{html.escape(cell)}</td>"
            for cell in (
                v.name,
                "" if v.start is None else v.exactly(v.start),
                v.unit,
                _range(v),
                "tunable" if v.tunable else "",
                v.description,
            )
        )
        + "</tr>\n"
        for v in variables
    )
    if not rows:
        return ""
    head = "".join(f"<th>{h}</th>" for h in ("name", "start", "SI unit", "range", "", "meaning"))
    return f"<h2>{title}</h2>\n<table><tr>{head}</tr>\n{rows}</table>\n"


def page(
    layout: Layout,
    notes: Sequence[str],
    lines: Sequence[tuple[str, str]],
    with_reference: bool = False,
) -> str:
    """documentation/index.html: what the model is, its variables, parameters and equations.

    lines : the equations, left and right sides.
    """
    picture = (
        "<h2>Reference motion</h2>\n<p>Its numbers stand beside this page in two tables, inputs "
        '(..._in.csv) and results (..._ref.csv).</p>\n<img src="reference.png" alt="time series">\n'
    )
    results = [*layout.of("state"), *layout.of("output")]
    shown, local = (
        [e.variable for e in results if e.is_output is wanted] for wanted in (True, False)
    )
    text = "\n".join(f"{left} = {right}" for left, right in lines)
    tables = "".join(
        _table(title, variables)
        for title, variables in (
            ("Inputs", layout.variables("input")),
            ("Outputs (those with a start value are states)", shown),
            ("Local variables", local),
            ("Parameters", layout.variables("parameter")),
        )
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(layout.name)}</title><style>{_STYLE}</style></head><body>\n"
        f"<h1>{html.escape(layout.name)}</h1>\n<p>{html.escape(layout.description)}</p>\n"
        + "".join(f"<p>{html.escape(note)}</p>\n" for note in notes)
        + tables
        + "<h2>Equations</h2>\n<p>SI units; w0, w1, ... are parts used more than once; "
        "(condition ? a : 0) is a where the condition holds, else 0; sq(a) is a squared.</p>\n"
        f"<pre>{html.escape(text)}</pre>\n{picture if with_reference else ''}</body></html>\n"
    )


# ---- reference motion --------------------------------------------------------------------------


def reference_table(motion: Trajectory, shown: Container[str]) -> str:
    """Those columns of a motion that are shown."""
    names = [v.name for v in motion.variables if v.name in shown]
    return table(names, np.column_stack([motion.t, motion.array(names)]))


def table(names: Iterable[str], rows: Iterable[Iterable[float]]) -> str:
    """Columns behind the time [SI], in the CSV format of FMI's reference results."""
    header = ",".join(f'"{name}"' for name in ("time", *names))
    lines = (",".join(repr(float(c)) for c in row) for row in rows)
    return "\n".join([header, *lines, ""])


def picture(motion: Trajectory) -> bytes:
    """A motion over time, as PNG."""
    buffer = io.BytesIO()
    motion.plot().savefig(buffer, format="png", dpi=80, metadata={"Software": None})
    return buffer.getvalue()


# ---- icon: a muscle between two ends -----------------------------------------------------------


def icon_svg() -> str:
    """The icon as SVG, 100 x 100: a braided muscle between its fittings."""
    braid = "".join(
        f'<path d="M{x} 62 Q{x + 9} 50 {x + 18} 38 M{x} 38 Q{x + 9} 50 {x + 18} 62"/>'
        for x in range(23, 60, 12)
    )
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 100">'
        '<rect x="1" y="1" width="98" height="98" rx="6" '
        'fill="#fff" stroke="#345" stroke-width="2"/>'
        '<path d="M2 50H98" stroke="#345" stroke-width="4"/>'
        '<path d="M18 40Q50 26 82 40V60Q50 74 18 60Z" fill="#7ab" stroke="#345" stroke-width="2"/>'
        f'<g fill="none" stroke="#345" stroke-width="1.2">{braid}</g>'
        '<path d="M12 38h8v24h-8zM80 38h8v24h-8z" fill="#345"/></svg>\n'
    )


def stored(name: str) -> bytes:
    """A picture as PNG: the same drawing (icon.png, 100 x 100 pixels), a disc for terminals
    (signal.png, 32 x 32); files, so that an export needs no matplotlib.
    """
    return (resources.files("pam_ocp.export") / "icons" / name).read_bytes()
