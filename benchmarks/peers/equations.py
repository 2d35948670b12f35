"""PAM-2DIR for tools that know nothing of pam_ocp: the plant's equations in m, m/s, bar, and its
limits.

Written with plain arithmetic and a given ``exp``, so that any tool's symbols may be put in; run.py
compares them with the Plant. The six coefficients are those of the DMSP-20-200N, for p in bar.
"""

import json
import math
from time import process_time

try:
    import resource
except ImportError:  # Windows: what child processes spend is not told there
    resource = None


def clock():
    """Processor seconds of this process since it began, and of its children that have ended."""
    if resource is None:
        return process_time()
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process_time() + children.ru_utime + children.ru_stime


A1, A2, A3, A4, A5, A6 = (
    -4.00180705,
    292.4620246,
    -32.930845,
    -933.564098,
    294.0538256,
    -280.498151,
)
MASS, DAMPING, LAG, LENGTH, CONTRACTION, STOP = 2.0, 20.0, 0.05, 0.2, 0.10, 0.015
LARGEST, RATE, STROKE = 6.0, 40.0, 0.016
INTERVALS, GUESS = 50, 0.15
TIMES = [k / 100 for k in range(101)]
"""Of the simulation [s]; from rest, by command() at these times, joined by lines."""
REST = [0.0, 0.0, 3.0, 3.0]


def command(t):
    """Commanded pressures of the simulation [bar]."""
    return 3 + 0.5 * math.sin(7 * t), 3 + 0.5 * math.cos(9 * t)


def forces(x, p1, p2, exp=math.exp):
    """Forces of both muscles [N]."""
    return tuple(
        (A1 * p + A2) * exp(A3 * kappa) + A4 * kappa * p + A5 * p + A6
        for p, kappa in ((p1, CONTRACTION + x / LENGTH), (p2, CONTRACTION - x / LENGTH))
    )


def slopes(x, v, p1, p2, u1, u2, exp=math.exp):
    """Time derivatives of x, v, p1, p2."""
    f1, f2 = forces(x, p1, p2, exp)
    return v, (f1 - f2 - DAMPING * v) / MASS, (u1 - p1) / LAG, (u2 - p2) / LAG


def repeated(work, begin, times=3, prepare=lambda: None):
    """(first, best, result) of some calls.

    first : processor seconds to the first result, since the process began and since ``begin``, the
    clock after the imports. best : the least seconds of a call, without what prepares it. result :
    that of the last.
    """
    seconds, first = [], None
    for _ in range(times):
        prepare()
        ready = clock()
        result = work()
        done = clock()
        seconds.append(done - ready)
        first = first or (done, done - begin)
    return first, min(seconds), result


def report(name, first, solve, iterations, duration, states, inputs, breaks=None, points=(0.0,)):
    """Print a plan for run.py.

    first : processor seconds to the first result, since the process began and since the imports.
    solve : of the solver alone, the best of some. iterations : of the solver, or None. states :
    (4, intervals + 1). inputs : (intervals, 2, len(points)), whose polynomial through ``points``
    in 0 .. 1 of each interval is the input there. breaks : fractions of the duration at which
    intervals meet; equal intervals by default.
    """
    n = len(inputs)
    say(
        name,
        first,
        solve,
        iterations=iterations,
        duration=float(duration),
        states=[[float(v) for v in row] for row in states],
        inputs=[[[float(v) for v in u] for u in interval] for interval in inputs],
        breaks=list(breaks) if breaks is not None else [k / n for k in range(n + 1)],
        points=[float(p) for p in points],
    )


def say(name, first, solve, **found):
    """Print a result: the name of tool and way, seconds, and the answer."""
    print(
        "RESULT "
        + json.dumps({"name": name, "whole": first[0], "first": first[1], "solve": solve, **found})
    )
