"""The whole chain once in a real browser: from a dropped CSV to a checked FMU and a script that
gives the same figures.
"""

import re
import subprocess
import sys

import pytest
from browser_tools import ROOT
from test_page import rig_file
from test_page_motion import new_motion, tab

pytest_plugins = ["page_fixtures"]


@pytest.mark.slow
def test_from_a_dropped_file_to_a_checked_fmu_and_a_script_with_the_same_figures(
    hand, server, tmp_path
):
    hand.drop(rig_file(tmp_path))
    hand.type("Rest length", "300")
    hand.sees("ForceTable(120 cells")
    tab(hand, "Muscle")
    hand.press("Fit")
    hand.sees("taut cells")
    tab(hand, "Plant")
    hand.choose("Arrangement", "AntagonisticSlide")
    hand.sees("muscle2.rest_length")
    hand.type("mass", "3 kg")
    hand.until(lambda: server.state(hand.session)["plant"].get("mass") == 3.0)
    new_motion(hand)
    tab(hand, "Control")
    hand.press("Centre position")
    hand.press("New LQR")
    hand.sees("phase margin")
    hand.sees("closed loop over 1 s")
    tab(hand, "Export")
    hand.press("Export FMU and check it")
    hand.sees("checked: all well")
    hand.press("Write report")
    report = server.folder / hand.session / "exports" / "report.html"
    hand.until(report.exists, "a report")
    hand.press("Run it and compare")
    hand.sees("The script gives all")
    shown = {
        r.text.split()[0]: float(r.text.split()[1])
        for r in hand.shown('table[aria-label^="Figures, page"] tbody tr')
    }
    assert len(shown) > 20

    # the script by itself, where nothing of the page is
    script = hand.driver.execute_script(
        "return document.querySelector('[aria-label=\"the script\"]').textContent"
    )
    alone = tmp_path / "alone"
    (alone / "files").mkdir(parents=True)
    for file in (server.folder / hand.session / "files").iterdir():
        (alone / "files" / file.name).write_bytes(file.read_bytes())
    (alone / "session.py").write_text(script, "utf-8")
    ran = subprocess.run(
        [sys.executable, "session.py"],
        cwd=alone,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    said = {n: float(v) for n, v in re.findall(r"^figure (\S+) = (\S+)$", ran.stdout, re.MULTILINE)}
    assert set(said) == set(shown)
    for name, value in shown.items():  # twelve digits are shown
        assert said[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    state = server.state(hand.session)
    for name, value in state["muscle"]["coefficients"].items():
        assert said[f"fit.{name}"] == pytest.approx(value, rel=1e-9)
    kept = state["views"]["figures"]["motions1"]["values"]
    assert said["motions1.duration"] == pytest.approx(kept["duration"], rel=1e-9)
    assert (alone / "exports1.fmu").exists()
