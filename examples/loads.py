"""The influence of loads on one muscle: a table and six plots.

Run:  python examples/loads.py [folder for the results]
"""

import sys
from pathlib import Path

import pam_ocp as pam


def main(folder: Path) -> None:
    study = pam.load_study(pam.muscle("DMSP-20-400N"), masses=[5, 10, 20, 50, 100])
    print(study)
    study.save(folder / "loads.csv")
    study.plot().savefig(folder / "loads.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "loads")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
