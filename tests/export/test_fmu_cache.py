"""Compiled code comes out of a cache only when it is whole, and only from the user's own folder."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import threading
import warnings
from pathlib import Path

import pytest

from pam_ocp.export import cache
from pam_ocp.export.compile import _environment, compile_library, native
from pam_ocp.planning.solvers.solver import _stored

SOURCES = {"own.c": '__attribute__((visibility("default"))) int own(void) { return 7; }\n'}
STRANGER = 54321
"""A user number that no machine knows."""

posix = pytest.mark.skipif(os.name != "posix", reason="users and modes of POSIX")
root = pytest.mark.skipif(
    os.name != "posix" or os.geteuid() != 0, reason="only root can be another user"
)


def built() -> bytes:
    return compile_library(SOURCES, "own.c", native(), "own")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; zig keeps its own, which takes seconds to fill."""
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache.usable_folder("zig")))
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def libraries(folder: Path) -> list[Path]:
    return [p for p in (folder / "fmu").iterdir() if p.suffix == native().suffix]


# ---- damage --------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", ["cut", "emptied", "one bit", "other", "no digest", "digest"])
def test_a_damaged_library_is_built_again(folder, damage):
    whole = built()
    (library,) = libraries(folder)
    beside = library.with_name(f"{library.name}.sha256")
    assert library.read_bytes() == whole
    assert beside.read_text() == hashlib.sha256(whole).hexdigest()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    if damage == "no digest":
        beside.unlink()
    elif damage == "digest":
        beside.write_bytes(b"\xff" * 64)
    else:
        new = {"cut": whole[:100], "emptied": b"", "one bit": bytes(flipped), "other": b"nonsense"}
        library.write_bytes(new[damage])
    assert built() == whole
    assert library.read_bytes() == whole


def test_what_is_whole_is_not_compiled_again(folder, monkeypatch):
    whole = built()

    def never(*_: object) -> bytes:
        raise AssertionError("compiled again")

    monkeypatch.setattr("pam_ocp.export.compile._compile", never)
    assert built() == whole


def test_writers_side_by_side_leave_a_whole_library(folder):
    path, content = cache.usable_folder("fmu") / "some.so", os.urandom(100_000)
    seen: list[bytes | None] = []

    def work() -> None:
        for _ in range(20):
            cache.keep(path, content)
            seen.append(cache.kept(path))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(seen) == {content}
    assert sorted(p.name for p in path.parent.iterdir()) == ["some.so", "some.so.sha256"]


def test_a_damaged_library_of_a_plan_is_written_again(folder):
    whole = os.urandom(1000)
    path = cache.usable_folder("plan") / "some.so"
    for there in (b"", whole[:500], b"other"):
        path.write_bytes(there)
        assert _stored(path, whole) == path
        assert path.read_bytes() == whole
    assert [p.name for p in path.parent.iterdir()] == ["some.so"]


# ---- whose folder --------------------------------------------------------------------------------


@pytest.fixture
def no_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No cache can be chosen; returns the temporary folder."""
    monkeypatch.delenv("PAM_OCP_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


@posix
def test_without_a_home_the_temporary_folder_has_one_of_the_users_own(no_home):
    found = cache.usable_folder("fmu")
    assert found == no_home / f"pam_ocp_{os.geteuid()}" / "fmu"
    for made in (found, found.parent):
        assert made.stat().st_mode & 0o777 == 0o700


@posix
@pytest.mark.parametrize("trick", ["link", "open to others", "file", "dangling link"])
def test_a_planted_folder_is_left_alone_with_a_warning(no_home, trick):
    planted, elsewhere = no_home / f"pam_ocp_{os.geteuid()}", no_home / "elsewhere"
    elsewhere.mkdir()
    if trick == "file":
        planted.write_text("")
    elif trick == "open to others":
        planted.mkdir()
        planted.chmod(0o777)
    else:
        planted.symlink_to(no_home / "nowhere" if "dangling" in trick else elsewhere)
        if os.geteuid() != 0:
            pytest.skip("only root can make a link of another user")
        os.chown(planted, STRANGER, STRANGER, follow_symlinks=False)
    with pytest.warns(UserWarning, match="is not kept in"):
        found = cache.usable_folder("fmu")
    assert planted not in found.parents
    assert found.parent.stat().st_mode & 0o777 == 0o700
    assert list(elsewhere.iterdir()) == []


@root
@pytest.mark.parametrize("name", ["PAM_OCP_CACHE", "XDG_CACHE_HOME", "TMPDIR"])
def test_a_library_that_another_user_planted_is_not_used(tmp_path, monkeypatch, name):
    zig = str(cache.usable_folder("zig"))
    planted = {"PAM_OCP_CACHE": "c", "XDG_CACHE_HOME": "pam_ocp", "TMPDIR": "pam_ocp_0"}[name]
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", zig)
    monkeypatch.setenv("HOME", "")
    monkeypatch.delenv("PAM_OCP_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if name == "TMPDIR":
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    else:
        monkeypatch.setenv(name, str(tmp_path / "c" if name == "PAM_OCP_CACHE" else tmp_path))
    whole = built()
    for library in libraries(tmp_path / planted):
        cache.keep(library, b"code of someone else")
    for path in (tmp_path / planted, *(tmp_path / planted).rglob("*")):
        os.chown(path, STRANGER, STRANGER)
    with pytest.warns(UserWarning, match="belongs to another user"):
        assert built() == whole


@posix
def test_a_link_of_the_users_own_is_followed(tmp_path, monkeypatch):
    (tmp_path / "disk").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / "link"))
    assert cache.usable_folder("fmu") == tmp_path / "link" / "fmu"


# ---- odd surroundings ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["50 % of it", "Müskel übung", "100%20%s$HOME", "筋肉"])
def test_odd_names_of_folders_do_no_harm(tmp_path, monkeypatch, name):
    import casadi as ca

    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache.usable_folder("zig")))
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / name))
    (tmp_path / f"{name} tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / f"{name} tmp"))
    generator = ca.CodeGenerator("odd.c")
    x = ca.SX.sym("x")
    generator.add(ca.Function("twice", [x], [2 * x]))
    head = '#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))\n'
    content = compile_library({"odd.c": head + generator.dump()}, "odd.c", native(), "odd")
    (library,) = libraries(tmp_path / name)
    assert library.read_bytes() == content
    assert float(ca.external("twice", str(library))(4.0)) == 8.0


def test_a_relative_cache_of_xdg_does_not_count(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PAM_OCP_CACHE", raising=False)
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path))  # who runs this may have none
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    assert cache.cache_folder() == tmp_path / ".cache" / "pam_ocp"
    assert Path(_environment()["ZIG_GLOBAL_CACHE_DIR"]).is_absolute()


def test_a_cache_that_cannot_be_made_costs_time_only(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache.usable_folder("zig")))
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / "file" / "below"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert built().startswith((b"\x7fELF", b"MZ", b"\xcf\xfa"))
    assert (tmp_path / "file").read_text() == ""


@root
@pytest.mark.parametrize("home", [None, "/", "relative", "/nowhere/at/all"])
def test_a_user_whom_the_machine_does_not_know_has_a_cache(home):
    """No entry in passwd; no home, or one that cannot be written."""
    script = """
import os, sys
from pam_ocp.export import cache, compile
os.setgroups([]); os.setgid(int(sys.argv[1])); os.setuid(int(sys.argv[1]))
print(cache.usable_folder("fmu")); print(compile._environment()["ZIG_GLOBAL_CACHE_DIR"])
if compile._local():  # zig may be where this user cannot look
    library = compile.compile_library({"a.c": "int a;"}, "a.c", compile.native(), "a")
    (kept,) = cache.usable_folder("fmu").glob("*[!6]")
    assert kept.read_bytes() == library
"""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        place.chmod(0o1777)
        surroundings = {"TMPDIR": name, "MPLCONFIGDIR": name, "PATH": os.environ["PATH"]}
        surroundings["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        if home is not None:
            surroundings["HOME"] = home
        how = {"env": surroundings, "cwd": place, "capture_output": True, "text": True}
        command = [sys.executable, "-c", script, str(STRANGER)]
        done = subprocess.run(command, check=False, **how)
        assert done.stderr == ""
        own = place / f"pam_ocp_{STRANGER}"
        assert done.stdout.split() == [str(own / "fmu"), str(own / "zig")]
        assert (own.stat().st_uid, own.stat().st_mode & 0o777) == (STRANGER, 0o700)
