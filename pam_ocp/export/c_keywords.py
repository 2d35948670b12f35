"""The words that C keeps for itself: no name of ours in generated code is one of them."""

from __future__ import annotations

_WORDS = """
    auto break case char const continue default do double else enum extern float for goto if
    inline int long register restrict return short signed sizeof static struct switch typedef
    union unsigned void volatile while
"""
C_KEYWORDS = frozenset(_WORDS.split())
