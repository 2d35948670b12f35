"""Studies as job arrays: shards, some of them killed, and what a merge makes of them."""

import os
import random
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pam_ocp import InputError
from pam_ocp.cli.main import main
from pam_ocp.studies import run_study
from pam_ocp.studies.shards import Shard, shard_of
from pam_ocp.studies.study_file import read_study

STUDY = """
title = "Loads"

[steps.load]
kind = "plant"
arrangement = "HangingLoad"
muscle = "DMSP-20-300"
mass = "10 kg"

[steps.lifted]
kind = "simulate"
plant = "load"
inputs = { "muscle.command" = "3 bar" }
duration = "20 ms"
samples = 5

[steps.heavier]
kind = "sweep"
of = "lifted"
vary = { "load.mass" = [MASSES] }
numbers = ["x.last"]
"""


@pytest.fixture
def study(tmp_path) -> Path:
    return loads(tmp_path, 4)


def loads(folder: Path, count: int) -> Path:
    """The study with a sweep of so many masses."""
    path = folder / "loads.toml"
    path.write_text(STUDY.replace("MASSES", ", ".join(f'"{5 + i} kg"' for i in range(count))))
    return path


def files(folder: Path) -> dict[str, bytes]:
    """All that a study wrote, but for the page, which tells when and how long."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name not in ("report.html", ".in-use") and "shards" not in p.parts
    }


def test_shares_cover_all_steps_but_the_tables_of_sweeps(study):
    entries = read_study(study).entries
    shares = [Shard(k, 5).share(entries) for k in range(1, 6)]
    assert frozenset().union(*shares) == set(entries) - {"heavier"}
    assert all(set(entries[n].above) <= share for share in shares for n in share)
    assert max(map(len, shares)) < len(entries) - 1


@pytest.mark.parametrize("text", ["0/5", "6/5", "3", "a/b", "1/0", "-1/4", "1/999999999"])
def test_shards_that_cannot_be_are_refused(text):
    with pytest.raises(InputError, match="give K/N"):
        shard_of(text)


@pytest.mark.usefixtures("plain_pictures")
def test_merged_shards_are_the_study_in_one_go_and_missing_ones_are_named(tmp_path):
    study, out, cache = loads(tmp_path, 2), tmp_path / "out", tmp_path / "kept"
    with pytest.raises(InputError, match="no shard has run here"):
        run_study(study, out, cache=cache, merge=True)
    for number in (1, 3):
        run_study(study, out, cache=cache, shard=f"{number}/3")
    assert not (out / "report.html").exists()
    with pytest.raises(InputError, match=r"1 of 3 shards are not there: 2/3 never began"):
        run_study(study, out, merge=True)
    run_study(study, out, cache=cache, shard="2/3")
    merged = run_study(study, out, merge=True)  # the cache is the shards'
    assert merged.ok
    assert {s.state for n, s in merged.steps.items() if n != "heavier"} == {"kept"}
    run_study(study, tmp_path / "one", cache=tmp_path / "other")
    assert files(out) == files(tmp_path / "one")
    study.write_text(study.read_text().replace("10 kg", "11 kg"))
    with pytest.raises(InputError, match="another version of the study"):
        run_study(study, out, merge=True)
    with pytest.raises(InputError, match="shard or merge"):
        run_study(study, out, shard="1/3", merge=True)


STAYS = """
import sys
from pam_ocp.studies import run_study

def stop(step, done, count):
    print(step.name, flush=True)
    sys.stdin.readline()

shard = sys.argv[4] if sys.argv[4] != "-" else None
run_study(sys.argv[1], sys.argv[2], cache=sys.argv[3], shard=shard, progress=stop)
"""


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize("shard", ["1/2", None])
def test_two_processes_in_one_folder_are_told_of_and_a_dead_one_is_named(tmp_path, shard):
    study, out, cache = loads(tmp_path, 2), tmp_path / "out", tmp_path / "kept"
    command = [sys.executable, "-c", STAYS, str(study), str(out), str(cache), shard or "-"]
    other = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    other.stdout.readline()  # it is at work
    with pytest.raises(InputError, match=f"another process is at work .*process {other.pid} on"):
        run_study(study, out, cache=cache, shard=shard)
    if shard:
        run_study(study, out, cache=cache, shard="2/2")
        with pytest.raises(InputError, match="1/2 is still at work"):
            run_study(study, out, merge=True)
    other.kill()
    other.communicate()
    if shard:
        with pytest.raises(
            InputError, match=rf"1/2 died at work \(process {other.pid} on .*1 steps"
        ):
            run_study(study, out, merge=True)
        run_study(study, out, cache=cache, shard=shard)
        assert run_study(study, out, merge=True).ok
    else:
        assert run_study(study, out, cache=cache).ok


CRASHES = """
import os, random, signal, sys
from pam_ocp.cli.main import main
from pam_ocp.studies import study as module

number, attempt = int(sys.argv[1]), int(sys.argv[2])
if attempt == 0 and number in {doomed}:
    whole = module._Run._done
    def done(self, *arguments):
        whole(self, *arguments)
        os.kill(os.getpid(), signal.SIGKILL)  # amid its work
    module._Run._done = done
sys.exit(main(["study", *sys.argv[3:]]))
"""


@pytest.mark.slow
def test_a_job_array_with_a_tenth_of_its_jobs_killed_is_the_same_bits(study, tmp_path):
    """A stub of a scheduler: as many jobs as there are shards, those that died once more."""
    count, out, cache = 6, tmp_path / "out", tmp_path / "kept"
    doomed = set(random.Random(1).sample(range(1, count + 1), max(1, count // 10)))
    script = tmp_path / "job.py"
    script.write_text(CRASHES.format(doomed=doomed))
    said = [str(study), "--out", str(out), "--cache", str(cache)]
    waiting, attempt = list(range(1, count + 1)), 0

    def job(number: int) -> int:
        shard = [*said, "--shard", f"{number}/{count}"]
        command = [sys.executable, str(script), str(number), str(attempt), *shard]
        return subprocess.run(command, stdout=subprocess.DEVNULL).returncode

    while waiting:
        with ThreadPoolExecutor(2) as pool:
            codes = dict(zip(waiting, pool.map(job, waiting), strict=True))
        waiting = [n for n, code in codes.items() if code]
        if attempt == 0:
            assert set(waiting) == doomed
            assert {codes[n] for n in doomed} == {-signal.SIGKILL}
            with pytest.raises(InputError, match="died at work"):
                run_study(study, out, merge=True)
        attempt += 1
        assert attempt < 4
    assert main(["study", str(study), "--out", str(out), "--merge"]) == 0
    run_study(study, tmp_path / "one", cache=tmp_path / "other")
    assert files(out) == files(tmp_path / "one")
    assert os.path.exists(out / "report.html")
