"""Options of commands that read files of rigs, and the command ``pam-ocp look``."""

from __future__ import annotations

import argparse
import ast
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from .options import add_rest_length, number, pairs, whole
from .output import add_json, tell

if TYPE_CHECKING:
    from ..studies.file_kinds import FileKind

EPILOG = """\
  pam-ocp look rig.csv --rest-length "300 mm"
  pam-ocp look rig.txt --columns "length [mm]" "pressure [bar]" "force [N]"
  pam-ocp look rig.xlsx --sheet M3 --columns pressure=ch1 --units "pressure=V * 2 bar/V - 0.3 bar"
  pam-ocp look run7.csv --clock cut

Nothing is fitted. Exit code: 0 if the file can be read, 1 if information is missing (it is
printed), 2 for an invalid file or option.
"""


def add_reading(command: argparse.ArgumentParser) -> None:
    """Options that say how a file is to be read, where it does not say it itself."""
    command.add_argument(
        "--columns",
        nargs="+",
        metavar="NAME",
        help="QUANTITY=HEADER where the header does not say it; or the names of all columns from "
        "the left, with units, where the file has none ('-' leaves one out)",
    )
    command.add_argument(
        "--units",
        nargs="+",
        metavar="QUANTITY=UNIT",
        help="unit, 'bar abs', or a calibration such as 'pressure=V * 2 bar/V - 0.3 bar'",
    )
    command.add_argument(
        "--ambient-pressure",
        metavar="P",
        help="subtracted from absolute pressures (default: 1.01325 bar)",
    )
    command.add_argument("--sheet", metavar="NAME", help="of a workbook: its name or number")
    command.add_argument(
        "--pick",
        nargs="+",
        metavar="NAME",
        help="table within nested data, as run.data; several with different clocks are "
        "resampled to one",
    )
    command.add_argument(
        "--constants",
        nargs="+",
        metavar="NAME=VALUE",
        help="constant that the file lacks, as 'contraction=5 %%'",
    )
    command.add_argument(
        "--pattern",
        metavar="NAME",
        help="form of the file's name, with headers in braces: '{muscle}_{contraction [%%]}.csv'",
    )
    command.add_argument(
        "--bad-lines", choices=("refuse", "drop"), help="stray and cut lines (default: refuse)"
    )
    command.add_argument("--encoding", metavar="NAME", help="of a text, as cp1252")
    command.add_argument(
        "--skip", type=whole, metavar="N", help="lines at the beginning to leave out"
    )
    command.add_argument("--delimiter", metavar="C", help="between cells, if detected wrongly")
    command.add_argument(
        "--missing",
        nargs="*",
        metavar="VALUE",
        help="what marks a missing value (default: 9999, -999, 1e30 and their like where they "
        "stand apart); without a VALUE: nothing does",
    )
    command.add_argument("--decimal", choices=(".", ","), help="if detected wrongly")
    command.add_argument(
        "--pivot",
        nargs="+",
        metavar="HEADER",
        help="quantities down, across, and in the cells of a pivot",
    )


def add_floor(command: argparse.ArgumentParser) -> None:
    """What slack cells of a force table read."""
    command.add_argument(
        "--floor",
        metavar="F",
        help="reading up to which a muscle is slack, as '5 N'; found (default): "
        "detected; zero: detected, and subtracted from all forces as the offset "
        "of the load cell; none: any positive force is taut",
    )


def reading_options(options: argparse.Namespace) -> dict[str, Any]:
    """What the options say, as arguments of read_table and read_record. Raises InputError."""
    found: dict[str, Any] = {}
    if options.columns:
        named = [text.partition("=") for text in options.columns]
        if all(equals for _, equals, _ in named):
            found["columns"] = {name.strip(): header for name, _, header in named}
        elif any(equals for _, equals, _ in named):
            raise InputError(
                "--columns: give QUANTITY=HEADER for each, or the names of all columns"
            )
        else:
            found["columns"] = [None if text == "-" else text for text in options.columns]
    if options.units:
        found["units"] = pairs("--units", options.units)
    plain = ("ambient_pressure", "skip", "delimiter", "decimal", "pattern", "bad_lines", "encoding")
    for name in plain:
        if getattr(options, name) is not None:
            found[name] = getattr(options, name)
    if options.pick:
        found["pick"] = options.pick[0] if len(options.pick) == 1 else options.pick
    if options.constants:
        given = pairs("--constants", options.constants)
        found["constants"] = {name: _number(value) for name, value in given.items()}
    if options.missing is not None:
        found["missing"] = [_number(text) for text in options.missing] or None
    if options.sheet is not None:
        found["sheet"] = int(options.sheet) if options.sheet.isdigit() else options.sheet
    if getattr(options, "floor", None) is not None:
        found["floor"] = options.floor
    if options.pivot:
        found["pivot"] = tuple(options.pivot)
    return found


def add_look(commands: Any) -> None:
    """Add the command to the parser's commands."""
    look = commands.add_parser(
        "look",
        help="show how measured files are interpreted, before fitting",
        description="Print how files are interpreted, column by column: names, units, ranges, "
        "empty cells, the clock, ramps, warnings, and the call that reads them.",
        epilog=EPILOG,
    )
    look.add_argument("files", nargs="+", metavar="FILE", help="files, folders or patterns")
    add_reading(look)
    add_floor(look)
    add_rest_length(look)
    look.add_argument("--kind", choices=("table", "record"), help="if taken for the other")
    look.add_argument("--time", metavar="HEADER", help="column of the time of a record")
    look.add_argument(
        "--clock", choices=("mend", "cut", "refuse"), help="of a record (default: mend)"
    )
    look.add_argument("--max-gap", type=number, metavar="S", help="longest step that is not a gap")
    look.add_argument("--sample-time", metavar="S", help="resample a record, or 'even'")
    add_json(look)
    look.set_defaults(run=_look)


def _look(options: argparse.Namespace) -> int:
    from ..fitting.tables.preview import Previews, look
    from ..studies.file_kinds import kind_of

    if len(options.files) == 1 and Path(options.files[0]).is_file():
        kind = kind_of(options.files[0])
        if "table" not in kind.roles:
            return _look_at_ours(options, kind)
    said = reading_options(options)
    for name in ("rest_length", "kind", "time", "clock", "max_gap", "sample_time"):
        value = getattr(options, name)
        if value is not None:
            said[name] = _number(value)
    source = options.files[0] if len(options.files) == 1 else options.files
    seen = look(source, **said)
    views = seen if isinstance(seen, Previews) else [seen]
    tell(options, seen, lambda: [view.to_dict() for view in views])
    return 0 if seen.ok else 1


def _look_at_ours(options: argparse.Namespace, kind: FileKind) -> int:
    """A file that a command wrote: what it is and holds, and who takes it."""
    path = Path(options.files[0])
    held = "" if kind.read is None else str(kind.read(path))
    words = f"{path} is {kind.words}, taken {kind.use}"
    tell(options, f"{words}\n{held}".rstrip(), {"kind": kind.words, "use": kind.use, "is": held})
    return 0


def _number(value: Any) -> Any:
    """A number where it is one; "300 mm" stays."""
    try:
        return ast.literal_eval(value) if isinstance(value, str) else value
    except (ValueError, SyntaxError):
        return value
