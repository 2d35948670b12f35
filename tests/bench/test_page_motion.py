"""The tabs Motion, Control and Export in a real browser: what a hand does, and what it makes."""

import time

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.bench.made import World, plant_of
from pam_ocp.bench.script import arguments

pytest_plugins = ["page_fixtures"]

pytestmark = pytest.mark.slow


def begin(hand, arrangement="AntagonisticSlide"):
    """A plant of the catalogue's muscle."""
    tab(hand, "Muscle")
    hand.choose("Catalogue", "DMSP-20-300")
    hand.sees("DMSP-20-300, rest length 300 mm")
    if arrangement != "HangingLoad":
        tab(hand, "Plant")
        hand.choose("Arrangement", arrangement)
        hand.sees("muscle2.rest_length")


def tab(hand, name):
    """Open a tab; again where the first click came too early."""
    for _ in range(3):
        hand.press(name)
        for _ in range(50):
            if hand.shown(f'[role=tabpanel][aria-label="{name}"]'):
                return
            time.sleep(0.1)


def retype(hand, label, text):
    """Over what stands in a field, as a hand does: it is never empty in between."""
    from selenium.webdriver.common.keys import Keys

    hand.field(label).send_keys(Keys.CONTROL, "a", Keys.NULL, text, Keys.TAB)


def motion_of(server, hand):
    return server.state(hand.session)["motions"][-1]


def planned_again(server, hand, motion):
    """The same by the verb alone."""
    folder, state = server.folder / hand.session, server.state(hand.session)
    return pam.plan(plant_of(World(folder, state)), **arguments(motion))


def duration_shown(hand):
    words = [e.text for e in hand.shown(".bench-verdict") if "verified" in e.text]
    return float(words[0].split()[0]) / 1e3 if words else None


def new_motion(hand):
    """The first one of the tab Motion, planned."""
    tab(hand, "Motion")
    hand.press("New motion")
    hand.until(lambda: duration_shown(hand), "a plan")


def stop(hand, number):
    return hand.until(lambda: hand.shown(f'[aria-label^="stop {number}, "]')[0])


def drag(hand, element, dx, dy, steps=8):
    from selenium.webdriver import ActionChains

    hand.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    grip = element.find_element("css selector", ".stops-grip")
    mouse = ActionChains(hand.driver, duration=30).move_to_element(grip).click_and_hold()
    for _ in range(steps):
        mouse.move_by_offset(round(dx / steps), round(dy / steps))
    mouse.perform()
    return ActionChains(hand.driver)


# ---- motion --------------------------------------------------------------------------------------
def test_motion_a_stop_is_dragged_and_the_plan_is_that_of_the_verb(hand, server):
    begin(hand)
    new_motion(hand)
    before = motion_of(server, hand)
    mouse = drag(hand, stop(hand, 2), 0, -32)
    hand.sees("under the hand")
    assert motion_of(server, hand) == before  # not before it is let go
    mouse.release().perform()
    hand.until(lambda: motion_of(server, hand)["stops"][1]["at"] > before["stops"][1]["at"] + 2e-3)
    after = motion_of(server, hand)
    assert after["stops"][0] == before["stops"][0]
    own = planned_again(server, hand, after)
    hand.until(lambda: duration_shown(hand) == pytest.approx(own.duration, rel=1e-4))
    assert own.verified
    hand.press_icon("Undo")
    hand.until(lambda: motion_of(server, hand) == before)


def test_motion_a_conflict_is_named_at_its_stop_and_the_old_motion_stays(hand, server):
    begin(hand)
    new_motion(hand)
    retype(hand, "To stop 2 in", "5 ms")
    hand.sees("no plan found")
    hand.until(lambda: hand.shown(".stops-problem")[0].text.startswith("stop 2: x"))
    assert hand.shown(".stops-old")
    retype(hand, "To stop 2 in", "60 ms")
    hand.until(lambda: duration_shown(hand) == pytest.approx(0.06, rel=1e-6))
    assert not hand.shown(".stops-problem")


def test_motion_keys_move_a_stop_in_place_and_in_time(hand, server):
    from selenium.webdriver.common.keys import Keys

    begin(hand, "HangingLoad")
    new_motion(hand)
    first = motion_of(server, hand)
    stop(hand, 2).send_keys(Keys.ARROW_DOWN)
    hand.until(lambda: motion_of(server, hand)["stops"][1]["at"] < first["stops"][1]["at"])
    hand.until(lambda: duration_shown(hand), "a plan")
    stop(hand, 2).send_keys(Keys.ARROW_RIGHT)
    hand.until(lambda: motion_of(server, hand)["durations"][0] is not None)
    later = motion_of(server, hand)["durations"][0]
    hand.until(lambda: duration_shown(hand) == pytest.approx(later, rel=1e-4))
    labels = [e.get_attribute("aria-valuetext") for e in hand.shown(".bench-stops [role=slider]")]
    assert all("mm" in label for label in labels)


def test_motion_two_plans_beside_each_other_and_a_record_dropped_on_one(hand, server, tmp_path):
    begin(hand)
    new_motion(hand)
    hand.press("Copy")
    hand.sees("beside Motion 1")
    retype(hand, "To stop 2 in", "80 ms")
    hand.until(lambda: duration_shown(hand) == pytest.approx(0.08, rel=1e-6))
    hand.until(lambda: hand.shown(".stops-other"), "the other plan")
    own = planned_again(server, hand, motion_of(server, hand))
    # the motion as it was "measured": late by nothing, 0.2 mm too far
    t = np.linspace(0.0, own.duration, 60)
    x = own.replay.trajectory.at(t)["x"] + 2e-4
    rows = [f"{a:.9f},{1e3 * b:.9f}" for a, b in zip(t, x, strict=True)]
    record = tmp_path / "record.csv"
    record.write_text("\n".join(["time [s],x [mm]", *rows]) + "\n", "utf-8")
    uploads = hand.all("input[type=file]")
    hand.drop(record, which=len(uploads) - 1)
    hand.sees("largest and root mean square difference")
    row = next(r.text for r in hand.shown("table tbody tr") if r.text.startswith("x 0."))
    largest, rms = (float(row.split()[i]) for i in (1, 3))
    assert largest == pytest.approx(0.2, abs=5e-3)
    assert rms == pytest.approx(0.2, abs=5e-3)


# ---- control -------------------------------------------------------------------------------------
def controlled(hand):
    tab(hand, "Control")
    hand.press("Centre position")
    hand.press("New LQR")
    hand.sees("phase margin")


def test_control_poles_follow_the_gains_and_are_those_of_the_verb(hand, server):
    begin(hand, "HangingLoad")
    controlled(hand)
    hand.press("New PID")
    hand.sees("PID 2")
    hand.until(lambda: len(hand.traces("Poles of the loop")) == 2)
    said = server.state(hand.session)["controllers"][-1]
    folder, state = server.folder / hand.session, server.state(hand.session)
    plant = plant_of(World(folder, state))

    def own(gains):
        made = pam.control.PointPid(plant, state["point"], **gains, sample_time=1e-3)
        return np.sort_complex(made.poles)

    def shown():
        at = hand.traces("Poles of the loop")[1]
        return np.sort_complex(np.array(at["x"], float) + 1j * np.array(at["y"], float))

    expected = own(said["gains"])
    hand.until(lambda: len(shown()) == len(expected) and np.allclose(shown(), expected, rtol=1e-6))
    sliders = hand.shown(".bench-words input[type=range]")
    hand.driver.execute_script(
        "arguments[0].value = 800; arguments[0].dispatchEvent(new Event('input'))", sliders[0]
    )
    hand.until(lambda: not np.allclose(shown(), expected, rtol=1e-3), "moved poles")
    assert server.state(hand.session)["controllers"][-1] == said  # not before it is let go
    hand.driver.execute_script("arguments[0].dispatchEvent(new Event('change'))", sliders[0])
    hand.until(lambda: server.state(hand.session)["controllers"][-1] != said)
    moved = own(server.state(hand.session)["controllers"][-1]["gains"])
    hand.until(lambda: np.allclose(shown(), moved, rtol=1e-6))


def test_control_a_predictive_controller_runs_live_and_follows_the_hand(hand, server):
    from selenium.webdriver.common.keys import Keys

    begin(hand)
    tab(hand, "Control")
    hand.press("Centre position")
    hand.press("New MPC")
    hand.sees("no linear loop")
    hand.press("Start")
    hand.sees("of real time")
    handle = hand.until(lambda: hand.shown(".bench-strip [role=slider]")[0])
    wanted = float(handle.get_attribute("aria-valuenow"))
    handle.send_keys(Keys.PAGE_UP)
    goal = float(handle.get_attribute("aria-valuenow"))
    assert goal == pytest.approx(wanted + 6.0)  # a tenth of the stroke [mm]

    def curve():
        """The last height of the reference and of what is reached [pixels]."""
        lines = [e.get_attribute("points") for e in hand.all(".strip-curve")[:2]]
        return [float(line.split()[-1].split(",")[1]) for line in lines]

    def close():
        asked, reached = curve()
        return abs(asked - reached) < 3 and asked < 100

    hand.until(close, "the plant at its reference")
    retype(hand, "Push, until changed", "40")
    time.sleep(1.0)

    def button(text):
        return next((b for b in hand.shown("button") if b.text == text), None)

    hand.until(lambda: button("Stop"), "a run that goes on")
    # a busy browser may do the click and then say that it had no time for it
    hand.until(lambda: button("Start") or (button("Stop").click() and False), "the end of the run")


def test_control_a_run_with_a_push_is_that_of_the_verb(hand, server):
    begin(hand)
    controlled(hand)
    retype(hand, "Push", "8")
    hand.until(lambda: "push" in {t["name"] for t in hand.traces("The closed loop over time")})
    state = server.state(hand.session)
    said = state["controllers"][-1]
    assert said["study"]["push"] == 8.0
    reached = hand.traces("The closed loop over time")[1]
    plant = plant_of(World(server.folder / hand.session, state))
    point = pam.equilibrium(plant, state["point"])
    own = pam.lqr(plant, point, weights={"x": 10.0, "v": 1.0}, integral={"x": 100.0})
    side = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-300"), loads=(pam.loads.ExternalForce("push"),)
    )
    run = pam.closed_loop(
        own,
        side,
        {"x": point["x"] + said["study"]["step"]},
        duration=1.0,
        start={v.name: point[v.name] for v in (*plant.states, *plant.inputs)},
        disturbances={"push": (said["study"]["push"], 0.5)},
    )
    shown = np.interp(0.7, np.array(reached["x"], float), np.array(reached["y"], float))
    assert shown == pytest.approx(1e3 * np.interp(0.7, run.t, run["x"]), abs=1e-6)


# ---- export --------------------------------------------------------------------------------------
def test_export_writes_what_is_asked_for_and_removes_it(hand, server):
    begin(hand)
    new_motion(hand)
    tab(hand, "Export")
    hand.choose("Standard", "3.0")
    hand.press("Export FMU and check it")
    hand.sees("checked: all well")
    (said,) = server.state(hand.session)["exports"]
    path = server.folder / hand.session / "exports" / said["file"]
    assert pam.check_fmu(path).ok
    script = hand.shown('[aria-label="the script"]')[0].text
    assert "pam.export_fmu(" in script
    assert "pam.plan(" in script
    study = hand.shown('[aria-label="the study file"]')[0].text
    assert 'kind = "check"' in study
    hand.press("Remove")
    hand.sees("Nothing yet")
