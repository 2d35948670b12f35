"""The command ``pam-ocp bench``."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

from .options import add_allow_code, whole

PASSWORD = "PAM_OCP_BENCH_PASSWORD"


def add_bench(commands: Any) -> None:
    """Add the command to the parser's commands."""
    bench = commands.add_parser(
        "bench",
        help="the whole chain on a page in the browser",
        description="Open an interactive page on this machine: data, muscle, plant, motion, "
        "control and export. Needs pip install 'pam_ocp[bench]'.",
        epilog=f"Another host than this machine needs a password: in {PASSWORD}, or asked for.",
    )
    bench.add_argument("--host", default="127.0.0.1", help="to listen at (default: 127.0.0.1)")
    bench.add_argument("--port", type=whole, default=0, help="default: a free one")
    bench.add_argument(
        "--name",
        action="append",
        default=[],
        metavar="HOST",
        help="further name by which browsers may ask for the page (may be repeated)",
    )
    bench.add_argument(
        "--folder", type=Path, metavar="DIR", help="of the sessions (default: the user's own)"
    )
    bench.add_argument(
        "--rig", type=Path, metavar="FILE.toml", help="a rig's file, for the tab Rig (docs/rig.md)"
    )
    bench.add_argument("--no-browser", action="store_true", help="only print the address")
    add_allow_code(bench)
    bench.set_defaults(run=_bench)


def _bench(options: argparse.Namespace) -> int:
    from ..bench.server import require_framework, serve

    require_framework()
    password = os.environ.pop(PASSWORD, None)  # the processes that it starts need not know it
    if password is None and options.host not in ("127.0.0.1", "localhost") and sys.stdin.isatty():
        import getpass

        password = getpass.getpass("password for the page: ")
    serve(
        host=options.host,
        port=options.port,
        password=password,
        names=options.name,
        folder=options.folder,
        allow_code=options.allow_code,
        browser=not options.no_browser,
        rig=options.rig,
        say=lambda text: print(text, flush=True),
    )
    return 0
