"""One server and one browser for all tests of the page; each test opens a session of its own."""

import importlib.util

import pytest
from browser_tools import Hand, Server, chromium


@pytest.fixture(scope="session")
def server(tmp_path_factory):
    if importlib.util.find_spec("nicegui") is None:
        pytest.skip("no nicegui here (pip install 'pam_ocp[bench]')")
    made = Server(tmp_path_factory.mktemp("bench"))
    yield made
    complaints = made.end()
    assert "Traceback" not in complaints, complaints


@pytest.fixture(scope="session")
def driver():
    made = chromium()
    yield made
    made.quit()


@pytest.fixture
def hand(server, driver):
    """A new session in the browser; at the end there is no error in its console."""
    made = Hand(driver)
    driver.delete_all_cookies()
    driver.get("about:blank")
    made.complaints(), made.asked()
    made.open(server.address.replace("/?", "/new?"))
    yield made
    assert made.complaints() == []
