"""All that a result rests on in one archive: an RO-Crate 1.1 (https://w3id.org/ro/crate/1.1)."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from ..core.errors import InputError, PamError
from ..core.files import atomic_path, require_ending, require_file
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..export.assembly import write_archive
from .report import versions, write_report
from .tables import save_result

CRATE = "https://w3id.org/ro/crate/1.1"
METADATA = "ro-crate-metadata.json"
DIGEST = {"sha256": "https://schema.org/sha256"}
"""A term of schema.org that is younger than RO-Crate's context."""
PROJECT = "https://pypi.org/project"
FORMATS = {
    ".csv": "text/csv",
    ".fmu": "application/zip",
    ".html": "text/html",
    ".json": "application/json",
    ".npz": "application/zip",
    ".parquet": "application/vnd.apache.parquet",
    ".pdf": "application/pdf",
    ".png": "image/png",
    ".py": "text/x-python",
    ".toml": "application/toml",
    ".txt": "text/plain",
    ".xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet",
}
Entity = dict[str, Any]


@verb
def save_crate(
    path: str | os.PathLike[str],
    things: Mapping[str, Any],
    *,
    licence: str,
    title: str = "Results",
    text: str = "",
    author: str | None = None,
    sources: Sequence[str | os.PathLike[str]] = (),
    script: str | os.PathLike[str] | None = None,
    published: str | None = None,
) -> Path:
    """Write one archive (.zip) for a repository of data, an RO-Crate 1.1: sources, script,
    report.html, each thing as numbers (JSON or NPZ, and CSV), versions, digests; returns its path.

    things : {heading: object}, as :func:`write_report` takes them. licence : an SPDX identifier
    ("CC-BY-4.0") or an address. published : day of publication, "2026-11-30"; by default today.
    The same content of the same day gives the same bytes.

    Raises InputError for another ending than .zip, two files of one name, and what cannot be read.

    Examples
    --------
    >>> pam.figures.save_crate("fit.zip", {"The fit": fit}, licence="CC-BY-4.0").name
    'fit.zip'
    """
    require_ending(path, ".zip", "a crate")
    licensed = _licence(licence)
    day = date.today().isoformat() if published is None else _day(published)
    files = {f"data/{Path(s).name}": require_file(s).read_bytes() for s in sources}
    if len(files) < len(sources):
        raise InputError("sources holds two files of one name: rename one")
    if script is not None:
        files[f"script/{Path(script).name}"] = require_file(script).read_bytes()
    given = list(files)
    with TemporaryDirectory() as folder:
        used = [*sources, *([] if script is None else [script])]
        page = Path(folder, "report.html")
        write_report(page, things, title=title, text=text, sources=used)
        for i, (heading, thing) in enumerate(things.items(), start=1):
            slug = re.sub(r"\W+", "_", heading, flags=re.ASCII).strip("_").lower()[:40]
            _write(thing, Path(folder, f"{i:02d}_{slug}".rstrip("_")))
        for file in sorted(Path(folder).iterdir()):
            name = file.name if file.name == "report.html" else f"results/{file.name}"
            files[name] = file.read_bytes()
    root: Entity = {"@id": "./", "@type": "Dataset", "name": title, "datePublished": day}
    root |= {"description": text or f"{title}: {', '.join(things)}", "license": _link(licensed)}
    root |= {"hasPart": [{"@id": quote(name)} for name in files], "mentions": {"@id": "#run"}}
    if author is not None:
        root["author"] = {"@id": "#author"}
    about: Entity = {"conformsTo": {"@id": CRATE}, "about": {"@id": "./"}}
    descriptor = {"@id": METADATA, "@type": "CreativeWork", **about}
    graph = [descriptor, root, *(_file(n, c) for n, c in files.items()), licensed]
    graph += [] if author is None else [{"@id": "#author", "@type": "Person", "name": author}]
    graph += _run(given, [n for n in files if n not in given])
    words = {"@context": [f"{CRATE}/context", DIGEST], "@graph": graph}
    files[METADATA] = json.dumps(words, indent=1, ensure_ascii=False).encode()
    with atomic_path(path) as temporary:
        write_archive(temporary, files)
    return Path(path)


def _write(thing: Any, stem: Path) -> None:
    """A result's own file, and its numbers as CSV."""
    motion = thing
    with suppress(AttributeError, PamError):  # no motion, or none that was solved
        motion = thing if isinstance(thing, Trajectory) else thing.trajectory
    moves = isinstance(motion, Trajectory)
    with suppress(AttributeError, PamError):  # its numbers say what there is
        thing.save(stem.with_suffix(".npz" if moves else ".json"))
    csv = stem.with_suffix(".csv")
    motion.save(csv) if moves else save_result(thing, csv)


def _file(name: str, content: bytes) -> Entity:
    source = name.startswith("script/")
    return {
        "@id": quote(name),
        "@type": ["File", "SoftwareSourceCode"] if source else "File",
        "name": Path(name).name,
        "encodingFormat": FORMATS.get(Path(name).suffix.lower(), "application/octet-stream"),
        "contentSize": str(len(content)),
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _run(given: Sequence[str], made: Sequence[str]) -> list[Entity]:
    """The run that made the results, and the software with its versions."""
    found: list[Entity] = [
        {"@id": f"{PROJECT}/{n}/{v}/", "@type": "SoftwareApplication", "name": n, "version": v}
        for n, v in versions().items()
    ]
    found[0]["softwareRequirements"] = [_link(one) for one in found[1:]]
    run: Entity = {"@id": "#run", "@type": "CreateAction", "instrument": _link(found[0])}
    run |= {"name": "The run that made the results", "object": [{"@id": quote(n)} for n in given]}
    return [run | {"result": [{"@id": quote(n)} for n in made]}, *found]


def _link(entity: Entity) -> Entity:
    return {"@id": entity["@id"]}


def _licence(licence: str) -> Entity:
    if not isinstance(licence, str) or not re.fullmatch(r"https?://\S+|[A-Za-z0-9.+-]+", licence):
        given = "licence is missing" if licence is None else f"licence = {licence!r}"
        raise InputError(f"{given}: give an SPDX identifier such as 'CC-BY-4.0', or an address")
    address = licence if "://" in licence else f"https://spdx.org/licenses/{licence}"
    about = {"name": licence, "description": f"The terms of {licence}: see {address}"}
    return {"@id": address, "@type": "CreativeWork", **about}


def _day(published: str) -> str:
    try:
        return date.fromisoformat(published).isoformat()
    except (TypeError, ValueError):
        raise InputError(f"published = {published!r}: give a day such as '2026-11-30'") from None
