"""The tutorial's workbook, as a rig would have written it: ``python docs/rig.py`` makes it anew.

Computed, not measured: the law of DMSP-20-300, weakened by 4 %, with 6 N between filling and
venting and 2 N of noise, in whole newtons; one reading slipped.
"""

from datetime import datetime
from pathlib import Path

import numpy as np
from openpyxl import Workbook

import pam_ocp as pam


def main(path: Path) -> None:
    law, rng = pam.muscle("DMSP-20-300").law, np.random.default_rng(7)
    book = Workbook()
    book.properties.created = book.properties.modified = datetime(2026, 3, 12)
    cover = book.active
    cover.title = "Cover"
    cover.append(["Rig 3, Muscle M7"])
    sheet = book.create_sheet("Readings")
    sheet.append(["Muscle M7, 20 mm x 300 mm, 12 March 2026"])
    sheet.append([])
    sheet.append(["direction", "pressure", "length", "force", "remark"])
    sheet.append([None, "bar", "mm", "N", None])
    for length in (300, 290, 280, 270, 260, 250, 240):
        for direction, offset in (("filling", -3.0), ("venting", 3.0)):
            pressures = np.arange(0.5, 6.1, 0.5)
            for bar in pressures if direction == "filling" else pressures[::-1]:
                tension = 0.96 * float(law.tension(bar * 1e5, 1 - length / 300)) + offset
                force = max(0, round(tension + 2.0 * rng.standard_normal()))
                slipped = (direction, bar, length) == ("filling", 4.0, 270)
                remark = "clamp slipped" if slipped else None
                sheet.append([direction, float(bar), length, None if slipped else force, remark])
    book.save(path)


if __name__ == "__main__":
    main(Path(__file__).with_name("rig.xlsx"))
