"""setuptools, whose archives are the same to the last bit whenever and by whomever they are built.

Members stand in the order of their names, with the rights that anybody may have and one time:
SOURCE_DATE_EPOCH, or the first day of 1980, the earliest that a zip file knows.
"""

from __future__ import annotations

import gzip
import io
import os
import tarfile
import time
import zipfile
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 - all hooks but the two below

EARLIEST = 315532800


def build_sdist(sdist_directory: str, config_settings: Any = None) -> str:
    """The source archive."""
    name: str = build_meta.build_sdist(sdist_directory, config_settings)
    path = Path(sdist_directory) / name
    packed = io.BytesIO()
    with tarfile.open(path) as given, tarfile.open(fileobj=packed, mode="w") as level:
        for member in sorted(given.getmembers(), key=lambda m: m.name):
            member.mtime, member.mode = _moment(), _rights(member.mode, member.isdir())
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.pax_headers = {}
            level.addfile(member, given.extractfile(member) if member.isfile() else None)
    path.write_bytes(gzip.compress(packed.getvalue(), mtime=0))
    return name


def build_wheel(
    wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None
) -> str:
    """The wheel."""
    name: str = build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
    path = Path(wheel_directory) / name
    packed = io.BytesIO()
    with zipfile.ZipFile(path) as given, zipfile.ZipFile(packed, "w") as level:
        # the record stays last, as wheels want it
        for member in sorted(given.infolist(), key=_place):
            plain = zipfile.ZipInfo(member.filename, time.gmtime(_moment())[:6])
            plain.compress_type = zipfile.ZIP_DEFLATED
            plain.external_attr = (0o100000 | _rights(member.external_attr >> 16, False)) << 16
            level.writestr(plain, given.read(member))
    path.write_bytes(packed.getvalue())
    return name


def _place(member: zipfile.ZipInfo) -> tuple[bool, str]:
    return member.filename.endswith("/RECORD"), member.filename


def _moment() -> int:
    return max(EARLIEST, int(os.environ.get("SOURCE_DATE_EPOCH", EARLIEST)))


def _rights(mode: int, folder: bool) -> int:
    return 0o755 if folder or mode & 0o100 else 0o644
