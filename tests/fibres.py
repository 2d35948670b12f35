"""Three muscles as the hand-written equations know them, and the same ones of the library."""

from __future__ import annotations

import hand_equations as hand

import pam_ocp as pam

LONG, SHORT, THIN = (
    hand.Fibre("DMSP-20-400N", 0.4),
    hand.Fibre("DMSP-20-200N", 0.2),
    hand.Fibre("DMSP-10", 0.25, 0.01),
)


def bought(fibre: hand.Fibre) -> pam.Muscle:
    """The same muscle of the library, from the published numbers alone."""
    law = pam.laws.SixParameterLaw.from_published(hand.SETS[fibre.name])
    return pam.Muscle(law, fibre.length, fibre.diameter)
