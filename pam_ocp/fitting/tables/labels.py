"""Labels of a table's cells: inflation or deflation, and which repeat."""

from __future__ import annotations

from collections.abc import Mapping

from .headers import words_of
from .raw import RawTable

__all__ = ["LABELS", "branch_of", "read_labels"]

LABELS: dict[str, frozenset[str]] = {
    "branch": words_of(
        """branch, direction, phase, half cycle, path, richtung, ast, halbzyklus, sens, branche,
        dirección, sentido, direzione, richting"""
    ),
    "run": words_of(
        """run, repeat, repetition, rep, replicate, trial, cycle, lauf, zyklus, wiederholung,
        durchgang, versuch, essai, répétition, ciclo, ensayo, prova, herhaling"""
    ),
}
"""Label: names by which a header calls it."""

_WORDS = {
    "inflation": (
        "inflation",
        "inflating",
        "inflate",
        "inf",
        "up",
        "filling",
        "fill",
        "loading",
        "rising",
        "increasing",
        "pressurising",
        "pressurizing",
        "ascending",
        "auf",
        "aufwärts",
        "befüllen",
        "befüllung",
        "füllen",
        "belüften",
        "steigend",
        "gonflage",
        "montée",
        "inflado",
        "subida",
        "gonfiaggio",
        "+",
        "+1",
    ),
    "deflation": (
        "deflation",
        "deflating",
        "deflate",
        "def",
        "down",
        "venting",
        "vent",
        "unloading",
        "falling",
        "decreasing",
        "depressurising",
        "depressurizing",
        "descending",
        "ab",
        "abwärts",
        "entlüften",
        "entlüftung",
        "entleeren",
        "fallend",
        "dégonflage",
        "descente",
        "desinflado",
        "bajada",
        "sgonfiaggio",
        "-",
        "-1",
        "-1.0",
    ),
}
_BRANCHES = {word: branch for branch, words in _WORDS.items() for word in words}


def read_labels(raw: RawTable, columns: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Columns that hold labels, as text.

    Branches are called "inflation" and "deflation" whichever of the usual words stand there ("up",
    "venting", -1 beside 1); other words stay as they are.

    Raises InputError where two columns read as one label.
    """
    found = {}
    for label, names in LABELS.items():
        header = raw.header(label, names, columns)
        if header is not None:
            texts = [_text(cell) for cell in raw.columns[header]]
            found[label] = tuple(_branches(texts) if label == "branch" else texts)
    return found


def branch_of(text: str) -> str | None:
    """ "inflation" or "deflation" where a word says so; signs alone do not."""
    word = text.strip().lower()
    return _BRANCHES.get(word) if word.isalpha() else None


def _text(cell: object) -> str:
    text = str("" if cell is None else cell).strip()
    return text[:-2] if text.endswith(".0") and text[:-2].lstrip("-").isdigit() else text


def _branches(texts: list[str]) -> list[str]:
    signs = set(texts) <= {"1", "-1"}
    return [
        "inflation" if signs and text == "1" else _BRANCHES.get(text.lower(), text)
        for text in texts
    ]
