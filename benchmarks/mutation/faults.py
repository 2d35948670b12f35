"""A fault: one place of one file, and what stands there instead."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Fault", "placed", "squeezed"]


@dataclass(frozen=True)
class Fault:
    """``file[start:end]`` becomes ``new``. Lines count from 1."""

    file: str
    start: int
    end: int
    new: str
    kind: str
    line: int
    old: str

    def applied(self, text: str) -> str:
        return text[: self.start] + self.new + text[self.end :]

    def __str__(self) -> str:
        old, new = (" ".join(s.split()) for s in (self.old, self.new))
        return f"{self.file}:{self.line}: {self.kind}: {old or '(nothing)'} -> {new or '(nothing)'}"


def squeezed(text: str) -> tuple[str, list[int]]:
    """The text without what a formatter may change, and where each of its letters stood.

    Blanks and line breaks go, commas before a closing bracket too; all quotes are double.
    """
    letters: list[str] = []
    places: list[int] = []
    for place, letter in enumerate(text):
        if letter.isspace():
            continue
        if letter in ")]}" and letters and letters[-1] == ",":
            letters.pop()
            places.pop()
        letters.append('"' if letter == "'" else letter)
        places.append(place)
    return "".join(letters), places


def placed(text: str, old: str) -> tuple[int, int] | None:
    """Start and end of ``old`` in ``text``, however either is broken into lines; None unless it
    stands there exactly once.
    """
    letters, places = squeezed(text)
    wanted, _ = squeezed(old)
    if letters.count(wanted) != 1:
        return None
    first = letters.index(wanted)
    return places[first], places[first + len(wanted) - 1] + 1
