"""What stands beside changed inputs, in a real browser: the result of these inputs, or none."""

import numpy as np
import pytest
from test_page_motion import begin, duration_shown, motion_of, new_motion, retype, tab

import pam_ocp as pam

pytest_plugins = ["page_fixtures"]

pytestmark = pytest.mark.slow


def empty(hand, label):
    """Whether a picture shows nothing."""
    return not any(len(t["x"] or []) for t in hand.traces(label))


def table(hand, label):
    """The words of a table, or nothing."""
    return next((e.text for e in hand.shown(f'[aria-label="{label}"]')), "")


def test_ranked_laws_are_those_of_the_chosen_cells_and_off_cells_keep_their_numbers(hand, server):
    hand.press("DMSP-20-300")
    hand.sees("126 cells")
    hand.press("Muscle")
    hand.press("Rank all laws")
    hand.sees("left out [N]")
    hand.press("Data")
    hand.type("Cells off", "80-90")
    hand.until(lambda: server.state(hand.session)["data"][0]["off"])
    hand.type("Missing values", "9999")
    hand.until(lambda: server.state(hand.session)["data"][0]["off"] == [])
    hand.press("Muscle")
    hand.until(lambda: "left out [N]" not in hand.text)


def test_the_rest_length_of_a_muscle_of_the_catalogue_is_that_of_its_field(hand, server):
    tab(hand, "Muscle")
    hand.choose("Catalogue", "DMSP-20-300")
    hand.sees("rest length 300 mm")
    hand.type("Rest length", "25 cm")
    hand.sees("DMSP-20-300, rest length 250 mm")
    assert server.state(hand.session)["muscle"]["rest_length"] == pytest.approx(0.25)
    hand.press_icon("Undo")
    hand.sees("rest length 300 mm")
    hand.until(lambda: hand.field("Rest length").get_property("value") == "")


def test_free_vibration_and_loads_are_those_of_the_fields(hand, server):
    begin(hand, "HangingLoad")
    tab(hand, "Plant")
    hand.until(lambda: hand.shown(".bench-scene svg"), "the plant to scale")
    hand.type("muscle.pressure", "3")
    hand.sees("swings at")
    hand.press("Free response")
    hand.until(lambda: not empty(hand, "Free vibration over time"))
    hand.type("muscle.pressure", "4")
    hand.until(lambda: empty(hand, "Free vibration over time"))
    plant = pam.HangingLoad("DMSP-20-300")
    own = pam.equilibrium(plant, {"muscle.pressure": 4e5})
    hand.sees(f"{1e3 * own['x']:.6g}")
    hand.press("Free response")
    hand.until(lambda: not empty(hand, "Free vibration over time"))
    hand.type("Cycles", "5")
    hand.until(lambda: empty(hand, "Free vibration over time"))
    hand.press("Study the loads")
    hand.until(lambda: not empty(hand, "Load study"))
    hand.type("Masses [kg]", "4; 7,5")
    hand.until(lambda: empty(hand, "Load study"))
    hand.press("Study the loads")
    hand.until(lambda: {t["name"] for t in hand.traces("Load study")} == {"4 kg", "7.5 kg"})
    hand.type("mass", "-1")
    hand.sees("mass = -1 kg must be > 0")
    hand.until(lambda: not table(hand, "Values at rest") and "swings at" not in hand.text)


def test_a_plan_that_fails_or_is_gone_is_not_called_verified(hand, server):
    begin(hand)
    new_motion(hand)
    hand.choose("Bound", "v")
    hand.until(lambda: motion_of(server, hand)["bounds"])
    retype(hand, "v >=", "1000")
    retype(hand, "v <=", "-1000")
    hand.sees("the bounds are crossed")
    hand.until(lambda: "no plan: " in hand.text)
    assert duration_shown(hand) is None
    assert "Motion 1, before" in table(hand, "Figures of the plans")
    hand.press("Delete")
    hand.sees("None yet")
    hand.until(lambda: not hand.shown(".stops-curve, .stops-old"))
    assert not table(hand, "Figures of the plans")
    assert empty(hand, "Curves of the plan over time")


def test_motions_beside_and_records_are_of_the_plant_as_it_is(hand, server, tmp_path):
    begin(hand)
    new_motion(hand)
    plant = pam.AntagonisticSlide("DMSP-20-300")
    stops = [{"x": s["at"]} for s in motion_of(server, hand)["stops"]]
    t = np.linspace(0.0, 0.5, 100)
    record = tmp_path / "Messung 1 ü.csv"
    rows = [f"{a:.6f};{1e3 * stops[0]['x']:.6f}".replace(".", ",") for a in t]
    record.write_text("\n".join(["Zeit [s];x [mm]", *rows]), "utf-8")
    hand.drop(record, which=len(hand.all("input[type=file]")) - 1)
    hand.sees("largest and root mean square difference")
    hand.press("Copy")
    hand.sees("beside Motion 1")
    hand.until(lambda: table(hand, "Figures of the plans").count("ms") >= 2)

    def agrees(mass):
        own = pam.plan(plant.with_values(mass=mass), stops, time_limit=120.0)
        words = f"{1e3 * own.duration:.5g} ms"
        hand.until(lambda: table(hand, "Figures of the plans").count(words) == 2, words)
        x = own.replay.trajectory.at(t[t <= own.duration])["x"]
        largest = f"x {1e3 * np.abs(x - stops[0]['x']).max():.4g} mm"
        hand.until(lambda: largest in table(hand, "The record against the plan"), largest)

    tab(hand, "Plant")
    hand.type("mass", "2,5")
    hand.until(lambda: server.state(hand.session)["plant"].get("mass") == 2.5)
    tab(hand, "Motion")
    agrees(2.5)


def test_a_controller_that_cannot_be_made_leaves_nothing_of_the_one_before(hand, server):
    begin(hand, "HangingLoad")
    tab(hand, "Control")
    hand.press("Centre position")
    hand.press("New LQR")
    hand.sees("phase margin")
    hand.until(lambda: not empty(hand, "The closed loop over time"))
    retype(hand, "Step of x", "5000")
    hand.sees("x: reference = ")
    hand.until(lambda: empty(hand, "The closed loop over time"))
    retype(hand, "Step of x", "2")
    hand.until(lambda: not empty(hand, "The closed loop over time"))
    before = server.state(hand.session)["controllers"][-1]["gains"]
    name = next(
        e.get_attribute("aria-label") for e in hand.shown('.bench-slider input[type="text"]')
    )
    retype(hand, name, "-5")  # what is not taken does not stay
    hand.until(lambda: "-5" not in hand.field(name).get_property("value"))
    assert server.state(hand.session)["controllers"][-1]["gains"] == before
    retype(hand, name, "12,5")
    hand.until(lambda: server.state(hand.session)["controllers"][-1]["gains"]["position"] == 12.5)


def test_an_exported_file_of_earlier_values_says_so(hand, server):
    begin(hand, "HangingLoad")
    tab(hand, "Export")
    hand.press("Export FMU and check it")
    hand.sees("checked: all well")
    tab(hand, "Plant")
    hand.type("mass", "12")
    hand.until(lambda: server.state(hand.session)["plant"].get("mass") == 12.0)
    tab(hand, "Export")
    hand.sees("made of earlier values")
    assert "checked: all well" not in hand.text
    hand.press("Run it and compare")
    hand.until(lambda: "There are no figures yet" in hand.text)


def test_a_motion_of_another_arrangement_is_planned_anew_or_says_why_not(hand, server):
    begin(hand)
    new_motion(hand)
    tab(hand, "Plant")
    hand.choose("Arrangement", "HangingLoad")
    tab(hand, "Motion")
    hand.until(lambda: "no plan: stop 1: x = -9 mm is outside the stroke" in hand.text)
    assert duration_shown(hand) is None
    retype(hand, "x", "10")
    hand.until(lambda: duration_shown(hand), "a plan")
    at = [{"x": s["at"]} for s in motion_of(server, hand)["stops"]]
    assert [s["x"] for s in at] == pytest.approx([0.010, 0.009])
    own = pam.plan(pam.HangingLoad("DMSP-20-300"), at, time_limit=120.0)
    hand.until(lambda: duration_shown(hand) == pytest.approx(own.duration, rel=1e-4))
    tab(hand, "Plant")
    hand.choose("Arrangement", "AntagonisticJoint")
    tab(hand, "Motion")
    hand.sees("Motion 1 moves x or bounds what antagonistic_joint does not have")
    assert duration_shown(hand) is None
    assert empty(hand, "Curves of the plan over time")
    assert "unknown variable" not in hand.text
