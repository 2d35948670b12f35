"""Messages of the library in the words of the page: its fields, and files as users named them.

What the library says names arguments of Python, and the files of a session's folder. Here alone
they are translated; a new remedy of the library that the page offers, too, gets a line in REMEDIES.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from .session import DIGITS

ASKED = {
    "sheet": "Sheet",
    "pick": "Table or topic",
    "decimal": "Decimal sign",
    "delimiter": "Between cells",
    "bad_lines": "Damaged lines",
}
"""Options of readers whose field the tab Data shows where a message asks for one of them."""
FLOORS = {"'zero'": "the zero of the load cell", "None": "a force"}


def page_words(text: str, folder: Path, names: Mapping[str, str]) -> str:
    """A message as the page says it.

    folder : of the session, which is nobody's business. names : {stored file: as it was dropped}.
    """
    text = re.sub(rf"{re.escape(str(folder))}[/\\]|(?<![\w.])/(?:[\w.+-]+/)+", "", text)
    stored = rf"(?:files/)?(?<![\w.])([0-9a-f]{{{DIGITS}}}-([\w.-]*\w))"
    text = re.sub(stored, lambda found: names.get(found[1], found[2]), text)
    for pattern, words in REMEDIES:
        text = re.sub(pattern, words, text)
    return text


def _units(found: re.Match[str]) -> str:
    """``units={'pressure': 'bar', 'force': ...}``; the page's menus hold units, no calibrations."""
    pairs = re.findall(r"'([^']*)': ('[^']*'|\.\.\.)", found[2])
    if any(" " in unit.removesuffix(" abs'") for _, unit in pairs):
        return f"{found[1]} (in a script) units={{{found[2]}}}"
    said = [f"{'' if u == '...' else f'{u} as '}the unit of {q!r} in Columns" for q, u in pairs]
    return f"{_verb(found[1])} {' and '.join(said)}"


def _columns(found: re.Match[str]) -> str:
    """``columns={'pressure': 'p1'}``."""
    pairs = re.findall(r"'([^']*)': ('[^']*'|\.\.\.)", found[2])
    quantity, header = pairs[0] if pairs else ("", "...")
    column = "its column" if header == "..." else f"the column {header}"
    what = f"{quantity!r} " if quantity else ""
    return f"{_verb(found[1])} {what}in the menu 'is' of {column}"


def _constants(found: re.Match[str]) -> str:
    """``fixed={'radius': ...}``, or ``fixed=...``."""
    names = re.findall(r"'(\w+)':", found[1] or "")
    return f"{', '.join(names)} in the fields Known constants".removeprefix(" in ")


def _verb(said: str) -> str:
    """ "give" and "say" are choices of a menu."""
    return {"give": "choose", "say": "choose", "Say": "Choose"}.get(said, said)


REMEDIES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"give rest_length in metres, as in read_table\(.*?\)", "fill in the field Rest length"),
    (r"(?<![.\w])rest_length\b( \(in metres\))?", "Rest length"),
    (r"give Muscle\(\.\.\., diameter=\) .*?\[m\]", "fill in Inner diameter at rest (tab Muscle)"),
    (r"(\S+) units=\{([^{}]*)\}", _units),
    (r"units\[('\w+')\] = ('[^']*') is", r"the unit of \1 in Columns, \2, is"),
    (r"units\[('\w+')\] = ", r"the unit of \1 in Columns is "),
    (r"leave units away", "choose that unit in Columns"),
    (r"with columns=\{\.\.\.\}", "in the menu 'is' of a column"),
    (r"(\S+) columns=\{([^{}]*)\}", _columns),
    (r", as columns=(\[.*?\])", r", in a line above them: \1"),
    (r"(?:give|say) missing=\[\.\.\.\]", "name it under Missing values"),
    (r"give missing=\[(.*?)\]", r"name \1 under Missing values"),
    (r"missing=\[\.\.\.\] says", "the field Missing values names"),
    (r"clock='cut'( \(read_records then .*?split=\.\.\.\))?", "'cut at gaps' in the menu Clock"),
    (r"leave ramp= away", "choose 'find out' in the menu Rows are"),
    (
        r"\b(give )?floor=('zero'|None)",
        lambda m: f"{'choose ' * bool(m[1])}'{FLOORS[m[2]]}' in the menu Slack cells read",
    ),
    (r"or give platforms='native'", "or choose 'this machine' in the menu Runs on"),
    (r"\bfixed=(?:\.\.\.|\{([^{}]*)\})", _constants),
    (r"try another method=.*?options=\{[^{}]*\}", "try another Mesh, other times or other stops"),
    (r"as in method=\w+\(intervals=\d+\)", "in the menu Mesh"),
    (r"give duration=0.5, say, or minimise=\{[^{}]*\}", "give legs a time, or weigh time, too"),
    (r"\b(?:give|use) cyclic=True", "tick Returns"),
    (r"leave out rest=False", "tick At rest"),
    (r"give rest=False", "untick At rest"),
    (r"(?:design )?lqr\(\.\.\., integral=\{[^{}]*\}\)", "give the LQR an integral weight (Gains)"),
    (rf"\b({'|'.join(ASKED)})='([^']*)'", lambda m: f"{m[2]!r} in the field {ASKED[m[1]]}"),
)
"""(what the library says, what the page says)."""
