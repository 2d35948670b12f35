"""The tabs Data, Muscle and Plant in a real browser: what a hand does, and what it makes."""

import json
import re
import zipfile

import numpy as np
import pytest
from browser_tools import Hand, Server

import pam_ocp as pam
from pam_ocp.bench.jobs.plant import equilibrium_map
from pam_ocp.bench.made import World, muscle_of, plant_of, table_of

pytest_plugins = ["page_fixtures"]

SCRIPTED = "<img src=x onerror=document.title='harmed'>"


def rig_file(folder, seed=None):
    """A CSV of a rig with lengths, two branches, two repeats, and a column whose name is HTML."""
    rng = np.random.default_rng(seed)
    law = pam.muscle("DMSP-20-300").law
    rows = ["p [kPa],length [mm],force [N],branch,run," + SCRIPTED]
    for p in range(100, 601, 100):
        for length in (296, 285, 270, 255, 240):
            tension = float(law.tension(1e3 * p, (300 - length) / 300))
            for branch, side in (("inflation", -12), ("deflation", 12)):
                for run in (1, 2):
                    force = max(tension + side + rng.normal(0, 2), 0.0)
                    rows.append(f"{p},{length},{force:.2f},{branch},{run},0")
    path = folder / "rig <b>bold<b>.csv"
    path.write_text("\n".join(rows) + "\n", "utf-8")
    return path


def bundled(hand):
    hand.press("DMSP-20-300")
    hand.sees("ForceTable(126 cells")


# ---- data ----------------------------------------------------------------------------------------
@pytest.mark.slow
def test_data_a_dropped_file_is_understood_coloured_and_nothing_in_it_is_run(
    hand, server, tmp_path
):
    hand.drop(rig_file(tmp_path))
    hand.sees("holds lengths: fill in the field Rest length")
    hand.type("Rest length", "300")
    hand.sees("ForceTable(120 cells")
    assert {"inflation", "deflation"} <= {t["name"] for t in hand.traces("Force over contraction")}
    hand.choose("Colour by", "run")
    hand.until(lambda: {"1", "2"} <= {t["name"] for t in hand.traces("Force over contraction")})
    assert SCRIPTED in hand.text
    assert not hand.all("img, b")
    assert hand.driver.title == "pam_ocp bench"
    (item,) = server.state(hand.session)["data"]
    assert item["said"] == {"rest_length": 0.3}
    own = table_of(World(server.folder / hand.session), item)
    assert own.pressure.max() == pytest.approx(6e5)


@pytest.mark.slow
def test_data_a_unit_is_changed_by_its_menu_and_changed_back_by_undo(hand, server, tmp_path):
    table = tmp_path / "table.csv"
    rows = [(p, x, max(0, 900 * p - 60 * x)) for p in (1, 3, 6) for x in (2, 8, 14, 20)]
    table.write_text("p,contraction [%],F [N]\n" + "".join(f"{p},{x},{f}\n" for p, x, f in rows))
    hand.drop(table)
    hand.sees("table.csv")
    hand.choose("unit of p", "bar")
    hand.sees("p 1..6 bar")
    hand.choose("unit of p", "psi")
    hand.sees("p 0.06895..0.4137 bar")
    hand.press_icon("Undo")
    hand.sees("p 1..6 bar")
    assert server.state(hand.session)["data"][0]["said"] == {"units": {"pressure": "bar"}}


@pytest.mark.slow
def test_data_a_cell_is_switched_off_by_a_click_and_by_its_number(hand, server):
    bundled(hand)
    force = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    cell = int(np.argmax(force.force))
    at = 100 * force.contraction[cell], force.force[cell]
    hand.click_point("Force over contraction", *at)
    hand.until(lambda: server.state(hand.session)["data"][0]["off"] == [cell])
    hand.until(lambda: hand.field("Cells off").get_property("value") == str(cell))
    hand.type("Cells off", "3, 10-12")
    hand.until(lambda: server.state(hand.session)["data"][0]["off"] == [3, 10, 11, 12])
    hand.type("Cells off", "3, 999")
    hand.sees("the table has cells 0 .. 125")
    assert server.state(hand.session)["data"][0]["off"] == [3, 10, 11, 12]


def test_data_what_is_damaged_or_a_bomb_is_refused_in_words(hand, server, tmp_path):
    broken = tmp_path / "broken.xlsx"
    broken.write_bytes(b"PK\x03\x04" + bytes(200))
    hand.drop(broken)
    hand.sees("cannot be read")
    assert server.state(hand.session)["data"] == [] if _saved(server, hand) else True


@pytest.mark.slow  # what the button asks for, pam_ocp.studies.quick, has quick tests of its own
def test_data_one_button_makes_one_page_with_all_its_files(hand, server):
    bundled(hand)
    hand.press("Make one page")
    hand.sees("Assumed:")
    assert "verified" in hand.text
    (packed,) = (server.folder / hand.session / "exports").glob("*.zip")
    with zipfile.ZipFile(packed) as archive:
        names = {name.rpartition("/")[2] for name in archive.namelist()}
        page = archive.read("DMSP-20-300_static/report.html").decode()
    assert names == {"muscle.toml", "plan.npz", "plant.fmu", "report.html", "fit.xlsx"}
    assert "From DMSP-20-300_static.csv to a motion" in page


def _saved(server, hand):
    return (server.folder / hand.session / "session.json").exists()


# ---- muscle --------------------------------------------------------------------------------------
@pytest.mark.slow
def test_muscle_a_fit_is_the_verbs_sliders_move_its_curve_and_no_other_host_is_asked(hand, server):
    bundled(hand)
    hand.press("Muscle")
    hand.press("Fit")
    hand.sees("over 60 taut cells")
    fit = pam.fit_force(pam.read_table("DMSP-20-300_static.csv", rest_length=0.3))
    said = server.state(hand.session)["muscle"]
    assert said["coefficients"] == pytest.approx(dict(fit.law.values), rel=1e-12)
    before = hand.traces("Force over contraction")[6]["y"]
    hand.driver.execute_script(
        "const r = document.querySelector('.bench-slider input[type=range]'); r.value = 700;"
        "r.dispatchEvent(new Event('input'))"
    )
    hand.until(lambda: hand.traces("Force over contraction")[6]["y"] != before, "a moved curve")
    assert server.state(hand.session)["muscle"]["moved"] is False  # not before it is let go
    hand.driver.execute_script(
        "const r = document.querySelector('.bench-slider input[type=range]');"
        "r.dispatchEvent(new Event('change'))"
    )
    hand.sees("moved by hand")
    moved = server.state(hand.session)
    assert moved["muscle"]["coefficients"]["a1"] > said["coefficients"]["a1"]
    muscle = muscle_of(World(server.folder / hand.session, moved))
    curve = hand.traces("Force over contraction")[6]
    expected = muscle.force(float(curve["name"].split()[0]) * 1e5, np.array(curve["x"]) / 100)
    assert curve["y"] == pytest.approx(expected, rel=1e-9, abs=1e-9)
    hand.press("Back to the fit")
    hand.sees("as fitted")
    # all that was asked for came from here, and the token has left the address bar
    asked = [u for u in hand.asked() if not u.startswith(("data:", "blob:", "about:"))]
    assert {u.split("/")[2] for u in asked} == {f"127.0.0.1:{server.port}"}
    assert "token" not in hand.driver.current_url
    assert hand.driver.execute_script("return document.cookie") == ""


@pytest.mark.slow
def test_muscle_laws_are_ranked_and_further_cells_proposed(hand, server):
    bundled(hand)
    hand.press("Muscle")
    hand.press("Rank all laws")
    hand.sees("left out [N]")
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    best = pam.compare_laws(table).best
    first = hand.shown("table tbody tr")[0].text.split()
    assert first[0] == best.name
    assert float(first[-1]) == pytest.approx(best.left_out_rmse, rel=1e-3)
    hand.press(best.name)
    hand.sees("taut cells")
    assert server.state(hand.session)["muscle"]["law"] == best.name
    hand.press("Propose")
    hand.sees("Standard errors then")
    assert "measure next" in {t["name"] for t in hand.traces("Force over contraction")}


# ---- plant ---------------------------------------------------------------------------------------
def plant_tab(hand):
    hand.press("Muscle")
    hand.choose("Catalogue", "DMSP-20-300")
    hand.sees("DMSP-20-300, rest length 300 mm")
    hand.press("Plant")
    hand.until(lambda: hand.shown(".bench-scene svg"), "the plant to scale")


@pytest.mark.slow
def test_plant_a_click_into_the_map_sets_the_operating_point_and_it_swings(hand, server):
    plant_tab(hand)
    hand.press("Compute the map")
    hand.sees("stiffness in N/mm")
    folder, state = server.folder / hand.session, server.state(hand.session)
    found = equilibrium_map(lambda *said: None, World(folder, state))
    p, x = found["pressures"][0], found["position"]
    drawn = hand.traces("Equilibrium map")[1]
    finite = np.isfinite(x)
    assert np.array(drawn["y"])[finite].astype(float) == pytest.approx(1e3 * x[finite], rel=1e-9)
    i = 20
    hand.click_point("Equilibrium map", p[i] / 1e5, 1e3 * x[i])
    hand.sees("swings at")
    point = server.state(hand.session)["point"]
    assert point["muscle.pressure"] == pytest.approx(p[i], abs=51.0)
    own = pam.equilibrium(plant_of(World(folder, state)), point)
    assert f"{1e3 * own['x']:.6g}" in hand.text
    hand.press("Free response")
    swing = hand.until(lambda: hand.traces("Free vibration over time")[0])
    assert swing["y"][0] == pytest.approx(1e3 * own["x"] + 2.0, abs=0.02)


@pytest.mark.slow
def test_plant_components_are_chosen_with_units_and_undone(hand, server):
    plant_tab(hand)
    hand.choose("Arrangement", "AntagonisticSlide")
    hand.sees("muscle2.rest_length")
    hand.type("mass", "3500 g")
    hand.until(lambda: server.state(hand.session)["plant"].get("mass") == 3.5)
    hand.choose("losses: add", "CoulombFriction")
    hand.type("constant", "25")
    losses = [{"kind": "CoulombFriction", "constant": 25.0}]
    hand.until(lambda: server.state(hand.session)["plant"].get("losses") == losses)
    plant = plant_of(World(server.folder / hand.session, server.state(hand.session)))
    assert plant.name == "antagonistic_slide"
    hand.type("mass", "-1")
    hand.sees("mass = -1 kg must be > 0")
    # the field itself does not: it is the plant that refuses it
    hand.until(lambda: hand.field("mass").get_attribute("aria-invalid") == "false")
    for _ in range(3):
        hand.press_icon("Undo")
    hand.press_icon("Close this message")
    hand.until(lambda: "losses" not in server.state(hand.session)["plant"])


# ---- the frame -----------------------------------------------------------------------------------
def test_keys_do_what_the_mouse_does(hand, server):
    bundled(hand)
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    hand.until(lambda: hand.shown("table button"))
    hand.shown("table button")[0].send_keys(Keys.ENTER)
    ActionChains(hand.driver).key_down(Keys.CONTROL).send_keys("z").key_up(Keys.CONTROL).perform()
    hand.until(lambda: server.state(hand.session)["data"] == [])


@pytest.mark.slow
def test_two_browsers_have_a_session_each_and_two_windows_may_share_one(hand, server):
    bundled(hand)
    first = hand.driver.current_window_handle
    one = hand.driver.current_url
    hand.driver.switch_to.new_window("window")
    hand.open(f"http://127.0.0.1:{server.port}/new")
    assert hand.driver.current_url != one
    hand.sees("Nothing yet")
    hand.open(one)
    hand.sees("DMSP-20-300_static.csv")
    hand.press("Remove")
    hand.sees("Nothing yet")
    hand.driver.close()
    hand.driver.switch_to.window(first)
    hand.sees("Nothing yet")  # what was done in the other window


@pytest.mark.slow
def test_a_killed_page_is_resumed_with_what_was_done_and_can_be_undone(driver, tmp_path):
    hand = Hand(driver)
    server = Server(tmp_path)
    try:
        hand.open(server.address)
        bundled(hand)
        hand.press("Muscle")
        hand.press("Fit")
        hand.sees("over 60 taut cells")
        session, before = hand.session, server.state(hand.session)
    finally:
        server.kill()
    driver.get("about:blank")
    server = Server(tmp_path)
    try:
        driver.get(server.address)
        hand.until(lambda: hand.shown(f'a[href="/s/{session}"]')[0].click() or True)
        hand.sees("over 60 taut cells")
        assert server.state(session) == before
        hand.press_icon("Undo")
        hand.sees("No muscle yet")
    finally:
        said = server.end()
    assert "Traceback" not in said, said
    hand.complaints()  # of the killed connection


def test_the_saved_state_says_nothing_of_the_token(server):
    assert server.address in server.said
    secrets = re.findall(r"token=(\S+)", server.said)
    for path in server.folder.rglob("*.json"):
        assert not any(s in json.dumps(json.loads(path.read_text("utf-8"))) for s in secrets)
