"""What files hold, for the tab Data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...core.trajectory import Trajectory
from ...fitting.tables.force_table import ForceTable
from ..made import World, preview_of
from ..work import Say, job

MOST_SAMPLES = 1500
"""Of each curve of a record that is drawn."""
MOST_RECORDS = 4
"""Records that are drawn."""


@job("Reading {}", time_limit=60.0, warm="data")
def look_at(say: Say, world: World, item: Mapping[str, Any]) -> dict[str, Any]:
    """The preview of an item as plain values, with its cells or the curves of its records."""
    seen = preview_of(world, item)
    found = seen.to_dict()
    found["call"] = seen.call.replace(f"{world.folder}/", "")
    found["source"] = str(item["name"])
    if isinstance(seen.result, ForceTable):
        table = seen.result
        found["cells"] = {
            "pressure": table.pressure,
            "contraction": table.contraction,
            "force": table.force,
            "branch": list(table.branch),
            "run": list(table.run),
            "file": list(table.file),
            "rest_length": table.rest_length,
        }
    elif seen.result:
        found["records"] = [_curves(record) for record in seen.result[:MOST_RECORDS]]
        found["count"] = len(seen.result)
    return found


def _curves(record: Trajectory) -> dict[str, Any]:
    """A record's curves in display units, thinned out by keeping lows and highs."""
    chosen = _thinned(record)
    curves = []
    for name in record.names:
        variable = record.variable(name)
        values = record[name][chosen] / variable.display_factor
        curves.append({"name": name, "unit": variable.display_unit, "values": values})
    return {"t": record.t[chosen], "curves": curves}


def _thinned(record: Trajectory) -> Any:
    n = len(record.t)
    if n <= MOST_SAMPLES:
        return np.arange(n)
    parts = np.array_split(np.arange(n), MOST_SAMPLES // 4)
    first = record[record.names[0]]
    kept = {0, n - 1}
    for part in parts:
        kept |= {int(part[0]), int(part[np.argmin(first[part])]), int(part[np.argmax(first[part])])}
    return np.array(sorted(kept))
