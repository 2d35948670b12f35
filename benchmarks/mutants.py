"""Which faults would the tests see? Each mutant changes one place of the source in a scratch copy.

A mutant is a file, the text to be replaced, the new text, and the tests of its room, which are run
until the first failure. The text is found however a formatter breaks it into lines, and in another
file where it has moved; it must stand in one place only. Killed: a test failed. Survived: none did,
so one is missing. Stale: the source has changed, so the mutant must. The tree itself is never
touched. ``mutate.py`` draws its faults at random.

Run:  nice -n 5 python benchmarks/mutants.py [parts of names or files to run ...]
"""

from __future__ import annotations

import shlex
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from mutation.faults import Fault, placed
from mutation.scratch import Scratch


@dataclass(frozen=True)
class Mutant:
    """One fault."""

    name: str
    file: str
    old: str
    new: str
    tests: str
    """Test files, and options of pytest, joined by blanks."""


HAND = "tests/plants/test_hand_equations.py"
FIGURES = "tests/planning/test_plan_figures.py"
SHARE = "tests/planning/test_plan_share.py -k 'not scipy and not never'"

REPORTED = [  # those that survived once
    Mutant(
        "work of half the power",
        "pam_ocp/planning/problem/objective.py",
        'power = plant.expression(f"{name}.power")',
        'power = plant.expression(f"{name}.power") / 2',
        FIGURES,
    ),
    Mutant(
        "exergy doubled",
        "pam_ocp/planning/problem/objective.py",
        'return _total(plant, "exergy_flow", "exergy")',
        'return 2 * _total(plant, "exergy_flow", "exergy")',
        FIGURES,
    ),
    Mutant(
        "air as net flow",
        "pam_ocp/planning/problem/objective.py",
        '_total(plant, "supply_flow", "air")',
        '_total(plant, "mass_flow", "air")',
        FIGURES,
    ),
    Mutant(
        "replay ignores path constraints",
        "pam_ocp/planning/replay.py",
        "path = np.asarray(function(*self._arguments(t, x, u)), float)",
        "path = -1e9 + 0 * np.asarray(function(*self._arguments(t, x, u)), float)",
        FIGURES,
    ),
    Mutant(
        "signed largest deviation",
        "pam_ocp/core/trajectory.py",
        "largest=float(np.max(np.abs(difference)))",
        "largest=float(np.max(difference))",
        "tests/core/test_trajectory.py",
    ),
    Mutant(
        "damping of the tendon reversed",
        "pam_ocp/plants/elastic.py",
        "c_t * (w - v)",
        "c_t * (v - w)",
        HAND,
    ),
    Mutant(
        "stroke of a pair by the larger",
        "pam_ocp/plants/pair.py",
        "min(pre_contraction - low, high - pre_contraction)",
        "max(pre_contraction - low, high - pre_contraction)",
        HAND,
    ),
    Mutant(
        "stroke of a slide by the longer muscle",
        "pam_ocp/plants/slide.py",
        "farthest = min(reach",
        "farthest = max(reach",
        HAND,
    ),
    Mutant(
        "range of a joint by the larger",
        "pam_ocp/plants/joint.py",
        "largest = min(",
        "largest = max(",
        HAND,
    ),
    Mutant(
        "allocation ignores the second arm",
        "pam_ocp/operating/allocation.py",
        "- arms[1] * tensions[1]",
        "- arms[0] * tensions[1]",
        HAND,
    ),
    Mutant(
        "allocation ignores both arms",
        "pam_ocp/operating/allocation.py",
        "effort = arms[0] * tensions[0] - arms[1] * tensions[1]",
        "effort = tensions[0] - tensions[1]",
        HAND,
    ),
    Mutant(
        "rate of the second moment arm",
        "pam_ocp/plants/joint.py",
        "rate=sign * radius * omega",
        "rate=radius * omega",
        HAND,
    ),
    Mutant(
        "rate of the second muscle of a slide",
        "pam_ocp/plants/slide.py",
        "rate=sign * v",
        "rate=v",
        HAND,
    ),
    Mutant(
        "wall that pulls back",
        "pam_ocp/plants/loads.py",
        "factor = clamp(1 + c * speed / (elastic + width), FACTOR_WIDTH)",
        "factor = 1 + c * speed / (elastic + width)",
        HAND,
    ),
    Mutant(
        "output slopes without inputs",
        "fmu/src/derivatives.c",
        "model_forward(m->x, m->u, m->p, s->xdot, m->last_slope, t.p, t.xdot, t.y);",
        "model_forward(m->x, m->u, m->p, s->xdot, t.u, t.p, t.xdot, t.y);",
        "tests/export/test_fmu_doors.py -k slope_of_an_output",
    ),
    Mutant(
        "unit of der(v)",
        "pam_ocp/export/layout.py",
        'return f"{numerator}/s2"',
        'return f"{numerator}/s"',
        "tests/export/test_fmu_doors.py -k has_the_unit",
    ),
    Mutant(
        "unit of the derivative of a compound",
        "pam_ocp/export/layout.py",
        ".strip('()')}.s)",
        ".strip('()')})",
        "tests/export/test_fmu_doors.py -k has_the_unit",
    ),
    Mutant(
        "wind-up of PositionController",
        "pam_ocp/control/pid.py",
        "self.pid(error, self.sample_time, self._saturated)",
        "self.pid(error, self.sample_time)",
        "tests/control/test_design_loop.py -k wind",
    ),
    Mutant(
        "air mass from gauge pressure",
        "pam_ocp/plants/valves.py",
        "chamber.pressure_rate(pressure + chamber.ambient, net, rate)",
        "chamber.pressure_rate(pressure, net, rate)",
        HAND,
    ),
    Mutant(
        "Kalman disturbance from zero",
        "pam_ocp/control/estimators/stationary.py",
        "return {n: self.point[n] + float(d)",
        "return {n: float(d)",
        "tests/control/test_offset_free.py",
    ),
    Mutant(
        "Kalman disturbance counted twice",
        "pam_ocp/control/estimators/stationary.py",
        "self._u[[v.name in self.disturbances for v in variables]] = 0.0",
        "pass;",
        "tests/control/test_offset_free.py",
    ),
    Mutant(
        "Kalman disturbance without feed-through",
        "pam_ocp/control/estimators/stationary.py",
        "np.hstack([c, d[:, columns]])",
        "np.hstack([c, 0 * d[:, columns]])",
        "tests/control/test_offset_free.py",
    ),
]

MUSCLE = [
    Mutant(
        "exponent of the six-parameter law",
        "pam_ocp/muscles/law.py",
        "(self.a1 * p + self.a2) * ca.exp(self.a3 * kappa)\n",
        "(self.a1 * p + self.a2) * ca.exp(-self.a3 * kappa)\n",
        "tests/muscles/test_force.py",
    ),
    Mutant(
        "stiffness without its minus",
        "pam_ocp/muscles/pneumatic_muscle.py",
        "stiffness = -ca.jacobian(force, kappa)",
        "stiffness = ca.jacobian(force, kappa)",
        HAND,
    ),
    Mutant(
        "consistent volume without the rest length",
        "pam_ocp/muscles/gas.py",
        "rest + muscle.rest_length * muscle.law.gain_area(kappa)",
        "rest + muscle.law.gain_area(kappa)",
        HAND,
    ),
    Mutant(
        "dead volume forgotten",
        "pam_ocp/muscles/gas.py",
        "for e in (filled + dead, slope)",
        "for e in (filled, slope)",
        HAND,
    ),
    Mutant(
        "exponent on the flow alone",
        "pam_ocp/muscles/gas.py",
        "self.exponent * (supplied - absolute * self.slope * rate) / self.volume",
        "(self.exponent * supplied - absolute * self.slope * rate) / self.volume",
        HAND,
    ),
    Mutant(
        "warm air flows more",
        "pam_ocp/muscles/gas.py",
        "cooling = ca.sqrt(REFERENCE_TEMPERATURE / temperature)",
        "cooling = ca.sqrt(temperature / REFERENCE_TEMPERATURE)",
        HAND,
    ),
    Mutant(
        "exergy by the decimal logarithm",
        "pam_ocp/muscles/gas.py",
        "ca.log(absolute / ambient)",
        "ca.log10(absolute / ambient)",
        HAND,
    ),
    Mutant(
        "closed stiffness without gauge to absolute",
        "pam_ocp/muscles/gas.py",
        "absolute = pressure + chamber.ambient",
        "absolute = pressure",
        "tests/muscles/test_gas.py",
    ),
    Mutant(
        "supply as if absolute",
        "pam_ocp/plants/valves.py",
        "supply = chamber.ambient + declare(",
        "supply = 0 * chamber.ambient + declare(",
        HAND,
    ),
    Mutant(
        "leak after the valve's node",
        "pam_ocp/plants/valves.py",
        "iso6358(inside, ambient, leak, b, t)",
        "iso6358(node, ambient, leak, b, t)",
        HAND,
    ),
    Mutant(
        "exhaust through the inlet's conductance",
        "pam_ocp/plants/valves.py",
        "venting * iso6358(node, ambient, outlet, b, t)",
        "venting * iso6358(node, ambient, inlet, b, t)",
        HAND,
    ),
    Mutant(
        "tube takes what leaves",
        "pam_ocp/plants/valves.py",
        "per_flow * (entering - leaving)",
        "per_flow * (entering + leaving)",
        HAND,
    ),
    Mutant(
        "damping ratio without its 2",
        "pam_ocp/plants/damping.py",
        "return 2 * ratio * ca.sqrt",
        "return ratio * ca.sqrt",
        HAND,
    ),
    Mutant(
        "Stribeck rises with speed",
        "pam_ocp/plants/damping.py",
        "ca.exp(-((v / stribeck) ** 2))",
        "ca.exp(-(v / stribeck))",
        HAND,
    ),
    Mutant(
        "Bouc-Wen shares swapped",
        "pam_ocp/plants/memory.py",
        "beta * speed * signed + (1 - beta) * onward * size",
        "(1 - beta) * speed * signed + beta * onward * size",
        HAND,
    ),
    Mutant(
        "Maxwell slip yields the other way",
        "pam_ocp/plants/memory.py",
        "down * _passage(-z, edge, 3.0)",
        "down * _passage(z, edge, 3.0)",
        HAND,
    ),
    Mutant(
        "creep without its own time",
        "pam_ocp/plants/memory.py",
        "(motion.contraction - settled) / tau)",
        "(motion.contraction - settled))",
        HAND,
    ),
    Mutant(
        "losses pull",
        "pam_ocp/plants/feeds.py",
        "tension = tension - lost",
        "tension = tension + lost",
        HAND,
    ),
    Mutant(
        "power with the sign of stretching",
        "pam_ocp/plants/feeds.py",
        "ca.SX(force * velocity)",
        "ca.SX(-force * velocity)",
        HAND,
    ),
    Mutant(
        "geometric law with 2 for 3",
        "pam_ocp/muscles/laws/braid.py",
        "active = 3 * (1 - shortening)",
        "active = 2 * (1 - shortening)",
        "tests/muscles/test_laws.py",
    ),
    Mutant(
        "corrected law without its correction",
        "pam_ocp/muscles/laws/braid.py",
        "_braid_force(p, eps * kappa,",
        "_braid_force(p, kappa,",
        "tests/muscles/test_laws.py",
    ),
    Mutant(
        "area of the gain without its half",
        "pam_ocp/muscles/law.py",
        "self.a4 * kappa**2 / 2",
        "self.a4 * kappa**2",
        HAND,
    ),
    Mutant(
        "braid volume by the sine",
        "pam_ocp/muscles/gas.py",
        "(1 - ca.cos(angle) ** 2 * length**2)",
        "(1 - ca.sin(angle) ** 2 * length**2)",
        "tests/muscles/test_gas.py",
    ),
    Mutant(
        "catalogue flow per second",
        "pam_ocp/muscles/gas.py",
        "return flow / 60e3 /",
        "return flow / 1e3 /",
        "tests/muscles/test_gas.py",
    ),
    Mutant(
        "directional damping the other way round",
        "pam_ocp/plants/damping.py",
        "relaxing + (contracting - relaxing) * share",
        "contracting + (relaxing - contracting) * share",
        "tests/plants/test_losses.py",
    ),
]

PLANT = [
    Mutant(
        "weight by the cosine",
        "pam_ocp/plants/hanging.py",
        "mass * g * ca.sin(angle)",
        "mass * g * ca.cos(angle)",
        HAND,
    ),
    Mutant(
        "added inertia forgotten",
        "pam_ocp/plants/elastic.py",
        "self.der(v, (pull - weight(self, m) + outside) / (m + added))",
        "self.der(v, (pull - weight(self, m) + outside) / m)",
        HAND,
    ),
    Mutant(
        "load mass in the fitting's damping",
        "pam_ocp/plants/elastic.py",
        ".coefficient(self, end, attached.stiffness)",
        ".coefficient(self, m, attached.stiffness)",
        HAND,
    ),
    Mutant(
        "spring damped without its stiffness",
        "pam_ocp/plants/elastic.py",
        ".coefficient(self, m, stiffness)",
        ".coefficient(self, m, attached.stiffness)",
        HAND,
    ),
    Mutant(
        "link's weight upwards",
        "pam_ocp/plants/joint.py",
        "(torque - weight - c * omega + outside)",
        "(torque + weight - c * omega + outside)",
        HAND,
    ),
    Mutant(
        "second arm as the first",
        "pam_ocp/plants/joint.py",
        "moment_arm if moment_arm2 is None else moment_arm2",
        "moment_arm",
        HAND,
    ),
    Mutant(
        "spring of a load from zero",
        "pam_ocp/plants/loads.py",
        "-k * (at.position - rest)",
        "-k * at.position",
        HAND,
    ),
    Mutant(
        "feedback of velocity reversed",
        "pam_ocp/plants/regulated.py",
        "- derivative_gain * rate * length",
        "+ derivative_gain * rate * length",
        HAND,
    ),
    Mutant(
        "feedback of contraction, not shortening",
        "pam_ocp/plants/regulated.py",
        "reference - contraction * length",
        "reference - contraction",
        HAND,
    ),
    Mutant(
        "mirror without its sign",
        "pam_ocp/plants/slide.py",
        '"v": (-1.0, "v")',
        '"v": (1.0, "v")',
        FIGURES,
    ),
    Mutant(
        "least effort from the wrong corner",
        "pam_ocp/operating/allocation.py",
        "np.array([[low1, high1], [high2, low2]])",
        "np.array([[low1, high1], [low2, high2]])",
        "tests/operating/test_allocation.py",
    ),
    Mutant(
        "feasible without the tensions",
        "pam_ocp/operating/allocation.py",
        "good &= np.all(self._call(z.ravel(), p)[2] >= -1e-9, axis=0)",
        "pass",
        "tests/operating/test_allocation.py",
    ),
]

PLAN = [
    Mutant(
        "replay looks at the first leg only",
        "pam_ocp/planning/replay.py",
        "if own.any():",
        "if own.any() and not i:",
        FIGURES,
    ),
    Mutant(
        "replay ignores lower bounds",
        "pam_ocp/planning/replay.py",
        "beyond = np.maximum(np.maximum(low - values, values - high), 0.0)",
        "beyond = np.maximum(values - high, 0.0)",
        FIGURES,
    ),
    Mutant(
        "replay's deviation signed",
        "pam_ocp/planning/replay.py",
        "deviation = np.abs(motion.array(names)[::per] - samples.array(names)) / nominal",
        "deviation = (motion.array(names)[::per] - samples.array(names)) / nominal",
        "tests/planning/test_plan_figures.py tests/planning/test_plan.py",
    ),
    Mutant(
        "effort without squares of all inputs",
        "pam_ocp/planning/problem/objective.py",
        'return ca.sumsqr(plant.u / plant.vector("input", attribute="nominal"))',
        'return (plant.u[0] / plant.vector("input", attribute="nominal")[0]) ** 2',
        FIGURES,
    ),
    Mutant(
        "square without its nominal",
        "pam_ocp/planning/problem/objective.py",
        "return (expression / variable.nominal) ** 2",
        "return expression**2",
        FIGURES,
    ),
    Mutant(
        "tracking without its nominal",
        "pam_ocp/planning/problem/objective.py",
        "total += weight * (error / variable.nominal) ** 2",
        "total += weight * error**2",
        FIGURES,
    ),
    Mutant(
        "rate over the sum of the intervals",
        "pam_ocp/planning/transcription/transcription.py",
        "h = (clock.lengths[k - 1] + clock.lengths[k]) / 2",
        "h = clock.lengths[k - 1] + clock.lengths[k]",
        FIGURES,
    ),
    Mutant(
        "cycle closed without its sign",
        "pam_ocp/planning/transcription/transcription.py",
        "*(sign * z.start",
        "*(z.start",
        FIGURES,
    ),
    Mutant(
        "bounds at a seam of two legs: the wider",
        "pam_ocp/planning/transcription/transcription.py",
        "np.column_stack([np.maximum(a[:, 0], b[:, 0]), np.minimum(a[:, 1], b[:, 1])])",
        "np.column_stack([np.minimum(a[:, 0], b[:, 0]), np.maximum(a[:, 1], b[:, 1])])",
        FIGURES,
    ),
    Mutant(
        "profiles sampled at the interval's start",
        "pam_ocp/planning/transcription/transcription.py",
        "times = t + h * float(tau)",
        "times = t + 0 * h",
        "tests/planning/test_plan_wording.py",
    ),
]

FIT = [
    Mutant(
        "covariance by the scale, not its square",
        "pam_ocp/fitting/statistics.py",
        "np.asarray(scale**2 * self._factor)",
        "np.asarray(scale * self._factor)",
        "tests/fitting/test_fit_static.py",
    ),
    Mutant(
        "one-sided intervals",
        "pam_ocp/fitting/statistics.py",
        "stdtrit(dof, (1 + level) / 2)",
        "stdtrit(dof, level)",
        "tests/fitting/test_fit_static.py",
    ),
    Mutant(
        "nothing is blind",
        "pam_ocp/fitting/statistics.py",
        "return np.asarray(unseen > 1e-6 * length)",
        "return np.asarray(unseen > 1e6 * length)",
        "tests/fitting/test_fit_static.py",
    ),
    Mutant(
        "correlations keep their sign in the choice",
        "pam_ocp/fitting/statistics.py",
        "if abs(p[0]) > beyond",
        "if p[0] > beyond",
        "tests/fitting/test_fit_static.py",
    ),
    Mutant(
        "active constraints do not narrow",
        "pam_ocp/fitting/statistics.py",
        "svd(scaled @ free, full_matrices=False)\n        return norms, s, vt @ free.T",
        "svd(scaled, full_matrices=False)\n        return norms, s, vt",
        "tests/fitting/test_fit_robust.py -k equality",
    ),
]

TRAJECTORY = [
    Mutant(
        "rms without its root",
        "pam_ocp/core/trajectory.py",
        "rms=float(np.sqrt(np.mean(difference**2)))",
        "rms=float(np.mean(difference**2))",
        "tests/core/test_trajectory.py",
    ),
    Mutant(
        "relative deviation times nominal",
        "pam_ocp/core/trajectory.py",
        "return self.largest / self.variable.nominal",
        "return self.largest * self.variable.nominal",
        "tests/core/test_trajectory.py",
    ),
]

DESIGN = [
    Mutant(
        "filtered slope of a PID the other way",
        "pam_ocp/control/pid.py",
        "share * self._slope + (1 - share) * (error - self._last) / sample_time",
        "(1 - share) * self._slope + share * (error - self._last) / sample_time",
        "tests/control/test_design_loop.py",
    ),
    Mutant(
        "integral of an LQR with the wrong sign",
        "pam_ocp/control/linear_quadratic.py",
        "u = u - self.Ki @ self._integrals.values",
        "u = u + self.Ki @ self._integrals.values",
        "tests/control/test_design_lqr.py",
    ),
    Mutant(
        "integrals wind up",
        "pam_ocp/control/linear_quadratic.py",
        "if not saturated:\n            self.values",
        "if True:\n            self.values",
        "tests/control/test_design_lqr.py",
    ),
    Mutant(
        "sampled LQR weighs without dt",
        "pam_ocp/control/linear_quadratic.py",
        "control.dlqr(ad, bd, used * sample_time, r * sample_time)",
        "control.dlqr(ad, bd, used, r * sample_time)",
        "tests/control/test_design_lqr.py",
    ),
    Mutant(
        "effort not squared",
        "pam_ocp/control/linear_quadratic.py",
        "np.diag(np.square(efforts))",
        "np.diag(efforts)",
        "tests/control/test_design_lqr.py",
    ),
    Mutant(
        "Riccati backwards without Q",
        "pam_ocp/control/along_motion.py",
        "pb @ inverse @ pb.T + qt)",
        "pb @ inverse @ pb.T)",
        "tests/control/test_design_tvlqr.py",
    ),
    Mutant(
        "feed-forward without the acceleration",
        "pam_ocp/control/pid.py",
        "self.inverse(at[0], at[1], at[2] + acceleration, stiffness)",
        "self.inverse(at[0], at[1], acceleration, stiffness)",
        "tests/control/test_design_loop.py",
    ),
    Mutant(
        "Kalman drift without dt",
        "pam_ocp/control/estimators/stationary.py",
        "np.concatenate([drive, drift]) ** 2 * sample_time",
        "np.concatenate([drive, drift]) ** 2",
        "tests/control/test_offset_free.py tests/control/test_design_lqr.py",
    ),
    Mutant(
        "estimate without the point",
        "pam_ocp/control/offset_free.py",
        "u = point.u[self._chosen] + rest[n:]",
        "u = point.u[self._chosen]",
        "tests/control/test_offset_free.py",
    ),
]

VIBRATION_AND_FMU = [
    Mutant(
        "potential energy without its minus",
        "pam_ocp/vibration/energy_balance.py",
        "potential = -_integral(resultant",
        "potential = _integral(resultant",
        "tests/vibration/test_vibration.py -k energy",
    ),
    Mutant(
        "power lost without the mass",
        "pam_ocp/vibration/energy_balance.py",
        "float(m) * v * (moving - resting)",
        "v * (moving - resting)",
        "tests/vibration/test_vibration.py -k energy",
    ),
    Mutant(
        "inputs of a step stand still",
        "fmu/src/step.c",
        "u[i] = start->u[i] + elapsed * start->slope[i]",
        "u[i] = start->u[i] + 0 * elapsed * start->slope[i]",
        "tests/export/test_fmu_simulation.py",
    ),
    Mutant(
        "slopes of the inputs forgotten in the solver",
        "fmu/src/step.c",
        "sloping |= start->slope[i] != 0.0",
        "sloping |= start->slope[i] > 1e300",
        "tests/export/test_fmu_simulation.py tests/export/test_fmu_solver.py",
    ),
    Mutant(
        "discarded step leaves its state",
        "fmu/src/step.c",
        "memcpy(&s->memory, &start, sizeof start); /* a discarded",
        "if (0) memcpy(&s->memory, &start, sizeof start); /* a discarded",
        "tests/export/test_fmu_refused.py -k fails",
    ),
    Mutant(
        "error of the first state alone",
        "fmu/src/solver.c",
        "if (error > largest) largest = error;",
        "if (n == 0) largest = error;",
        "tests/export/test_fmu_simulation.py tests/export/test_fmu_solver.py",
    ),
    Mutant(
        "states are no outputs of themselves",
        "fmu/src/derivatives.c",
        "for (int i = 0; i < NX; i++) t.x[i] += seeds.x[i];",
        "",
        "tests/export/test_fmu_derivatives.py",
    ),
]

ROBUST = [
    Mutant(
        "spread of one side only",
        "pam_ocp/planning/studies/share.py",
        "excess = np.abs(deviation) /",
        "excess = deviation /",
        SHARE,
    ),
    Mutant(
        "one-sided interval of the share",
        "pam_ocp/planning/studies/share.py",
        "(1 - self.confidence) / 2",
        "(1 - self.confidence)",
        SHARE,
    ),
    Mutant(
        "interval of one plant more",
        "pam_ocp/planning/studies/share.py",
        "betaincinv(k + 1, n - k, 1 - tail)",
        "betaincinv(k + 1, n - k + 1, 1 - tail)",
        SHARE,
    ),
    Mutant(
        "limits along the way are not judged",
        "pam_ocp/planning/studies/share.py",
        "if demand.problem is not None:",
        "if demand.problem is not None and False:",
        SHARE,
    ),
    Mutant(
        "a plant that fails keeps all",
        "pam_ocp/planning/studies/share.py",
        "np.where(np.isnan(excess), np.inf, excess)",
        "np.where(np.isnan(excess), -1.0, excess)",
        SHARE,
    ),
    Mutant(
        "every stop has the first spread",
        "pam_ocp/planning/studies/robust.py",
        "(int(np.argmin(np.abs(t - at))), i + 1, allowed[i])",
        "(int(np.argmin(np.abs(t - at))), i + 1, next(filter(None, allowed)))",
        SHARE,
    ),
    Mutant(
        "the first sample again and again",
        "pam_ocp/planning/studies/robust.py",
        "self.last, self.next = self.next, self.next + 1",
        "self.last, self.next = self.next, self.next",
        SHARE,
    ),
    Mutant(
        "any share is enough",
        "pam_ocp/planning/studies/share.py",
        "return self.value >= self.wanted",
        "return self.value >= 0.5 * self.wanted",
        SHARE,
    ),
]

MUTANTS = [
    *REPORTED,
    *MUSCLE,
    *PLANT,
    *PLAN,
    *FIT,
    *TRAJECTORY,
    *DESIGN,
    *VIBRATION_AND_FMU,
    *ROBUST,
]


def found(tree: Path, mutant: Mutant) -> Fault | None:
    """The mutant's place in the tree: in its file, or in the one file that has its text now."""
    files = [tree / mutant.file]
    others = [*sorted(tree.glob("pam_ocp/**/*.py")), *sorted(tree.glob("fmu/*.c"))]
    for candidates in (files, others):
        places = []
        for path in candidates:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            at = placed(text, mutant.old)
            if at is not None:
                line = text.count("\n", 0, at[0]) + 1
                name = path.relative_to(tree).as_posix()
                places.append(Fault(name, *at, mutant.new, mutant.name, line, mutant.old))
        if len(places) == 1:
            return places[0]
    return None


def main(words: list[str]) -> int:
    chosen = [m for m in MUTANTS if not words or any(w in m.name or w in m.file for w in words)]
    killed = 0
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Scratch(Path(temporary))
        for mutant in chosen:
            fault = found(scratch.folder, mutant)
            if fault is None:
                print(f"{'STALE':<28}          {mutant.name}", flush=True)
                continue
            with scratch.with_fault(fault):
                answer = scratch.ask(shlex.split(mutant.tests), expected=150.0)
            killed += answer.killed
            print(f"{answer.word:<28}{answer.seconds:6.1f} s  {mutant.name}", flush=True)
    print(f"{killed} of {len(chosen)} killed")
    return int(killed != len(chosen))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
