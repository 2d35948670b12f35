"""``python -m pam_ocp``: the command ``pam-ocp``."""

import sys

from .cli.main import main

if __name__ == "__main__":
    sys.exit(main())
