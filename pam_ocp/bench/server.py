"""``serve``: the page on this machine, until it is interrupted."""

from __future__ import annotations

import importlib.util
import os
import shlex
import socket
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ..core.errors import InputError, require_count
from ..core.files import make_folder, read_toml
from ..export.cache import user_folder

NEEDED = "nicegui"
"""It brings Plotly's JavaScript; Python's package of that name is not needed."""
LOCAL = "127.0.0.1"
LEAST_PASSWORD = 10
"""Characters."""


def require_framework() -> None:
    """Raises InputError where the extra is not installed."""
    if importlib.util.find_spec(NEEDED) is None:
        raise InputError(
            f"the bench needs {NEEDED}, which is not installed: pip install 'pam_ocp[bench]'"
        )


def sessions_folder() -> Path:
    """Where sessions are kept unless told: ``pam_ocp/bench`` in the user's state folder."""
    return (user_folder("XDG_STATE_HOME", ".local/state") or Path.cwd() / "pam_ocp") / "bench"


def serve(
    *,
    host: str = LOCAL,
    port: int = 0,
    password: str | None = None,
    names: Sequence[str] = (),
    folder: str | os.PathLike[str] | None = None,
    allow_code: bool = False,
    browser: bool = False,
    rig: str | os.PathLike[str] | None = None,
    say: Callable[[str], None] = print,
) -> None:
    """Open the page and serve it until Ctrl-C.

    Parameters
    ----------
    host : address to listen at; another than this machine's own needs ``password``.
    port : 0 for a free one.
    password : asked for instead of a token in the address. At least 10 characters.
    names : further host names by which the page may be asked for.
    folder : of the sessions; by default :func:`sessions_folder`.
    allow_code : plants named FILE.py:NAME may be run. browser : open one.
    rig : file of a rig (docs/rig.md), for the tab Rig. say : is told the address.

    Raises
    ------
    InputError : the extra is not installed; no such address; a host without a password.
    """
    require_framework()
    require_count("port", port, 0, 65535)
    if host == "localhost":
        host = LOCAL
    if host != LOCAL and password is None:
        raise InputError(
            f"host = {host!r}: others on the network could reach the page; give a password "
            "(PAM_OCP_BENCH_PASSWORD), or reach it by an SSH tunnel (docs/bench.md)"
        )
    if password is not None and len(password) < LEAST_PASSWORD:
        raise InputError(f"the password has {len(password)} characters; give {LEAST_PASSWORD}")
    with _private():
        _serve(host, port, password, names, folder, allow_code, browser, rig, say)


@contextmanager
def _private() -> Iterator[None]:
    """What is written meanwhile, here and by processes of our own, is for this user alone."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)


def _serve(
    host: str,
    port: int,
    password: str | None,
    names: Sequence[str],
    folder: str | os.PathLike[str] | None,
    allow_code: bool,
    browser: bool,
    rig: str | os.PathLike[str] | None,
    say: Callable[[str], None],
) -> None:
    root = _root(folder, say)
    # before the framework is loaded, which would keep files of its own in the working folder
    os.environ.setdefault("NICEGUI_STORAGE_PATH", os.fspath(root / ".nicegui"))
    import uvicorn

    from .app import application
    from .guard import Patient, allowed_hosts
    from .rig_room import RigRoom

    listening = _listen(host, port)
    number = int(listening.getsockname()[1])
    hosts = allowed_hosts(host, number, names)
    room = None
    if rig is not None:
        read_toml(rig)  # so that what is wrong with it is said before anything begins
        room = RigRoom(Path(rig).absolute(), host, port, sorted(hosts), allow_code)
    app = application(
        root,
        allow_code=allow_code,
        room=room,
        hosts=hosts,
        password=password,
        name=f"pam_ocp_bench_{number}",
    )
    plain = f"http://{host}:{number}/"

    def open_at(used: Callable[[], None] = lambda: None) -> str:
        return plain if password is not None else f"{plain}?token={app.ticket(used)}"

    def another() -> None:
        say(f"a browser has opened the page; for another one: {open_at(another)}")

    say(f"the bench is open: {open_at(another)}\n(sessions in {root}; Ctrl-C ends it)")
    if host != LOCAL:
        say("what goes over the network is not encrypted; prefer an SSH tunnel (docs/bench.md)")
    leading = _Leading(root)
    if browser:
        address = plain if password is not None else leading.to(open_at(leading.remove))
        threading.Timer(0.5, webbrowser.open, (address,)).start()
    config = uvicorn.Config(
        app,
        log_level="warning",
        server_header=False,
        access_log=False,
        ws_max_size=4 * 2**20,
        timeout_graceful_shutdown=2,
        http=Patient,
    )
    try:
        uvicorn.Server(config).run(sockets=[listening])
    finally:
        leading.remove()


class _Leading:
    """A file for this user alone that leads a browser on: its command line, which all users can
    read, names the file.
    """

    def __init__(self, root: Path) -> None:
        self._path = root / f".open-{os.getpid()}.html"

    def to(self, address: str) -> str:
        """The file's address."""
        self.remove()
        handle = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(
                "<!doctype html><meta name=referrer content=no-referrer>"
                f'<meta http-equiv=refresh content="0;url={address}"><a href="{address}">Open</a>'
            )
        return self._path.absolute().as_uri()

    def remove(self) -> None:
        """Once it has been used, or never was."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)


def _root(folder: str | os.PathLike[str] | None, say: Callable[[str], None]) -> Path:
    """The folder of sessions, this user's alone where we make it, or where nobody chose it."""
    root = make_folder(folder if folder is not None else sessions_folder())
    if os.name != "posix":
        return root
    if folder is None:
        root.chmod(0o700)
    elif root.stat().st_mode & 0o077:
        say(
            f"other users of this machine may look into {root}; what is written there now they "
            f"cannot read. To close it: chmod go-rwx {shlex.quote(os.fspath(root))}"
        )
    return root


def _listen(host: str, port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if os.name == "posix":
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen(128)  # who opens the address at once waits, and is not refused
    except OSError as error:
        listening.close()
        raise InputError(
            f"host = {host!r}, port = {port}: cannot listen there ({error.strerror or error}); "
            "give another port, or 0 for a free one"
        ) from None
    return listening
