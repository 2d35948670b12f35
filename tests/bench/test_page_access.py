"""The page without a mouse, without eyes, on a phone: in a real browser."""

import re
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from browser_tools import SHOWN
from test_page import bundled
from test_page_motion import new_motion, tab

import pam_ocp as pam

pytest_plugins = ["page_fixtures"]

TABS = ("Data", "Muscle", "Plant", "Motion", "Control", "Export")
NAME = """
const e = document.activeElement;
return (e.getAttribute('aria-label') || e.labels?.[0]?.textContent || e.innerText || '').trim()
"""
"""Of what has the keyboard's focus."""


class Keys:
    """What a keyboard alone does."""

    def __init__(self, hand):
        from selenium.webdriver import ActionChains
        from selenium.webdriver.common.keys import Keys as Named

        self.hand, self.names = hand, Named
        self._press = lambda *keys: ActionChains(hand.driver).send_keys(*keys).perform()

    def to(self, name):
        """Tab along until something of this name has the focus."""
        for _ in range(400):
            if self.hand.driver.execute_script(NAME) == name:
                return
            self._press(self.names.TAB)
        raise AssertionError(f"no {name!r} on the way of the Tab key")

    def press(self, name, key=None):
        self.to(name)
        self._press(key or self.names.ENTER)

    def tab(self, name):
        """From the tab before it: to the open one, and by an arrow key to its neighbour."""
        self.to(TABS[TABS.index(name) - 1])
        self._press(self.names.ARROW_RIGHT)
        self.press(name)
        self.hand.until(lambda: self.hand.shown(f'[role=tabpanel][aria-label="{name}"]'))

    def menu(self, name, value):
        """Arrow keys in a menu to a value, one after the other without a look between them."""
        self.to(name)
        values = "return [...document.activeElement.options].map(o => o.value)"
        now = "return document.activeElement.selectedIndex"
        place = self.hand.driver.execute_script(values).index(value)
        by = place - self.hand.driver.execute_script(now)
        self._press(*[self.names.ARROW_DOWN if by > 0 else self.names.ARROW_UP] * abs(by))

    def type(self, name, text):
        self.to(name)  # which marks what stands there
        self._press(text, self.names.TAB)


@pytest.mark.slow
def test_from_a_bundled_table_to_an_fmu_by_the_keyboard_alone(hand, server):
    keys = Keys(hand)
    keys.press("DMSP-20-300")
    hand.sees("ForceTable(126 cells")
    keys.tab("Muscle")
    keys.press("Fit", keys.names.SPACE)
    hand.sees("over 60 taut cells")
    keys.tab("Plant")
    keys.menu("Arrangement", "RegulatedLoad")
    keys.menu("Arrangement", "AntagonisticSlide")
    hand.until(lambda: server.state(hand.session)["plant"]["arrangement"] == "AntagonisticSlide")
    keys.type("mass", "3 kg")
    hand.until(lambda: server.state(hand.session)["plant"].get("mass") == 3.0)
    assert hand.driver.execute_script(NAME), "the focus was lost as the form was drawn anew"
    keys.tab("Motion")
    keys.press("New motion")
    hand.until(lambda: [e for e in hand.shown(".bench-verdict") if "verified" in e.text], "a plan")
    keys.tab("Control")
    keys.press("Centre position")
    keys.press("New LQR: LQR, with an integral")
    hand.sees("phase margin")
    keys.tab("Export")
    keys.press("Runs on", keys.names.HOME)  # this machine
    hand.until(lambda: server.state(hand.session)["views"]["Export"]["platforms"] == "native")
    keys.press("Export FMU and check it")
    hand.sees("checked: all well")
    (said,) = server.state(hand.session)["exports"]
    assert said["ok"]
    assert (server.folder / hand.session / "exports" / said["file"]).exists()


@pytest.mark.slow
def test_axe_finds_nothing_on_any_tab_light_dark_or_narrow(hand, server):
    if find_spec("axe_playwright_python") is None:
        pytest.skip("no axe-core here (pip install --no-deps axe-playwright-python)")
    place = Path(find_spec("axe_playwright_python").origin)
    source = place.with_name("axe.min.js").read_text("utf-8")
    hand.driver.set_script_timeout(120)
    found = {f"{name}, empty": looked_at(hand, source, name) for name in TABS}
    filled(hand)
    found |= {f"{name}, light": looked_at(hand, source, name) for name in TABS}
    hand.press_icon("Light, dark")
    found |= {f"{name}, dark": looked_at(hand, source, name) for name in TABS}
    narrow(hand)
    try:
        found |= {f"{name}, narrow": looked_at(hand, source, name) for name in TABS}
    finally:
        hand.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    lines = [f"{where}: {one}" for where, what in found.items() for one in what]
    assert not lines, "\n".join(lines)


def looked_at(hand, source, name):
    """What axe-core finds on a tab."""
    tab(hand, name)
    time.sleep(0.5)  # colours change within a third of a second
    hand.driver.execute_script(source)
    return hand.driver.execute_async_script(
        "const done = arguments[0]; axe.run(document).then(r => done(r.violations.map(v =>"
        "[v.id, ...v.nodes.map(n => n.html.slice(0, 150) + ' | ' + n.failureSummary)])))"
    )


def filled(hand):
    """A session with something on each tab."""
    tab(hand, "Data")
    bundled(hand)
    tab(hand, "Muscle")
    hand.press("Fit")
    hand.sees("over 60 taut cells")
    tab(hand, "Plant")
    hand.choose("Arrangement", "AntagonisticSlide")
    hand.sees("muscle2.rest_length")
    new_motion(hand)
    tab(hand, "Control")
    hand.press("Centre position")
    hand.press("New PID")
    hand.sees("closed loop over 1 s")


def narrow(hand):
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    hand.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


@pytest.mark.slow
def test_on_a_phone_pictures_come_first_and_every_tab_is_in_reach(hand, server):
    bundled(hand)
    narrow(hand)
    try:
        tops = "return [...arguments].map(e => Math.round(e.getBoundingClientRect().top))"
        (plots,), (side,) = hand.shown(".bench-plots"), hand.shown(".bench-side")
        hand.until(lambda: len(set(hand.driver.execute_script(tops, plots, side))) == 2)
        first, second = hand.driver.execute_script(tops, plots, side)
        assert first < second
        inside = (
            "return [...arguments].map(e => e.getBoundingClientRect())"
            ".every(r => r.left >= 0 && r.right <= 390)"
        )
        tabs = hand.shown("[role=tab]")
        hand.until(lambda: hand.driver.execute_script(inside, *tabs), "tabs within the screen")
        wide = hand.driver.execute_script("return document.documentElement.scrollWidth")
        assert wide <= 390
    finally:
        hand.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.slow
def test_a_picture_says_in_words_what_it_shows_and_an_empty_one_what_it_will(hand, server):
    def said(label):
        plot = hand.plot(label)
        other = plot.get_attribute("aria-describedby")
        return hand.driver.execute_script(
            "return document.getElementById(arguments[0]).textContent", other
        )

    assert "add data" in said("Force over contraction")
    assert "add data" in hand.plot("Force over contraction").text.replace("\n", " ")
    bundled(hand)
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    words = f"force from 0 to {table.force.max():.4g} N"
    hand.until(lambda: words in said("Force over contraction"), words)
    assert "126 points" in said("Force over contraction")


def test_a_refused_file_gets_no_tick_and_is_named_as_it_was_dropped(hand, server, tmp_path):
    broken = tmp_path / "my rig (1).xlsx"
    broken.write_bytes(b"PK\x03\x04" + bytes(200))
    hand.drop(broken)
    message = hand.until(lambda: hand.shown(".bench-message.is-error")[0].text)
    assert "my rig (1).xlsx" in message
    assert not re.search("[0-9a-f]{10}-", message)
    assert str(server.folder) not in message
    assert "my rig" not in hand.text.replace(message, "")  # in no list of the page
    assert not hand.shown(".q-uploader__list .q-icon")
    good = tmp_path / "rig.csv"
    good.write_text("p [bar],contraction [%],F [N]\n1,1,10\n2,2,20\n3,3,10\n", "utf-8")
    hand.drop(good)
    hand.until(lambda: hand.shown('[aria-label="Data of this session"] tbody tr'))


LONG = ("Make one page", "Run it and compare")
"""Of these there are tests of their own."""
NAMELESS = """
return [...document.querySelectorAll('input, select, button, [role=tab], [role=slider]')]
  .filter(e => e.checkVisibility() && e.type !== 'file' && !(e.labels && e.labels.length)
    && !e.getAttribute('aria-label') && !e.textContent.trim()).map(e => e.outerHTML)"""


@pytest.mark.slow
def test_every_field_has_a_name_and_every_button_does_something_without_complaint(hand, server):
    assert hand.driver.execute_script("return document.documentElement.lang")
    filled(hand)
    words = f"{SHOWN} return shown('[role=tabpanel] button').map(b => b.innerText.trim())"
    all_pressed = set()
    for name in TABS:
        tab(hand, name)
        assert hand.driver.execute_script(NAMELESS) == [], name
        pressed = {*LONG, "", "+"}
        while fresh := [
            one
            for one in hand.driver.execute_script(words)
            if one not in pressed and not one.startswith(("Remove", "Delete", "DMSP"))
        ]:
            pressed.add(fresh[0])
            hand.press(fresh[0])
            if fresh[0] == "Start":
                hand.sees("of real time")
                hand.press("Stop")
                pressed.add("Stop")
            hand.until(lambda: not hand.shown(".bench-job"), "the work's end")
            wrong = hand.driver.execute_script(
                f"{SHOWN} return shown('.bench-message.is-error').map(e => e.innerText)"
            )
            # a load study needs a diameter, which a fit does not know
            assert not [w for w in wrong if "Inner diameter" not in w], f"{name}, {fresh[0]}"
        all_pressed |= pressed
    assert {"Start", "Compute the map", "Save muscle file", "Copy", "Export SSP"} <= all_pressed
