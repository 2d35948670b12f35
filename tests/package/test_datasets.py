"""pam_ocp.datasets: fixed splits, files that are the right ones, scores as computed by hand."""

from __future__ import annotations

import csv
import hashlib
import http.server
import json
import math
import os
import statistics
import sys
import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.datasets import DATASETS, Dataset, Score, Split, compare, load, score

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
ARM = "mpi_arm_64_episodes.csv"
FOLDER = Path(os.environ.get("PAM_OCP_DATA", BENCHMARKS.parents[1] / "shared" / "data"))
with_arm = pytest.mark.skipif(
    not (FOLDER / ARM).exists(), reason=f"{ARM} is not here: set PAM_OCP_DATA to its folder"
)
SPLITS = [(info, split) for info in DATASETS.values() for split in info.splits]

ROWS = """run,t_s,y_mm_m,u_V
0,0.0,0,1
0,0.1,9,2
1,0.0,0,1
1,0.1,1,2
1,0.2,2,3
1,0.3,3,4
1,0.4,4,5
2,0.0,0,1
2,0.1,2,2
2,0.2,4,3
2,0.3,6,4
2,0.4,8,5
2,0.5,10,6
2,0.6,12,7
"""


def ramps(place: str = "folder", text: str = ROWS) -> Dataset:
    """Three records of one output and one input; two of them are ramps to be predicted."""
    return Dataset(
        "ramps",
        "nothing",
        {"run": "1", "t_s": "s", "y_mm_m": "m", "u_V": "V"},
        "CC0-1.0",
        "nobody",
        "10.0/0",
        place,
        {"ramps.csv": {"sha256": hashlib.sha256(text.encode()).hexdigest(), "records": "0..2"}},
        {"interpolation": {"train": [0], "test": [1, 2]}},
        outputs=("y_mm",),
        past=2,
        every=2,
        horizons=(1, 2),
    )


@pytest.fixture
def split(tmp_path: Path) -> Split:
    (tmp_path / "ramps.csv").write_bytes(ROWS.encode())
    return load(ramps(), folder=tmp_path)


def held(past: pam.Trajectory, inputs: pam.Trajectory) -> Any:
    return np.full((len(inputs), 1), past["y_mm"][-1])


# ---- splits -------------------------------------------------------------------------------------
@pytest.mark.parametrize(("info", "split"), SPLITS, ids=lambda x: getattr(x, "name", x))
def test_what_is_fitted_and_what_is_predicted_are_all_records_each_once(info, split):
    train, test = info.records(split)
    held = [info.files[name]["records"] for name in info.needed(split)]
    whole = [n for part in held for n in (range(*ends(part)) if isinstance(part, str) else part)]
    assert sorted([*train, *test]) == sorted(whole)
    assert len(set(whole)) == len(whole)


def ends(said: str) -> tuple[int, int]:
    first, last = map(int, said.split(".."))
    return first, last + 1


@pytest.mark.parametrize("split", ["interpolation", "extrapolation"])
@pytest.mark.parametrize(("name", "length"), [("DMSP-20-300", 0.300), ("DMSP-10-250", 0.250)])
def test_cells_of_the_bundled_tables_are_split_without_loss(name, length, split):
    parts = load(name, split)
    whole = pam.read_table(f"{name}_static.csv", rest_length=length)
    cells = [
        list(zip(t.contraction, t.pressure, t.force, strict=True))
        for t in (parts.train, parts.test, whole)
    ]
    assert sorted(cells[0] + cells[1]) == sorted(cells[2])
    assert not {k for k, _, _ in cells[0]} & {k for k, _, _ in cells[1]}
    assert len(parts.test.taut) > 0


def test_the_digest_is_that_of_the_task(split):
    other = load("DMSP-20-300"), load("DMSP-20-300", "extrapolation"), load("DMSP-20-300")
    assert other[0].digest == other[2].digest != other[1].digest
    changed = Split(ramps(text=ROWS + " "), split.name, split.train, split.test)
    assert changed.digest != split.digest


def test_a_split_shows_licence_and_citation(capsys):
    text = str(load("DMSP-10-250"))
    for word in ("CC BY 4.0", "10.3390/act6040033", "Martens", "DMSP-10-250_static.csv (bundled)"):
        assert word in text
    pam.datasets.show()
    assert all(f"{name}: " in capsys.readouterr().out for name in [*DATASETS][:1])


def test_unknown_names_are_told_the_nearest():
    refused("did you mean 'DMSP-20-300'", load, "DMSP-20-3OO", error=pam.UnknownNameError)
    with pytest.raises(pam.UnknownNameError, match="did you mean 'interpolation'"):
        load("DMSP-20-300", "interpolate")


# ---- files --------------------------------------------------------------------------------------
def test_a_file_with_another_checksum_is_refused_with_both_sums(tmp_path):
    (tmp_path / ARM).write_bytes(b"episode,t_s\n")
    found = hashlib.sha256(b"episode,t_s\n").hexdigest()
    expected = DATASETS["mpi_arm"].files[ARM]["sha256"]
    refused(f"{ARM}.* is {found}, expected is {expected}", load, "mpi_arm", folder=tmp_path)


def test_a_set_of_the_users_folder_asks_for_it(tmp_path, monkeypatch):
    monkeypatch.delenv("PAM_OCP_DATA", raising=False)
    refused(f"folder=.*PAM_OCP_DATA.*{ARM}", load, "mpi_arm")
    monkeypatch.setenv("PAM_OCP_DATA", str(tmp_path))
    refused(f"{ARM}: no such file", load, "mpi_arm")


def test_other_columns_than_those_of_the_set_are_refused(tmp_path):
    text = ROWS.replace("u_V", "v_V")
    (tmp_path / "ramps.csv").write_bytes(text.encode())
    refused("v_V", load, ramps(text=text), folder=tmp_path)


def test_records_that_are_not_there_are_named_and_so_are_windows_that_none_holds(tmp_path, split):
    lacking = replace(ramps(), splits={"interpolation": {"train": [0], "test": [2, 7]}})
    with pytest.raises(pam.InputError, match="do not hold 7; they hold 0, 1, 2"):
        load(lacking, folder=tmp_path)
    levels = replace(DATASETS["DMSP-20-300"], splits={"mine": {"train": [0.1234], "test": "0..0"}})
    with pytest.raises(pam.InputError, match=r"mine: .* not hold 0, 0\.1234; they hold none"):
        load(levels, "mine")
    long = Split(replace(ramps(), horizons=(1, 20)), "interpolation", split.train, split.test)
    with pytest.raises(pam.InputError, match="past = 2 and horizons = 20 samples"):
        score(long, held)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """An HTTP server with one file, which counts how often it was asked; an empty cache."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            made.asked += 1
            self.send_response(200)
            self.send_header("Content-Length", str(len(made.content)))
            self.end_headers()
            self.wfile.write(made.content)

        def log_message(self, *words: object) -> None: ...

    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "*")
    made: Any = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    made.asked, made.content, made.cache = 0, ROWS.encode(), tmp_path / "cache"
    made.info = ramps(f"http://127.0.0.1:{made.server_port}/")
    thread = threading.Thread(target=made.serve_forever, args=(0.01,))
    thread.start()
    yield made
    made.shutdown()
    thread.join()
    made.server_close()


def test_a_file_is_downloaded_once_with_its_licence_told(server):
    pytest.importorskip("pooch")
    with pytest.warns(UserWarning, match=r"CC0-1\.0.*nobody") as told:
        first = load(server.info)
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = load(server.info)
    assert server.asked == 1
    assert [r.t.size for r in again.test] == [r.t.size for r in first.test] == [5, 7]


def test_a_download_with_another_checksum_is_refused_and_not_kept(server):
    pytest.importorskip("pooch")
    server.content = ROWS[:-9].encode()  # cut off
    found = hashlib.sha256(server.content).hexdigest()
    refused(f"not downloaded: .*{found}", load, server.info)
    assert [path for path in server.cache.rglob("*") if path.is_file()] == []


def test_a_damaged_file_in_the_cache_is_downloaded_anew(server):
    pytest.importorskip("pooch")
    with pytest.warns(UserWarning, match="was downloaded"):
        load(server.info)
    (kept,) = (path for path in server.cache.rglob("*") if path.is_file())
    kept.write_text("damaged")
    with pytest.warns(UserWarning, match="was downloaded"):
        load(server.info)
    assert kept.read_bytes() == ROWS.encode()


def test_a_folder_takes_the_place_of_the_download(server, tmp_path):
    (tmp_path / "ramps.csv").write_bytes(ROWS.encode())
    assert len(load(server.info, folder=tmp_path).test) == 2
    assert server.asked == 0


def test_without_pooch_the_extra_is_named(server, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    refused(r"pip install 'pam_ocp\[data\]'", load, server.info)


# ---- scores -------------------------------------------------------------------------------------
def test_errors_over_each_horizon_are_those_computed_by_hand(split):
    """Windows begin at sample 1 of the first ramp, at 1 and 3 of the second, of twice the slope."""
    near, far = score(split, held).parts
    assert (near.horizon, far.horizon, near.unit) == (0.1, 0.2, "m")
    assert (near.count, far.count) == (3, 3)
    assert near.rmse == pytest.approx(math.sqrt((1 + 4 + 4) / 3))
    assert far.rmse == pytest.approx(math.sqrt((2.5 + 10 + 10) / 3))
    size = statistics.pstdev([0, 1, 2, 3, 4, 0, 2, 4, 6, 8, 10, 12])
    assert near.nrmse == pytest.approx(near.rmse / size)


def test_the_interval_takes_records_as_independent_not_windows(split):
    """Of the mean square 3: sums over records are 2 below and 2 above; t of one degree of freedom
    is the quantile of Cauchy's distribution.
    """
    near = score(split, held).parts[0]
    error = math.sqrt(2 / 1 * (2**2 + 2**2)) / 3
    factor = math.exp(math.tan(math.pi * 0.475) * error / (2 * 3))
    assert near.low == pytest.approx(math.sqrt(3) / factor)
    assert near.high == pytest.approx(math.sqrt(3) * factor)


def test_a_model_sees_the_past_of_all_and_ahead_only_inputs(split):
    seen = []

    def predict(past: pam.Trajectory, inputs: pam.Trajectory) -> pam.Trajectory:
        seen.append((past.names, inputs.names, past.t.tolist(), inputs.t.tolist(), inputs["u"]))
        rate = np.diff(past["y_mm"])[0] / np.diff(past.t)[0]
        return pam.Trajectory(inputs.t, {"y_mm": past["y_mm"][-1] + rate * inputs.t})

    assert [part.rmse for part in score(split, predict).parts] == pytest.approx([0, 0], abs=1e-12)
    names, ahead, before, after, u = seen[-1]
    assert (names, ahead) == (("y_mm", "u"), ("u",))
    assert before == pytest.approx([-0.1, 0.0])
    assert after == pytest.approx([0.0, 0.1, 0.2])
    assert u.tolist() == [4, 5, 6]


def test_predictions_that_are_no_numbers_of_the_right_shape_are_refused(split):
    refused(r"\(2, 1\): return \(3, 1\)", score, split, lambda past, inputs: np.zeros((2, 1)))
    refused("not all of them finite", score, split, lambda past, inputs: np.full((3, 1), np.inf))
    with pytest.raises(pam.InputError, match="task is an int"):
        score(3, held)  # type: ignore[arg-type]


@pytest.mark.parametrize(("at_slack", "counted"), [(5.0, 5.0), (0.0, 0.0), (-50.0, 0.0)])
def test_where_the_muscle_is_slack_only_what_pulls_is_an_error(at_slack, counted):
    split = load("DMSP-20-300")
    truth = split.test.force

    def predict(kappa: Any, p: Any) -> Any:
        return np.where(truth > 0, truth + 3.0, at_slack)

    force, slack = score(split, predict).parts
    assert (force.rmse, slack.rmse) == pytest.approx((3.0, counted))
    assert (force.count, slack.count) == (np.sum(truth > 0), np.sum(truth == 0))
    assert force.nrmse == pytest.approx(3.0 / statistics.pstdev(truth[truth > 0]))


def test_a_score_is_saved_and_read_back_and_compared(split, tmp_path):
    mine = score(split, held, model="mine")
    path = mine.save(tmp_path / "mine.json")
    said = json.loads(path.read_text("utf-8"))
    assert (said["dataset"], said["digest"], said["version"]) == (
        "ramps",
        split.digest,
        pam.__version__,
    )
    assert Score.load(path) == mine
    table = compare([path, score(split, held)])
    assert "mine" in table
    assert "held" in table
    assert table.count("1.732") == 2
    law = score("DMSP-20-300", lambda kappa, p: 0 * p)
    refused(r"2 tasks .*DMSP-20-300.*ramps", compare, [mine, law])
    path.write_text(json.dumps({**said, "parts": [{"output": "y"}]}))
    refused(r"mine\.json cannot be read as a score", Score.load, path)


# ---- the arm ------------------------------------------------------------------------------------
@with_arm
def test_the_held_angles_of_the_arm_have_the_error_of_a_loop_over_its_file():
    split = load("mpi_arm", folder=FOLDER)
    assert (len(split.train), len(split.test)) == (48, 16)

    def angles_held(past: pam.Trajectory, inputs: pam.Trajectory) -> Any:
        return np.tile(past.array(["q1", "q2", "q3", "q4"])[-1], (len(inputs), 1))

    found = {(p.output, p.horizon): p for p in score(split, angles_held).parts}
    q: dict[int, list[float]] = {}
    with (FOLDER / ARM).open() as file:
        for row in csv.DictReader(file):
            q.setdefault(int(row["episode"]), []).append(float(row["q3_rad"]))
    squares = [
        (q[n][now + i] - q[n][now]) ** 2
        for n in range(48, 64)
        for now in range(19, len(q[n]) - 50, 10)
        for i in range(1, 26)
    ]
    assert found["q3", 0.25].rmse == pytest.approx(math.sqrt(statistics.fmean(squares)))
    assert found["q3", 0.25].count == len(squares) // 25


@with_arm
def test_the_file_of_the_arm_is_rebuilt_from_samples_of_its_source(tmp_path, monkeypatch):
    """As far as its figures are: the source has more digits."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import datasets_study

    (tmp_path / "data/PAMData/Data2").mkdir(parents=True)
    rows = np.loadtxt(FOLDER / ARM, delimiter=",", skiprows=1)
    for n in range(64):
        own = rows[rows[:, 0] == n]
        samples = np.hstack([own[:, 2:6], np.ones((len(own), 4)), own[:, 6:]])
        whole = {"ob": [[7.0] * 16, *samples.tolist()]}
        (tmp_path / f"data/PAMData/Data2/{n:02d}").write_text(json.dumps(whole))
    datasets_study.make(str(tmp_path), str(tmp_path))
    assert (tmp_path / ARM).read_bytes() == (FOLDER / ARM).read_bytes()
