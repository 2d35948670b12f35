"""The worlds whose exporters stand elsewhere in this room: FMU, SSP and C code."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..c_code.package import export_c
from ..package import export_fmu
from ..ssp import export_ssp
from .registry import ENDINGS, WORLDS

__all__: list[str] = []

WORLDS.register("fmu")(export_fmu)
WORLDS.register("c")(export_c)
ENDINGS[".fmu"], ENDINGS[".ssp"] = "fmu", "ssp"


@WORLDS.register("ssp")
def _ssp(
    components: Any, path: str | os.PathLike[str], *, connections: Mapping[str, str], **options: Any
) -> Path:
    """Several components as an SSP; see :func:`pam_ocp.export_ssp`."""
    return export_ssp(components, connections, path, **options)
