"""The plant of PAM-2DIR as pam_ocp states it."""

import equations as e

import pam_ocp as pam


def slide():
    return pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"),
        e.MASS,
        e.CONTRACTION,
        stroke=e.STROKE,
        damping=pam.losses.ConstantDamping(e.DAMPING),
        feed=pam.feeds.Regulator(e.LAG, max_pressure=1e5 * e.LARGEST, max_rate=1e5 * e.RATE),
    )
