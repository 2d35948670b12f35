"""A step of a study at work, in whichever process; and the look at all of them beforehand."""

from __future__ import annotations

import hashlib
import tempfile
import time
import warnings
from collections.abc import Container, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ..core.errors import InputError, PamError, UnknownNameError
from ..core.own_code import as_written
from .steps.step import Job, Made
from .study_file import Entry, Study


def work(
    entry: Entry,
    parts: Mapping[str, tuple[Entry, Mapping[str, bytes]]],
    cases: Sequence[Mapping[str, Any]],
    folder: Path,
    allow_code: bool,
) -> dict[str, Any]:
    """Do a step: {files, numbers, verdict, good, sure, text, html, seconds, when}: plain data.

    parts : {key: the step that it names, and that step's files}. cases : numbers of a sweep's
    cases. folder : of the study.
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
    doubts = dict.fromkeys(str(w.message) for w in heard if _ours(w))
    return {
        "files": files,
        "numbers": {n: (float(v), u) for n, (v, u) in made.numbers.items()},
        "verdict": made.verdict,
        "good": bool(made.good),
        "sure": [*made.sure, *doubts],
        "text": made.text,
        "html": _html(made),
        "seconds": time.perf_counter() - begin,
        "when": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _ours(heard: warnings.WarningMessage) -> bool:
    return heard.category.__module__.startswith(__package__.split(".")[0])


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
