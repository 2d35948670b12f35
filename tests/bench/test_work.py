"""Jobs in processes: progress, stops, time limits; a process that dies loses its job only."""

import asyncio
import functools
import inspect
import os
import time
import zipfile

import bench_jobs
import pytest

from pam_ocp.bench.jobs.data import look_at
from pam_ocp.bench.made import World
from pam_ocp.bench.work import JobFailed, JobStopped, Workshop


def in_shop(processes=1):
    """Runs a coroutine of a test with a shop, and closes that."""

    def decorated(test):
        @functools.wraps(test)
        def run(**given):
            async def whole():
                shop = Workshop(processes)
                try:
                    await asyncio.wait_for(test(shop, **given), 60)
                finally:
                    shop.close()

            asyncio.run(whole())

        signature = inspect.signature(test)
        run.__signature__ = signature.replace(parameters=[*signature.parameters.values()][1:])
        return run

    return decorated


async def until(condition):
    while not condition():
        await asyncio.sleep(0.01)


def alive(pid):
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    with open(f"/proc/{pid}/stat") as file:  # a zombie is not alive
        return file.read().rpartition(")")[2].split()[0] != "Z"


@in_shop()
async def test_a_job_gives_its_result_says_how_far_it_is_and_keeps_its_process_for_the_next(shop):
    said = []
    job = shop.start("me", "Add", bench_jobs.add, 2, b=3, changed=lambda j: said.append(j.said))
    assert await job == 5
    assert "half" in said
    first = await shop.start("me", "Who", bench_jobs.whoami)
    assert first == await shop.start("me", "Who", bench_jobs.whoami)
    assert first != os.getpid()


@pytest.mark.parametrize(
    ("function", "kind", "words"),
    [
        (bench_jobs.refuse, "InputError", r"^mass = -1 kg must be > 0 kg$"),
        (bench_jobs.fault, "ZeroDivisionError", "please report it"),
        (bench_jobs.no_plain_value, "RuntimeError", "no plain result"),
    ],
)
@in_shop()
async def test_what_a_job_raises_comes_back_in_words_and_the_process_goes_on(
    shop, function, kind, words
):
    with pytest.raises(JobFailed, match=words) as caught:
        await shop.start("me", "Fail", function)
    assert caught.value.kind == kind
    assert await shop.start("me", "Add", bench_jobs.add, 1) == 1


@in_shop()
async def test_a_process_that_dies_loses_its_job_only(shop):
    dying = shop.start("me", "Die", bench_jobs.die)
    after = shop.start("me", "Add", bench_jobs.add, 4)
    with pytest.raises(JobStopped, match="its process ended"):
        await dying
    assert await after == 4


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")
@in_shop()
async def test_a_stop_ends_the_process_and_what_it_started_at_once(shop):
    job = shop.start("me", "Compile", bench_jobs.with_child)
    await until(lambda: job.said)
    child = int(job.said)
    assert alive(child)
    job.stop()
    with pytest.raises(JobStopped):
        await job
    await until(lambda: not alive(child))
    assert job.state == "stopped"


@in_shop()
async def test_a_time_limit_ends_what_does_not_listen(shop, monkeypatch):
    monkeypatch.setattr("pam_ocp.bench.work.GRACE", 0.2)
    await shop.start("me", "Add", bench_jobs.add, 1)  # the process is there
    with pytest.raises(JobFailed, match=r"time_limit = 0\.3 s") as caught:
        await shop.start("me", "Loop", bench_jobs.endless_loop, time_limit=0.3)
    assert caught.value.kind == "OutOfTime"


@in_shop()
async def test_of_waiting_jobs_of_one_name_the_last_one_is_done(shop):
    blocking = shop.start("me", "Wait", bench_jobs.wait, 0.3)
    drags = [shop.start("me", "Plan", bench_jobs.add, i, latest="drag") for i in range(5)]
    other = shop.start("you", "Plan", bench_jobs.add, 9, latest="drag")
    for early in drags[:-1]:
        with pytest.raises(JobStopped, match="overtaken"):
            await early
    assert (await drags[-1], await other) == (4, 9)
    assert await blocking


@in_shop(processes=2)
async def test_who_has_nothing_running_comes_first(shop):
    order = []
    first = shop.start("greedy", "Wait", bench_jobs.wait, 60.0)
    await until(lambda: first.said)
    for i in range(4):
        done = shop.start("greedy", "Add", bench_jobs.add, i)
        done.future.add_done_callback(lambda f: order.append(("greedy", f.result())))
    last = shop.start("modest", "Add", bench_jobs.add, 7)
    last.future.add_done_callback(lambda f: order.append(("modest", f.result())))
    assert await last == 7
    assert order[0][0] == "greedy"  # only one place was free, and it had begun
    assert len(order) <= 2
    first.stop()
    await asyncio.gather(first, return_exceptions=True)


@in_shop(processes=2)
async def test_a_warm_job_goes_to_the_process_that_knows_it(shop):
    def who(owner):
        return shop.start(owner, "Who", bench_jobs.whoami, warm="plan")

    first, second = await asyncio.gather(who("a"), who("b"))
    assert first != second
    for _ in range(3):
        assert await who("b") == second
        assert await who("a") == first


@in_shop()
async def test_stopping_all_of_one_owner_leaves_the_others(shop):
    mine = [shop.start("me", "Wait", bench_jobs.wait) for _ in range(3)]
    yours = shop.start("you", "Add", bench_jobs.add, 3)
    shop.stop_all("me")
    results = await asyncio.gather(*mine, return_exceptions=True)
    assert all(isinstance(r, JobStopped) for r in results)
    assert await yours == 3


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")
def test_processes_end_with_a_page_that_is_killed(tmp_path):
    import subprocess
    import sys

    code = (
        "import asyncio, os, sys; sys.path.insert(0, sys.argv[1]); import bench_jobs\n"
        "from pam_ocp.bench.work import Workshop\n"
        "async def main():\n"
        "    job = Workshop(1).start('me', 'Wait', bench_jobs.wait,\n"
        "        changed=lambda j: print(j.said, flush=True) if j.said else None)\n"
        "    await job\n"
        "if __name__ == '__main__':\n"
        "    asyncio.run(main())\n"
    )
    script = tmp_path / "page.py"
    script.write_text(code, "utf-8")
    folder = os.path.dirname(bench_jobs.__file__)
    page = subprocess.Popen([sys.executable, script, folder], stdout=subprocess.PIPE, text=True)
    assert page.stdout is not None
    child = int(page.stdout.readline())
    assert alive(child)
    page.kill()
    page.stdout.close()
    page.wait()
    end = time.monotonic() + 20
    while alive(child) and time.monotonic() < end:
        time.sleep(0.05)
    assert not alive(child)


# ---- files that want to do harm ------------------------------------------------------------------
@in_shop()
async def test_a_file_that_unpacks_to_far_more_is_refused_by_its_directory(shop, tmp_path):
    (tmp_path / "files").mkdir()
    bomb = tmp_path / "files" / "0-bomb.xlsx"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", bytes(100 * 2**20))
    assert bomb.stat().st_size < 2**20
    item = {"name": "bomb.xlsx", "file": bomb.name, "said": {}}
    with pytest.raises(JobFailed, match=r"unpacks to 1 parts of 100 MiB"):
        await shop.start("me", "Read", look_at, World(tmp_path), item, time_limit=30.0)
