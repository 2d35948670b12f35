"""A whole study out of one file: only what changed is run, into one folder with one report; and a
step at work, in whichever process.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import time
import uuid
import warnings
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import partial
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from ..core.atomic import in_use
from ..core.cases import results_of
from ..core.digest import file_digest, own_digest
from ..core.errors import InputError, PamError, UnknownNameError, require_count, with_kinds
from ..core.executors import Place, end_pool, placed
from ..core.files import atomic_path, make_folder, read_json, reading, write_json
from ..core.interrupts import interruptible
from ..core.own_code import as_written, content_digest
from ..core.progress import Bar, working
from ..core.stop import check, limited
from .shards import ShardRecord, merged_cache, shard_of
from .steps.step import Job, Made
from .study_file import HELP, Entry, Study, read_study
from .study_result import Kept, StudyResult, StudyStep, key_of, study_report, summary, versions

LOG = logging.getLogger(__name__)
MANIFEST = "study.json"
FORMAT = "pam_ocp study 1"
REPORT = "report.html"
SUMMARY = "summary.csv"


@with_kinds
def run_study(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    workers: int = 1,
    executor: Place = None,
    allow_code: bool = False,
    fresh: bool = False,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[StudyStep, int, int], None] | None = None,
    time_limit: float | None = None,
    shard: str | None = None,
    merge: bool = False,
) -> StudyResult:
    """Run a study file: what changed since the last run, and what stands on it.

    Parameters
    ----------
    path : of the file (TOML); see docs/studies.md.
    out : folder for figures, tables, parameter files, FMUs and the report; by default named as the
        file, in the working folder. A file of an earlier run that no step writes any more is
        removed, unless it was changed.
    workers : processes for steps that do not stand on each other; 1 runs all in this one.
    executor : any ``concurrent.futures.Executor`` instead, or a client of Dask; its workers see
        the study's folder under the same name. A number means as many ``workers``. A step whose
        worker is lost is done once more, in a process of its own.
    allow_code : the study may run code: a plant named FILE.py:NAME, an FMU that it names.
    fresh : do all of it anew. cache : folder for kept results (by default the user's own). They are
        Python's pickles: name none that others can write to.
    progress : called with each step that ended, how many did, and how many there are.
    time_limit : [s]; OutOfTime when it is over. What was done until then is kept.
    shard : "17/200": run the 17th of 200 shares of the steps, for a job array; the results stay
        among the kept ones, in a ``cache`` that all jobs see. merge : put together what the shards
        made; one that died, or has not come to its end, is named.

    Results are kept by the digest of what goes into a step: its keys, the contents of the files
    that it names, the results that it stands on, this package and those below it. A run that ends
    early, even by kill -9, is gone on with by the next one.

    Raises InputError, before anything runs, for an invalid file. A step that fails ends
    what stands on it; the others go on, and the report tells.

    Examples
    --------
    >>> from pathlib import Path
    >>> said = "steps.mine = { kind = 'muscle', name = 'DMSP-20-300' }"
    >>> _ = Path("study.toml").write_text(said)
    >>> result = pam.studies.run_study("study.toml", cache="kept")
    >>> result.ok, result.report.name
    (True, 'report.html')
    """
    require_count("workers", workers, 1)
    if executor is not None and workers != 1:
        raise InputError("give executor or workers, not both")
    where = placed(executor)
    workers = max(1, where) if isinstance(where, int) else workers
    where = None if isinstance(where, int) else where
    if shard is not None and merge:
        raise InputError("give shard or merge, not both")
    share = None if shard is None else shard_of(shard)
    study = read_study(Path(path))
    kept = Kept(cache)  # before the folder: where it cannot be, there is nothing to clear away
    target = make_folder(Path(study.path.stem) if out is None else out)
    if merge:
        found = merged_cache(target, file_digest(study.path))
        kept = Kept(found) if cache is None else kept
    record = None
    if share is not None:
        record = ShardRecord(target, share, file_digest(study.path), kept.folder)
    with (
        interruptible(),
        in_use(target) if record is None else record.working(),
        limited(time_limit),
        _pool(where, workers) as pool,
        working("study", len(study.entries)) as bar,
    ):
        own = frozenset(study.entries if share is None else share.share(study.entries))
        checked = study.entries if share is None or share.number == 1 else own
        run = _Run(study, target, kept, allow_code, fresh, progress, bar, own, checked, record)
        run.prepare()
        run.go(pool, ours=where is None)
        return run.finish()


@contextmanager
def _pool(executor: Executor | None, workers: int) -> Iterator[Executor | None]:
    """The executor, or one of our own whose processes end with this one."""
    if executor is not None or workers == 1:
        yield executor
        return
    from ..core.workers import end_with_parent

    pool = ProcessPoolExecutor(workers, initializer=end_with_parent)
    try:
        yield pool
    except BaseException:
        end_pool(pool)
        raise
    pool.shutdown()


@dataclass
class _Run:
    """A study on its way: which steps ended, with what.

    share : the steps that are run here, all or those of a shard. checked : those that are looked
    at before: what they are, for all shards but the first.
    """

    study: Study
    out: Path
    kept: Kept
    allow_code: bool
    fresh: bool
    progress: Callable[[StudyStep, int, int], None] | None
    bar: Bar
    share: frozenset[str]
    checked: Container[str]
    record: ShardRecord | None

    def __post_init__(self) -> None:
        study = self.study
        self.steps: dict[str, StudyStep] = {}
        self.keys: dict[str, str] = {}
        self.found: dict[str, dict[str, Any]] = {}
        """Of the steps that were kept: their results."""
        found = {name: study.behind(entry) for name, entry in study.entries.items()}
        self.files = {name: sorted(behind.files) for name, behind in found.items()}
        """What each names: looked up once, for files may come and go while it runs."""
        self.doubts = {name: behind.doubts for name, behind in found.items() if behind.doubts}
        self.inputs = {p: file_digest(p) for files in self.files.values() for p in files}
        self.contents = {p: content_digest(p) for p in self.inputs}

    # ---- before anything runs -----------------------------------------------------------------
    def prepare(self) -> None:
        """Find what is kept; where something must run, look at all of the file first."""
        if self.allow_code and self.doubts:
            said = "; ".join(f"{n}: {', '.join(dict.fromkeys(d))}" for n, d in self.doubts.items())
            warnings.warn(
                f"steps that cannot be told from others are done anew ({said})", stacklevel=5
            )
        for name, entry in self.study.entries.items():
            if name in self.share and all(n in self.found for n in entry.above):
                self.keys[name] = self._key(entry)
                found = None if self.fresh else self.kept.get(self.keys[name])
                if found is not None:
                    self.found[name] = found
        if len(self.found) < len(self.share):
            with reading(self.study.path, "a study", HELP):
                rehearse(self.study, self.allow_code, self.checked)

    def _key(self, entry: Entry) -> str:
        """The digest of all that goes into a step whose parts are there."""
        parts = {key: self._identity(n) for key, n in entry.parts.items()}
        cases = [key_of(self.found[n]["numbers"]) for n in entry.cases]
        said = {n: v for n, v in entry.said.items() if n not in entry.parts}
        files = [(p.name, self.contents[p]) for p in self.files[entry.name]]
        made_by = [versions(), own_digest(), self._code(entry)]
        return key_of([entry.kind, said, parts, cases, files, made_by, self.allow_code])

    def _code(self, entry: Entry) -> list[str]:
        """What the code of the user's is that a step may run, in its own files or its parts'."""
        named = [f for f in self.files[entry.name] if f.suffix == ".py"]
        own = [self.contents[f] for f in self.files[entry.name]] if named else []
        own += [uuid.uuid4().hex] if self._untold(entry.name) else []  # as no other: done anew
        return own + [c for n in entry.above for c in self._code(self.study.entries[n])]

    def _untold(self, name: str) -> bool:
        """Whether a step, or one that it stands on, runs code that cannot be told from other."""
        if self.allow_code and name in self.doubts:
            return True
        return any(self._untold(n) for n in self.study.entries[name].above)

    def _identity(self, name: str) -> str:
        """Of a step that another stands on: of its files, or of all that went into it."""
        entry = self.study.entries[name]
        if entry.step.whole:
            return self.keys[name]
        return digest_of_files(self.found[name]["files"], entry.step.offers)

    # ---- running ------------------------------------------------------------------------------
    def go(self, pool: Executor | None, *, ours: bool) -> None:
        """All steps, each when what it stands on has ended.

        ours : a pool that ends with an error. Futures that were cancelled before would end it with
        a trace (Python below 3.12).
        """
        entries = self.study.entries
        graph = TopologicalSorter({n: entries[n].above for n in entries if n in self.share})
        graph.prepare()
        pending: dict[Any, tuple[str, tuple[Any, ...]]] = {}
        try:
            while graph.is_active():
                for name in graph.get_ready():
                    check()
                    job = self._begun(name)
                    if job is None:
                        graph.done(name)
                    elif pool is None:
                        self._ended(name, partial(work, *job))
                        graph.done(name)
                    else:
                        with suppress(BrokenExecutor):
                            pending[pool.submit(work, *job)] = name, job
                            continue
                        self._ended(name, partial(_alone, job))
                        graph.done(name)
                for future in _first(pending):
                    name, job = pending.pop(future)
                    error = future.exception()  # steps themselves end in errors of ours
                    lost = error is not None and not isinstance(error, PamError)
                    self._ended(name, partial(_alone, job) if lost else future.result)
                    graph.done(name)
        finally:
            for future in pending if not ours else ():
                future.cancel()

    def _begun(self, name: str) -> tuple[Any, ...] | None:
        """What ``work`` takes; None where there is nothing to do."""
        entry = self.study.entries[name]
        broken = [n for n in entry.parts.values() if self.steps[n].state in ("failed", "left out")]
        if broken:
            said = f"stands on {broken[0]}, which is {self.steps[broken[0]].state}"
            self._tell(StudyStep(name, entry.kind, "left out", said, False))
            return None
        for case in entry.cases:  # a sweep tells of those that failed
            self.found.setdefault(case, {"numbers": None, "files": {}})
        self.keys[name] = self._key(entry)
        found = self.found.get(name) or (None if self.fresh else self.kept.get(self.keys[name]))
        if found is not None:
            self._done(entry, "kept", found)
            return None
        parts = {k: self._part(n) for k, n in entry.parts.items()}
        cases = [self.found[n]["numbers"] for n in entry.cases]
        return entry, parts, cases, self.study.path.parent.absolute(), self.allow_code

    def _part(self, name: str) -> tuple[Entry, Mapping[str, bytes]]:
        """A step that another stands on, and the files that it is read from."""
        entry = self.study.entries[name]
        kinds = (".toml", ".py", ".npz", ".json", ".fmu")
        files = self.found[name]["files"]
        return entry, {n: c for n, c in files.items() if Path(n).suffix in kinds}

    def _ended(self, name: str, result: Callable[[], dict[str, Any]]) -> None:
        entry = self.study.entries[name]
        try:
            found = result()
        except PamError as error:
            self._tell(StudyStep(name, entry.kind, "failed", str(error), False))
            return
        if not self._untold(name):
            self.kept.put(self.keys[name], found)
        self._done(entry, "done", found)

    def _done(self, entry: Entry, state: str, found: dict[str, Any]) -> None:
        self.found[entry.name] = found
        folder = self.out / entry.place
        for name, content in found["files"].items() if self.record is None else ():
            _write(folder / name, content)
        numbers = {n: (float(v), u) for n, (v, u) in found["numbers"].items()}
        said = found["verdict"], found["good"], numbers, found["seconds"], folder, found
        self._tell(StudyStep(entry.name, entry.kind, state, *said))

    def _tell(self, step: StudyStep) -> None:
        self.steps[step.name] = step
        LOG.info("%s: %s; %s", step.name, step.state, step.verdict)
        self.bar.step(note=step.name)
        if self.record is not None:
            self.record.ended(step.name, step.state)
        if self.progress is not None:
            self.progress(step, len(self.steps), len(self.share))

    # ---- behind the last ----------------------------------------------------------------------
    def finish(self) -> StudyResult:
        """Summary, report, and the list of all that was written."""
        steps = {n: self.steps[n] for n in self.study.entries if n in self.share}
        if self.record is not None:  # what it made is kept; the merge writes the folder
            return StudyResult(self.study.title, self.out, steps, self.out / REPORT)
        digests = {"study": file_digest(self.study.path)}
        digests |= {os.path.relpath(p, self.study.path.parent): d for p, d in self.inputs.items()}
        _write(self.out / SUMMARY, summary(steps).encode())
        page = study_report(self.study, steps, digests)
        _write(self.out / REPORT, page.encode())
        self._tidy(steps, digests)
        self.kept.trim()
        return StudyResult(self.study.title, self.out, steps, self.out / REPORT)

    def _tidy(self, steps: Mapping[str, StudyStep], digests: Mapping[str, str]) -> None:
        """The list of files; those that an earlier run wrote and nobody changed go."""
        written = {
            f"{self.study.entries[n].place}/{file}": _sha(content)
            for n, s in steps.items()
            for file, content in s.made.get("files", {}).items()
        }
        place = self.out / MANIFEST
        before: dict[str, Any] = {}
        if place.is_file():
            try:
                before = read_json(place, "a study's list", FORMAT, "").get("files", {})
            except InputError:
                before = {}
        for name, digest in before.items():
            path = self.out / name
            if name in written or not isinstance(digest, str) or not path.is_file():
                continue
            inside = path.resolve().is_relative_to(self.out.resolve())
            if inside and _sha(path.read_bytes()) == digest:
                path.unlink()
                _remove_empty(path.parent, self.out)
        content = {"format": FORMAT, "title": self.study.title, "digests": dict(digests)}
        content |= {"versions": dict(versions()), "files": written}
        content["steps"] = {
            n: {"kind": s.kind, "verdict": s.verdict, "good": s.good, "key": self.keys.get(n, "")}
            for n, s in steps.items()
        }
        write_json(place, content)


def _alone(job: tuple[Any, ...]) -> dict[str, Any]:
    """A step whose worker was lost, once more: nothing is beside it, and nothing it can harm."""
    (found,) = results_of(_work, [job], executor=1, what=job[0].name)
    made: dict[str, Any] = found
    return made


def _work(job: tuple[Any, ...]) -> dict[str, Any]:
    """``work`` for one argument."""
    return work(*job)


def _first(pending: Mapping[Any, Any]) -> list[Any]:
    """Those of the futures that have ended, waiting for one."""
    if not pending:
        return []
    if all(isinstance(f, Future) for f in pending):
        while True:
            done = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED).done
            if done:
                return list(done)
            check()
    return [next(iter(pending))]  # futures of a class of their own are asked in order


def _write(path: Path, content: bytes) -> None:
    """Where the file does not hold that already."""
    if path.is_file() and path.read_bytes() == content:
        return
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _remove_empty(folder: Path, top: Path) -> None:
    while folder != top and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent


# ---- a step at work, in whichever process; the look at all of them beforehand --------------------
def work(
    entry: Entry,
    parts: Mapping[str, tuple[Entry, Mapping[str, bytes]]],
    cases: Sequence[Mapping[str, Any] | None],
    folder: Path,
    allow_code: bool,
) -> dict[str, Any]:
    """Do a step: {files, numbers, verdict, good, sure, text, html, seconds, when}: plain data.

    parts : {key: the step that it names, and that step's files}. cases : numbers of a sweep's
    cases, None of those that failed. folder : of the study.
    """
    begin = time.perf_counter()
    with as_written(), tempfile.TemporaryDirectory(prefix="pam_ocp_") as place:
        nouns: dict[str, Any] = {"cases": cases} if cases else {}
        sources = {}
        for key, (named, files) in parts.items():
            source = sources[key] = _unpacked(Path(place) / f"of-{key}", files)
            job = Job(named.name, named.said, {}, folder, source, allow_code)
            nouns[key] = named.step.read(entry.step.parts[key], job)
        out = Path(place) / "out"
        out.mkdir()
        job = Job(entry.name, entry.said, nouns, folder, out, allow_code, sources)
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            made = entry.step.work(job)
        files = {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.rglob("*.*"))}
    ours = __package__.split(".")[0]
    own = (w for w in heard if w.category.__module__.startswith(ours))
    return {
        "files": files,
        "numbers": {n: (float(v), u) for n, (v, u) in made.numbers.items()},
        "verdict": made.verdict,
        "good": bool(made.good),
        "sure": [*made.sure, *dict.fromkeys(str(w.message) for w in own)],
        "text": made.text,
        "html": _html(made),
        "seconds": time.perf_counter() - begin,
        "when": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _unpacked(folder: Path, files: Mapping[str, bytes]) -> Path:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


def _html(made: Made) -> str:
    """As in a notebook, without the picture, which is a file of its own."""
    from ..figures.sheets import html_of

    return "" if made.thing is None else html_of(made.thing, dpi=0)


def digest_of_files(files: Mapping[str, bytes], offers: Mapping[str, str]) -> str:
    """Of the files that other steps read: what is offered, and what lies beside it for that."""
    found = hashlib.sha256()
    kinds = {Path(n).suffix for n in offers.values()} | {".py", ".toml"}
    for name in sorted(files):
        if name in offers.values() or Path(name).suffix in kinds:
            found.update(f"{name}\0{len(files[name])}\0".encode())
            found.update(files[name])
    return found.hexdigest()


def rehearse(study: Study, allow_code: bool, steps: Container[str]) -> None:
    """All that can be said against steps of a study before anything runs. Raises InputError.

    steps : each with those that it stands on. Where a noun is not made yet (a muscle that a fit
    will give), another of its kind stands in.
    """
    nouns: dict[str, dict[str, Any]] = {}
    for name, entry in study.entries.items():
        if name not in steps:
            continue
        parts = {k: nouns[n].get(entry.step.parts[k]) for k, n in entry.parts.items()}
        job = Job(name, entry.said, parts, study.path.parent, Path(), allow_code)
        try:
            with as_written(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the work itself will warn
                nouns[name] = entry.step.check(job)
        except PamError as error:
            raise InputError(f"steps.{name}: {error}{_steps(study, entry, error)}") from error


def _steps(study: Study, entry: Entry, error: PamError) -> str:
    """The steps that could have been meant where a name is not known."""
    nouns = {entry.step.parts[k] for k in entry.step.loose if k not in entry.parts}
    if not isinstance(error, UnknownNameError) or not any(f" {n} '" in str(error) for n in nouns):
        return ""
    able = [n for n, e in study.entries.items() if nouns & set(e.step.offers) and "[" not in n]
    return f"; or a step: {', '.join(able)}" if able else ""
