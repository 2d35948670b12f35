"""Code of a file is run where the start of the page allows it, and nowhere else."""

import json

import pytest
from browser_tools import Hand, Server
from test_page_motion import begin, tab

pytest_plugins = ["page_fixtures"]

OWN = """
from pathlib import Path

import pam_ocp as pam

Path(__file__).with_name("was-run").touch()


def heavy(muscle):
    return pam.HangingLoad(muscle, mass=9.5)
"""


@pytest.fixture
def allowing(driver, tmp_path):
    """A page that was started with --allow-code."""
    pytest.importorskip("nicegui")
    server = Server(tmp_path, "--allow-code")
    driver.delete_all_cookies()
    driver.get("about:blank")
    hand = Hand(driver)
    hand.complaints()  # of pages whose server has ended
    hand.open(server.address.replace("/?", "/new?"))
    yield hand, server
    said = server.end()
    assert "Traceback" not in said, said


def own_file(folder):
    path = folder / "mine.py"
    path.write_text(OWN, "utf-8")
    return path


@pytest.mark.slow
def test_a_plant_of_ones_own_where_code_is_allowed(allowing, tmp_path):
    hand, server = allowing
    begin(hand, "HangingLoad")
    tab(hand, "Plant")
    hand.sees("A plant of your own (.py)")
    mine = str(own_file(tmp_path))

    def dropped():  # again where the form is drawn anew meanwhile
        hand.all("input[type=file][accept='.py']")[-1].send_keys(mine)
        return True

    hand.until(dropped, "a place for files")
    hand.until(lambda: server.state(hand.session)["plant"]["arrangement"].endswith("mine.py:heavy"))
    hand.until(lambda: "9.5" in hand.text, "the mass of the plant")
    assert list((server.folder / hand.session / "files").glob("was-run"))
    hand.press_icon("Undo")
    hand.until(lambda: server.state(hand.session)["plant"]["arrangement"] == "HangingLoad")
    assert hand.complaints() == []


@pytest.mark.slow
def test_a_session_that_names_code_is_refused_where_it_is_not_allowed(driver, tmp_path):
    """As it came from somebody else, or from a page that was started with the consent."""
    pytest.importorskip("nicegui")
    first = Server(tmp_path)
    hand = Hand(driver)
    try:
        driver.delete_all_cookies()
        hand.open(first.address.replace("/?", "/new?"))
        begin(hand, "HangingLoad")
        tab(hand, "Plant")
        assert "A plant of your own" not in hand.text
        session = hand.session
        hand.until(lambda: first.state(session)["muscle"] is not None)
    finally:
        first.end()
    driver.get("about:blank")
    files = tmp_path / session / "files"
    files.mkdir(exist_ok=True)
    (files / "0-mine.py").write_text(OWN, "utf-8")
    path = tmp_path / session / "session.json"
    content = json.loads(path.read_text("utf-8"))
    content["state"]["plant"] = {"arrangement": "0-mine.py:heavy"}
    content["state"]["point"] = {"muscle.pressure": 2e5}
    path.write_text(json.dumps(content), "utf-8")
    second = Server(tmp_path)
    try:
        driver.get(second.address)
        hand.until(lambda: hand.shown(f'a[href="/s/{session}"]')[0].click() or True)
        for name in ("Plant", "Motion", "Control", "Export"):
            tab(hand, name)
            hand.until(lambda: "--allow-code" in hand.text or "your own" in hand.text, name)
        hand.press("Export FMU and check it")
        hand.sees("--allow-code")
        assert not (files / "was-run").exists()
    finally:
        said = second.end()
    assert "Traceback" not in said, said
    hand.complaints()
