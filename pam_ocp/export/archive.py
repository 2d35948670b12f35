"""Is an FMU safe to unpack, and its XML safe to read? Asked before anything else looks at
the file.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path, PurePosixPath
from xml.parsers import expat

from ..core.errors import InputError
from ..core.files import members_of

MOST_FILES = 10_000
MOST_BYTES = 1 << 30
"""Of all files unpacked."""
MOST_XML_BYTES = 64 << 20
"""Of one XML file."""
_RATIO, _SMALL = 200, 32 << 20
"""A file may unpack to so many times its size, or to so many bytes: zeros shrink to a thousandth.
"""
_DEPTH = 100
_ROOT = "fmiModelDescription"
_SHOWN = 80


class UnsafeFileError(InputError):
    """An archive or a description that is not looked into any further."""


def require_safe(path: Path) -> None:
    """Raises UnsafeFileError with what is wrong: names, sizes, the root and entities of the XML.

    Raises zipfile.BadZipFile and OSError for what is no archive.
    """
    try:
        files = members_of(path)
    except InputError as error:
        raise UnsafeFileError(f"{error}: the archive is not unpacked") from None
    with zipfile.ZipFile(path) as archive:
        finding = _amount(files) or next(filter(None, map(_name, files)), "")
        if finding:
            raise UnsafeFileError(f"{finding}: the archive is not unpacked")
        names = [f.filename for f in files]
        if len(set(names)) < len(names):
            twice = next(n for i, n in enumerate(names) if n in names[:i])
            raise UnsafeFileError(f"{_shown(twice)} is in the archive twice: it is not unpacked")
        if "modelDescription.xml" not in names:
            raise UnsafeFileError("the archive has no modelDescription.xml, so it is no FMU")
        for file in files:
            if _is_read(file.filename):
                _require_plain(archive, file)


def _amount(files: list[zipfile.ZipInfo]) -> str:
    if len(files) > MOST_FILES:
        return f"the archive holds {len(files)} files, {MOST_FILES} are allowed"
    total = sum(f.file_size for f in files)
    if total > MOST_BYTES:
        return f"the archive unpacks to {total / 1e6:.0f} MB, {MOST_BYTES / 1e6:.0f} are allowed"
    for file in files:
        if file.file_size > max(_SMALL, _RATIO * file.compress_size):
            return (
                f"{_shown(file.filename)} unpacks from {file.compress_size / 1e6:.2g} MB to "
                f"{file.file_size / 1e6:.0f} MB, more than {_RATIO} times its size"
            )
    return ""


def _name(file: zipfile.ZipInfo) -> str:
    name = file.orig_filename
    if name.startswith("/") or re.match(r"[A-Za-z]:", name):
        return f"{_shown(name)} is an absolute path"
    if ".." in PurePosixPath(name).parts:
        return f"{_shown(name)} leads out of the archive's folder"
    if "\\" in name or "\0" in name or not name:
        return f"{_shown(name)} is no name of a file in an FMU"
    return ""


def _shown(name: str) -> str:
    return repr(name if len(name) <= _SHOWN else f"{name[:_SHOWN]}...")


def printable(text: str) -> str:
    """Words of a unit for a terminal: without codes that move its cursor."""
    return "".join(c if c.isprintable() else "?" for c in text)


# ---- XML -----------------------------------------------------------------------------------------


def _is_read(name: str) -> bool:
    """What FMPy parses."""
    return name in (
        "modelDescription.xml",
        "sources/buildDescription.xml",
        "terminalsAndIcons/terminalsAndIcons.xml",
        "icon/terminalsAndIcons.xml",
    )


def _require_plain(archive: zipfile.ZipFile, file: zipfile.ZipInfo) -> None:
    """XML of a sane size without a DOCTYPE (entities, files from elsewhere),
    with the right root.
    """
    name = file.filename
    if file.file_size > MOST_XML_BYTES:
        size = f"{file.file_size / 1e6:.0f} MB, {MOST_XML_BYTES / 1e6:.0f} are allowed"
        raise UnsafeFileError(f"{name} has {size}")
    parser = expat.ParserCreate()
    path: list[str] = []

    def doctype(*_: object) -> None:
        raise UnsafeFileError(f"{name} has a DOCTYPE, which may define entities; FMI has none")

    def opened(tag: str, attributes: dict[str, str]) -> None:
        if not path and name == "modelDescription.xml":
            _require_description(tag, attributes)
        path.append(tag)
        if len(path) > _DEPTH:
            raise UnsafeFileError(f"{name} has elements more than {_DEPTH} deep")

    parser.StartDoctypeDeclHandler = doctype
    parser.StartElementHandler = opened
    parser.EndElementHandler = lambda _: path.pop()
    try:
        with archive.open(file) as content:
            parser.ParseFile(content)
    except UnsafeFileError:
        raise
    except Exception as error:  # of expat and of zipfile's decompressors, many kinds
        raise UnsafeFileError(f"{name} cannot be read ({error})") from None


def _require_description(tag: str, attributes: dict[str, str]) -> None:
    if tag != _ROOT:
        raise UnsafeFileError(
            f"the root of modelDescription.xml is <{_shown(tag)[1:-1]}>, that of an FMU <{_ROOT}>"
        )
    version = attributes.get("fmiVersion", "")
    if not re.match(r"2\.0$|3\.\d", version):
        raise UnsafeFileError(
            f"modelDescription.xml has fmiVersion {_shown(version)}; FMI 2.0 and 3.0 are read"
        )
