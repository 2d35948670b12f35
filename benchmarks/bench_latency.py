"""How soon the page follows the hand: a slider to its curves, a stop under the hand to its plan.

    python benchmarks/bench_latency.py [--moves 100]

Needs Debian's chromium and chromium-driver, selenium, and pam_ocp[bench]. One session, nothing else
at work. Latencies are those of the page: from the event in the browser to the change of the drawn
curve there. Beside them the time of the verbs alone, in this process: six curves of 61 points, and
the planner's call on the page's coarse mesh, from the plan before. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np

import pam_ocp as pam
from pam_ocp.bench.jobs.motion import DRAGGED

harness.importable("tests/bench")

WATCH = """
const [what, attribute, within] = arguments;
window.late = []; window.begun = null; window.watching?.disconnect();
const place = within ? [...document.querySelectorAll('.js-plotly-plot')].find(p => p.data &&
  p.getAttribute('aria-label') === 'Force over contraction').closest(what)
  : document.querySelector(what);
window.watching = new MutationObserver(() => {
  if (window.begun === null) return;
  window.late.push(performance.now() - window.begun); window.begun = null;
});
window.watching.observe(place, {subtree: true, attributes: true, attributeFilter: [attribute]});
return true;
"""
SLIDE = """
const r = document.querySelector('.bench-slider input[type=range]');
window.begun = performance.now();
r.value = arguments[0]; r.dispatchEvent(new Event('input'));
"""
DRAG = """
const s = document.querySelector('.bench-stops svg');
window.begun = performance.now();
s.dispatchEvent(new PointerEvent('pointermove', {clientX: arguments[0], clientY: arguments[1]}));
"""


def measured(hand: Any, moves: int, pause: float, move: Callable[[int], None]) -> list[float]:
    """Latencies [ms] of the moves; none lies within another's wait."""
    for i in range(moves):
        move(i)
        hand.until(lambda: hand.driver.execute_script("return window.begun === null"))
        time.sleep(pause)
    return [float(v) for v in hand.driver.execute_script("return window.late")]


def slider(hand: Any, moves: int) -> list[float]:
    """A coefficient of a fitted law, moved; its curves."""
    hand.press("DMSP-20-300")
    hand.sees("ForceTable(126 cells")
    hand.press("Muscle")
    hand.press("Fit")
    hand.sees("over 60 taut cells")
    hand.until(lambda: hand.driver.execute_script(WATCH, "body", "d", True))

    def move(i: int) -> None:
        hand.driver.execute_script(SLIDE, 400 + 40 * ((i + 1) % 6))

    return measured(hand, moves, 0.1, move)


def drag(hand: Any, moves: int) -> list[float]:
    """The second stop of a slide's minimum-time motion, held and moved up and down by 10 mm."""
    from selenium.webdriver import ActionChains
    from test_page_motion import begin, duration_shown, stop, tab

    begin(hand)
    tab(hand, "Motion")
    hand.press("New motion")
    hand.until(lambda: duration_shown(hand), "a plan")
    grip = stop(hand, 2).find_element("css selector", ".stops-grip")
    ActionChains(hand.driver).move_to_element(grip).click_and_hold().perform()
    box = grip.rect
    top = hand.driver.execute_script("return arguments[0].getBoundingClientRect().top", grip)
    at = box["x"] + box["width"] / 2, top + box["height"] / 2
    hand.until(lambda: hand.driver.execute_script(WATCH, ".bench-stops", "points", False))

    def move(i: int) -> None:
        hand.driver.execute_script(DRAG, at[0], at[1] + 12 * ((i + 1) % 5 - 2))

    return measured(hand, moves, 0.1, move)


def told(late: list[float]) -> dict[str, float]:
    """Median, 95 % and count."""
    return {
        "moves": len(late),
        "median [ms]": round(float(np.median(late)), 1),
        "95 % [ms]": round(float(np.quantile(late, 0.95)), 1),
        "worst [ms]": round(max(late), 1),
    }


def verbs(moves: int) -> dict[str, float]:
    """Medians of the verbs by themselves [ms]."""
    fit = pam.fit_force(pam.read_table("DMSP-20-300_static.csv", rest_length=0.300))
    muscle, kappa = fit.muscle(), np.linspace(0, 0.3, 61)
    levels = np.linspace(0, 5e5, 6)
    curves = [
        harness.took(lambda: [muscle.force(level, kappa) for level in levels]).clock
        for _ in range(moves)
    ]
    plant = pam.AntagonisticSlide("DMSP-20-300")
    first: list[Any] = [{"x": -0.01}, {"x": 0.01}]
    planner = pam.Planner(plant, first, method=DRAGGED)
    last = planner(tolerance=None)
    solved = []
    for i in range(moves):
        stops = [first[0], {"x": 0.01 + 2e-3 * ((i + 1) % 5 - 2)}]
        call = partial(planner, guess=last, tolerance=None, starts=1, stops=stops)
        _, clock, last = harness.took(call)
        solved.append(clock)
    return {
        "six curves": round(1e3 * float(np.median(curves)), 2),
        "plan solved again": round(1e3 * float(np.median(solved)), 1),
    }


def main() -> None:
    from browser_tools import Hand, Server, chromium

    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--moves", type=int, default=100)
    given = options.parse_args()
    found: dict[str, Any] = {"load of the machine": round(os.getloadavg()[0], 1)}
    found["verbs [ms]"] = verbs(given.moves)
    with tempfile.TemporaryDirectory() as folder:
        server, driver = Server(Path(folder)), chromium()
        hand = Hand(driver)
        try:
            for name, part in (("slider to curves", slider), ("drag to plan", drag)):
                hand.open(server.address.replace("/?", "/new?"))
                found[name] = told(part(hand, given.moves))
        finally:
            driver.quit()
            server.end()
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
