"""Studies as job arrays: shards, some of them killed, and what a merge makes of them."""

import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import refused
from job_array import array, drawn, loads, written

from pam_ocp import InputError
from pam_ocp.cli.main import main
from pam_ocp.studies import run_study
from pam_ocp.studies.shards import Shard, shard_of
from pam_ocp.studies.study_file import read_study


@pytest.fixture
def study(tmp_path) -> Path:
    return loads(tmp_path, 4)


def test_shares_cover_all_steps_but_the_tables_of_sweeps(study):
    entries = read_study(study).entries
    shares = [Shard(k, 5).share(entries) for k in range(1, 6)]
    assert frozenset().union(*shares) == set(entries) - {"heavier"}
    assert all(set(entries[n].above) <= share for share in shares for n in share)
    assert max(map(len, shares)) < len(entries) - 1


@pytest.mark.parametrize("text", ["0/5", "6/5", "3", "a/b", "1/0", "-1/4", "1/999999999"])
def test_shards_that_cannot_be_are_refused(text):
    refused("give K/N", shard_of, text)


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_merged_shards_are_the_study_in_one_go_and_missing_ones_are_named(tmp_path):
    study, out, cache = loads(tmp_path, 2), tmp_path / "out", tmp_path / "kept"
    refused("no shard has run here", run_study, study, out, cache=cache, merge=True)
    for number in (1, 3):
        run_study(study, out, cache=cache, shard=f"{number}/3")
    assert not (out / "report.html").exists()
    refused(r"1 of 3 shards are not there: 2/3 never began", run_study, study, out, merge=True)
    run_study(study, out, cache=cache, shard="2/3")
    merged = run_study(study, out, merge=True)  # the cache is the shards'
    assert merged.ok
    assert {s.state for n, s in merged.steps.items() if n != "heavier"} == {"kept"}
    run_study(study, tmp_path / "one", cache=tmp_path / "other")
    assert written(out) == written(tmp_path / "one")
    study.write_text(study.read_text().replace("10 kg", "11 kg"))
    refused("another version of the study", run_study, study, out, merge=True)
    refused("shard or merge", run_study, study, out, shard="1/3", merge=True)


def test_a_shard_checks_the_steps_that_it_runs_and_the_first_one_all(tmp_path):
    study, count = loads(tmp_path, 2), 6
    study.write_text(study.read_text().replace('"15.000 kg"', '"-15 kg"'))
    entries = read_study(study).entries
    shares = {k: Shard(k, count).share(entries) for k in range(1, count + 1)}
    wrong = {k for k, steps in shares.items() if any("heavier 2" in n for n in steps)} - {1}
    assert wrong
    assert len(wrong) < count - 1
    for number in shares:
        if number in wrong | {1}:
            with pytest.raises(InputError, match=r"steps\.load\[heavier 2\]: .*mass"):
                run_study(study, tmp_path / "out", cache=tmp_path, shard=f"{number}/{count}")
        else:
            assert run_study(study, tmp_path / "out", cache=tmp_path, shard=f"{number}/{count}").ok


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
        refused("1/2 is still at work", run_study, study, out, merge=True)
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


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_a_job_array_with_a_tenth_of_its_jobs_killed_is_the_same_bits(study, tmp_path):
    """Six jobs; ``benchmarks/many.py --array`` has 50."""
    count, out = 6, tmp_path / "out"
    doomed = drawn(count, random.Random(1))
    said = [study, "--out", out, "--cache", tmp_path / "kept"]
    assert set(array(said, out, count, doomed)) == doomed
    assert main(["study", str(study), "--out", str(out), "--merge"]) == 0
    run_study(study, tmp_path / "one", cache=tmp_path / "other")
    assert written(out) == written(tmp_path / "one")
    assert (out / "report.html").exists()


SNAKEFILE = Path(__file__).parents[2] / "examples" / "Snakefile"


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_the_commands_of_the_snakemake_example_make_the_report(study, tmp_path, monkeypatch):
    """Its rules' words, filled in as Snakemake does, for two shards."""
    rules = dict(re.findall(r'rule (\w+):.*?shell: "pam-ocp ([^"]+)"', SNAKEFILE.read_text(), re.S))
    assert set(rules) == {"merged", "shard"}
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        words = rules["shard"].replace("{wildcards.k}", str(number))
        assert main(words.format(STUDY=study.name, SHARDS=2).split()) == 0
    assert main(rules["merged"].format(STUDY=study.name).split()) == 0
    assert (tmp_path / "out" / "report.html").is_file()


def test_snakemake_plans_one_job_for_each_shard(study):
    snakemake = shutil.which("snakemake")
    if snakemake is None:
        pytest.skip("snakemake is not installed")
    said = ["--snakefile", str(SNAKEFILE), "--config", f"study={study.name}", "shards=3"]
    command = [snakemake, *said, "--dry-run", "--cores", "1"]
    run = subprocess.run(command, cwd=study.parent, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("rule shard:") == 3
