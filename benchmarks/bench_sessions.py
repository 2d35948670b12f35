"""Several sessions of the page at once: errors, memory, and how soon curves follow sliders.

    python benchmarks/bench_sessions.py --sessions 8 --minutes 10

Needs Debian's chromium and chromium-driver, selenium, and pam_ocp[bench]. Each window has a session
of its own: a slider of its fitted law moves all the time, and in turn the law is fitted again,
moved by hand, undone, and a map of its plant is computed. Memory is that of the page (VmRSS of the
server) and of its processes, read every 15 s; the slope is that of the second half.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "bench"))

MOVE = """
window.late = window.late || []; let begun = null, i = arguments[0];
const plot = [...document.querySelectorAll('.js-plotly-plot')].find(p => p.data &&
  p.getAttribute('aria-label') === 'Force over contraction' && p.data.length > 6);
if (!plot) return false;
window.watching?.disconnect();
window.watching = new MutationObserver(() => {
  if (begun !== null) { window.late.push(performance.now() - begun); begun = null; }
});
window.watching.observe(plot.querySelector('.cartesianlayer'),
  {subtree: true, attributes: true, attributeFilter: ['d']});
clearInterval(window.moving);
window.moving = setInterval(() => {
  const r = document.querySelector('.bench-slider input[type=range]');
  if (!r) return;
  begun = performance.now(); i += 1; r.value = 500 + Math.round(250 * Math.sin(i / 7));
  r.dispatchEvent(new Event('input'));
}, arguments[1]);
return true;
"""
LATE = "const l = window.late || []; window.late = []; return l;"


def memory(pid: int) -> tuple[float, float]:
    """(of the process, of all below it) [MiB]."""

    def resident(one: int) -> float:
        try:
            text = Path(f"/proc/{one}/status").read_text()
        except OSError:
            return 0.0
        return next((int(n.split()[1]) / 1024 for n in text.splitlines() if "VmRSS" in n), 0.0)

    below = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            if parent == pid:
                below.append(resident(int(entry.name)))
    return resident(pid), sum(below)


def main() -> None:
    from browser_tools import Hand, Server, chromium

    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--sessions", type=int, default=8)
    options.add_argument("--minutes", type=float, default=10.0)
    options.add_argument("--interval", type=int, default=250, help="of slider moves [ms]")
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        server, driver = Server(folder), chromium()
        hand = Hand(driver)
        late: list[float] = []
        seen: list[tuple[float, float, float]] = []
        begin, round_ = time.monotonic(), 0
        done = dict.fromkeys(("fitted", "moved and undone", "mapped"), 0)
        complaints: list[str] = []
        try:
            windows = []
            for k in range(given.sessions):
                if k:
                    driver.switch_to.new_window("window")
                hand.open(server.address.replace("/?", "/new?"))
                hand.press("DMSP-20-300")
                hand.sees("ForceTable(126 cells")
                hand.press("Muscle")
                hand.press("Fit")
                hand.sees("over 60 taut cells")
                hand.until(lambda k=k: driver.execute_script(MOVE, 10 * k, given.interval))
                windows.append(driver.current_window_handle)
            begin, round_ = time.monotonic(), 0
            while time.monotonic() - begin < 60 * given.minutes:
                for window in windows:
                    if time.monotonic() - begin > 60 * given.minutes:
                        break
                    driver.switch_to.window(window)
                    late += driver.execute_script(LATE)
                    what = round_ % 3
                    if what == 0:
                        hand.press("Fit")
                        hand.sees("RMSE")
                        done["fitted"] += 1
                    elif what == 1:
                        driver.execute_script(
                            "document.querySelector('.bench-slider input[type=range]')"
                            ".dispatchEvent(new Event('change'))"
                        )
                        hand.sees("moved by hand")
                        hand.press_icon("Undo")
                        hand.sees("as fitted")
                        done["moved and undone"] += 1
                    else:
                        hand.press("Plant")
                        hand.press("Compute the map")
                        hand.sees("stiffness in N/mm")
                        hand.press("Muscle")
                        done["mapped"] += 1
                    hand.until(lambda i=round_: driver.execute_script(MOVE, i, given.interval))
                    complaints += hand.complaints()
                    hand.asked()
                    now = time.monotonic() - begin
                    if not seen or now - seen[-1][0] > 15:
                        seen.append((now, *memory(server.process.pid)))
                        print(
                            f"{now:6.0f} s  page {seen[-1][1]:.0f}, "
                            f"processes {seen[-1][2]:.0f} MiB,"
                            f" {len(late)} moves, {sum(done.values())} turns"
                        )
                round_ += 1
        finally:
            driver.quit()
            said = server.end()
    half = np.array([s for s in seen if s[0] > seen[-1][0] / 2])
    slope = float(np.polyfit(half[:, 0] / 60, half[:, 1], 1)[0]) if len(half) > 2 else float("nan")
    found = {
        "sessions": given.sessions,
        "minutes": round(seen[-1][0] / 60, 1),
        "done": done,
        "slider to curve [ms], median": round(float(np.median(late)), 1),
        "slider to curve [ms], 95 %": round(float(np.quantile(late, 0.95)), 1),
        "moves": len(late),
        "page [MiB], first and last": [round(seen[0][1]), round(seen[-1][1])],
        "page, second half [MiB/min]": round(slope, 2),
        "processes [MiB], largest": round(max(s[2] for s in seen)),
        "errors of the page": said.count("Traceback"),
        "errors of consoles": len(complaints),
        "load of the machine": round(os.getloadavg()[0], 1),
    }
    print(json.dumps(found, indent=1))
    if complaints:
        print(*complaints[:5], sep="\n")
    if "Traceback" in said:
        print(said[-3000:])


if __name__ == "__main__":
    main()
