"""The page in a real browser: its server, Debian's Chromium with its driver, and a hand."""

import json
import os
import re
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PATIENCE = 90.0
"""Seconds after which what is awaited does not come any more; machines of tests are busy."""
AGAIN = 15.0
"""Seconds after which a user types or chooses once more what a page drawn anew has not heard."""


class Server:
    """``pam-ocp bench`` as a process."""

    def __init__(self, folder, *options, run=("-m", "pam_ocp"), **environment):
        # neither the tests' paths nor their working folder: what the page needs, it brings
        browser = () if "BROWSER" in environment else ("--no-browser",)
        run = [sys.executable, *run, "bench", *browser, "--folder", str(folder)]
        folder.chmod(0o755)
        self.folder = Path(folder)
        self.process = subprocess.Popen(
            [*run, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        )
        self.said = ""
        until = time.monotonic() + PATIENCE
        while "Ctrl-C" not in self.said and time.monotonic() < until:
            self.said += self.process.stdout.readline().decode()
        assert "http" in self.said, f"{self.said!r}\n{self.process.stderr.read()}"
        self.port = int(re.search(r":(\d+)/", self.said)[1])

    @property
    def address(self):
        """The one that was printed last, with a token that nobody has used."""
        pipe = self.process.stdout
        while select.select([pipe], [], [], 0.0)[0]:
            self.said += os.read(pipe.fileno(), 10_000).decode()
        return re.findall(r"http\S+", self.said)[-1]

    def state(self, id):
        """What is on the disk of a session."""
        return json.loads((self.folder / id / "session.json").read_text("utf-8"))["state"]

    def kill(self):
        self.process.kill()
        self._gone()

    def end(self):
        """As Ctrl-C does; returns what it complained of."""
        self.process.terminate()
        return self._gone()

    def _gone(self):
        self.process.stdout.close()
        said = self.process.stderr.read().decode()
        self.process.stderr.close()
        self.process.wait(20)
        return said


def chromium():
    """A headless Chromium; skips where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver")
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if not browser or not driver:
        pytest.skip("no chromium with its driver here (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for option in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--window-size=1280,1400",
        "--enable-unsafe-swiftshader",  # 3D without a graphics card
        "--force-prefers-reduced-motion",
        "--disable-background-timer-throttling",
        "--disable-backgrounding-occluded-windows",
        "--disable-renderer-backgrounding",
    ):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))


SHOWN = """
const shown = selector => [...document.querySelectorAll(selector)].filter(e =>
    e.checkVisibility({visibilityProperty: true, opacityProperty: true})
    && e.getBoundingClientRect().width > 0 && e.getBoundingClientRect().height > 0);
"""
"""What is to be seen, asked within the page: a question to its driver costs milliseconds."""


class Hand:
    """What a user does and sees."""

    def __init__(self, driver):
        self.driver = driver
        self._said = None
        """What was last typed or chosen: said again, it changes nothing where it was heard."""

    def open(self, address):
        self._said = None
        self.driver.get(address)
        self.until(lambda: self.all("[role=tab]") or self.all("h1"))
        self.until(
            lambda: self.driver.execute_script("return window.did_handshake"), "a connection"
        )

    @property
    def session(self):
        return self.driver.current_url.rpartition("/s/")[2]

    def until(self, condition, what="", within=PATIENCE):
        begun = time.monotonic()
        end, again = begun + within, begun + AGAIN
        while time.monotonic() < end:
            try:
                if self._said is not None and time.monotonic() > again:
                    again = end
                    said, self._said = self._said, None
                    said()
                found = condition()
            except Exception as error:  # the page is being drawn anew
                found, what = None, what or repr(error)[:200]
            if found:
                return found
            time.sleep(0.05)
        raise AssertionError(
            f"waited in vain for {what or condition}; the page says: {self.text[-3000:]}"
        )

    def all(self, selector):
        return self.driver.find_elements("css selector", selector)

    def shown(self, selector):
        return self.driver.execute_script(f"{SHOWN} return shown(arguments[0])", selector)

    @property
    def text(self):
        said = self.driver.execute_script("return document.body.innerText")
        return said.replace("\u00a0", " ")

    def sees(self, text):
        self.until(lambda: text in self.text, f"{text!r}")

    def press(self, text):
        """A button or a tab by its words."""
        self._said = None
        same = (
            f"{SHOWN} return shown('button, [role=tab]')"
            ".find(b => b.innerText.trim() === arguments[0])"
        )
        self.until(
            lambda: self.driver.execute_script(same, text).click() or True, f"a button {text!r}"
        )

    def press_icon(self, label):
        """A button by the beginning of its label."""
        self._said = None
        self.until(
            lambda: self.shown(f'button[aria-label^="{label}"]')[0].click() or True,
            f"icon {label!r}",
        )

    def field(self, label):
        """What the label of a shown field belongs to."""

        found = (
            f"{SHOWN} const label = shown('label').find(e => e.innerText.trim() === arguments[0]);"
            "return label ? document.getElementById(label.htmlFor)"
            " : shown('[aria-label]').find(e => e.ariaLabel === arguments[0])"
        )
        return self.until(lambda: self.driver.execute_script(found, label), f"a field {label!r}")

    def type(self, label, text):
        from selenium.webdriver.common.keys import Keys

        def typed():  # again where the page was drawn anew meanwhile
            field = self.field(label)
            field.send_keys(Keys.CONTROL + "a", Keys.NULL, text, Keys.TAB)
            return True

        self._say(typed, f"typing into {label!r}")

    def choose(self, label, value):
        from selenium.webdriver.support.ui import Select

        def chosen():
            Select(self.field(label)).select_by_value(value)
            return True

        self._say(chosen, f"choosing {value!r} of {label!r}")

    def _say(self, said, what):
        self._said = None
        self.until(said, what)
        self._said = said

    def drop(self, path, which=0):
        """A file onto an upload (its hidden input)."""
        self.until(lambda: len(self.all("input[type=file]")) > which, "an upload")
        self.all("input[type=file]")[which].send_keys(str(path))

    def plot(self, label):
        return self.until(
            lambda: self.driver.execute_script(
                f"{SHOWN} return shown('.js-plotly-plot').find(p => p.ariaLabel === arguments[0])",
                label,
            ),
            f"a picture {label!r}",
        )

    def click_point(self, label, x, y):
        """The place (x, y) of a picture's axes."""
        self._said = None
        from selenium.webdriver import ActionChains

        plot = self.plot(label)
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", plot)
        at = self.driver.execute_script(
            "const {xaxis: a, yaxis: b} = arguments[0]._fullLayout; return ["
            "a.d2p(arguments[1]) - a._length / 2, b.d2p(arguments[2]) - b._length / 2]",
            plot,
            x,
            y,
        )
        drag = plot.find_element("css selector", ".nsewdrag")
        mouse = ActionChains(self.driver, duration=50)
        mouse.move_to_element_with_offset(drag, round(at[0]) - 2, round(at[1])).perform()
        mouse.move_by_offset(2, 0).perform()
        end = time.monotonic() + 20.0  # the picture heeds a click once it has seen the mouse there
        while time.monotonic() < end and not self.driver.execute_script(
            "return Boolean(arguments[0]._hoverdata)", plot
        ):
            time.sleep(0.05)
        mouse.pause(0.1).click().perform()

    def traces(self, label):
        """The data that a picture shows."""
        return self.driver.execute_script(
            "return arguments[0].data.map(t => ({name: t.name, x: t.x, y: t.y}))", self.plot(label)
        )

    # ---- what the browser says ---------------------------------------------------------------
    def complaints(self):
        """Errors of the console since the last call."""
        return [e["message"] for e in self.driver.get_log("browser") if e["level"] == "SEVERE"]

    def asked(self):
        """Addresses that were asked for since the last call."""
        found = []
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                found.append(message["params"]["request"]["url"])
            if message["method"] == "Network.webSocketCreated":
                found.append(message["params"]["url"])
        return found
