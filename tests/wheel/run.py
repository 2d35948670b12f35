"""Wheel and source archive, built and installed in an empty environment: ``python
tests/wheel/run.py``.

Looks at what is in them (all that belongs, nothing else), then runs the installed package in an
empty folder: import, the command line's tour, an FMU exported and checked. The same import works in
the clone where nothing is installed. Nothing is written into the clone.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parent.parent.parent
REQUIRED = ("setuptools>=77",)
"""What pyproject.toml asks for to build, and nothing else: the builder's environment is empty."""
C_FOLDER = "pam_ocp/export/c"
C_PARTS = ("src/*", "include/*", "LICENSE.*")
ARCHIVED = (
    "CHANGELOG.md",
    "CITATION.cff",
    "LICENSE",
    "README.md",
    "docs/architecture.md",
    "examples/own_plant.py",
    "fmu/CMakeLists.txt",
    "fmu/README.md",
    "fmu/models/spring/plant.c",
    "fmu/tests/test_solver.c",
    "build_backend.py",
    "pyproject.toml",
    "tests/conftest.py",
    "tests/package/test_package.py",
)
"""What a source archive holds beside the package and the C runtime."""

EXPORT = """
import pam_ocp as pam, pathlib, sys
path = pam.export_fmu(pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=5.0), "load.fmu",
                      platforms="native")
print(pathlib.Path(pam.__file__).parent)
sys.exit(not pam.check_fmu(path).ok)
"""


LIGHT = """
import pam_ocp as pam, warnings
load = pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=5.0)
motion = pam.simulate(load, duration=0.1)
for write, words in ((lambda: pam.export_fmu(load, "load.fmu"), "pam_ocp[cross]"),
                     (lambda: motion.to_excel("m.xlsx"), "pam_ocp[excel]")):
    try:
        write()
    except (pam.ExportError, pam.InputError) as error:
        assert f"pip install '{words}'" in str(error), error
    else:
        raise SystemExit(f"{words} is not asked for")
try:
    print("FMU", pam.check_fmu(pam.export_fmu(load, "load.fmu", platforms="native")).ok)
except pam.ExportError as error:
    print(error)
"""


def tell(*command: str | Path, folder: Path, clean: bool = True) -> str:
    """What a command prints; ends all when it fails. clean: no path of Python's from outside."""
    environment = {k: v for k, v in os.environ.items() if not (clean and k.startswith("PYTHON"))}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        env=environment | {"MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        sys.exit(f"failed: {' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}")
    return done.stdout.strip()


def require(holds: bool, sentence: str) -> None:
    """End with a sentence unless it holds."""
    if not holds:
        sys.exit(f"failed: {sentence}")


def environment(folder: Path) -> tuple[Path, Path]:
    """The interpreter of an empty environment, and the folder of its commands."""
    tell(sys.executable, "-m", "venv", folder, folder=ROOT)
    commands = folder / ("Scripts" if os.name == "nt" else "bin")
    return commands / ("python.exe" if os.name == "nt" else "python"), commands


def pip(python: Path, *words: str | Path) -> None:
    tell(python, "-m", "pip", "--disable-pip-version-check", "--quiet", *words, folder=ROOT)


# ---- what is inside ------------------------------------------------------------------------------


def belonging() -> set[str]:
    """The files that a wheel must hold."""
    package = (p for p in (ROOT / "pam_ocp").rglob("*") if p.is_file() and p.suffix != ".pyc")
    runtime = (p for part in C_PARTS for p in (ROOT / "fmu").glob(part))
    return {p.relative_to(ROOT).as_posix() for p in package} | {
        f"{C_FOLDER}/{p.relative_to(ROOT / 'fmu').as_posix()}" for p in runtime
    }


def look_into_wheel(wheel: Path) -> dict[str, bytes]:
    """Its files but the record; exactly what belongs, and the licences."""
    with zipfile.ZipFile(wheel) as archive:
        files = {n: archive.read(n) for n in archive.namelist() if not n.endswith("/RECORD")}
    info = {n for n in files if n.partition("/")[0].endswith(".dist-info")}
    surplus, missing = set(files) - info - belonging(), belonging() - set(files)
    require(not surplus, f"the wheel holds what does not belong: {sorted(surplus)}")
    require(not missing, f"the wheel lacks {sorted(missing)}")
    for needed in ("licenses/LICENSE", "licenses/fmu/LICENSE.fmi-headers", "entry_points.txt"):
        require(any(n.endswith(f"/{needed}") for n in info), f"the wheel lacks its {needed}")
    return files


def look_into_archive(archive: Path) -> None:
    """All of the package, the C runtime with its tests, the project's tests; nothing built."""
    with tarfile.open(archive) as tar:
        paths = [PurePosixPath(m.name) for m in tar.getmembers() if m.isfile()]
    names = {"/".join(p.parts[1:]) for p in paths}
    package = {n for n in belonging() if not n.startswith(C_FOLDER)}
    missing = (package | set(ARCHIVED)) - names
    require(not missing, f"the source archive lacks {sorted(missing)}")
    built = {n for n in names if n.endswith((".pyc", ".so", ".fmu")) or ".venv" in n}
    require(not built, f"the source archive holds what was built: {sorted(built)}")


def require_same_again(
    build: tuple[str | Path, ...], clone: Path, work: Path, before: list[Path]
) -> None:
    """Another copy of the files, of another day and with other rights: the same to the last bit."""
    copy = shutil.copytree(clone, work / "again", ignore=shutil.ignore_patterns("*.egg-info"))
    for path in copy.rglob("*"):
        path.chmod(0o700 if path.is_dir() else 0o600)
        os.utime(path, (10**9, 10**9))
    tell(*build, "--wheel", "--sdist", "--outdir", work / "repeated", copy, folder=work)
    for path in before:
        again = hashlib.sha256((work / "repeated" / path.name).read_bytes()).hexdigest()
        first = hashlib.sha256(path.read_bytes()).hexdigest()
        require(again == first, f"{path.name} is another one when it is built again")
        print(f"{path.name}: sha256 {first}, built twice")


# ---- what runs -----------------------------------------------------------------------------------


def run_installed(python: Path, commands: Path, folder: Path, *, tour: bool) -> None:
    """The installed package in an empty folder."""
    folder.mkdir()
    home = Path(tell(python, "-c", EXPORT, folder=folder).splitlines()[-1])
    require("site-packages" in home.parts, f"pam_ocp was imported from {home}")
    command = commands / ("pam-ocp.exe" if os.name == "nt" else "pam-ocp")
    tell(command, "check", "load.fmu", folder=folder)
    if tour:
        tell(command, "tour", "--out", "tour", folder=folder)
        require((folder / "tour" / "summary.md").is_file(), "the tour left no summary.md")


def main() -> None:
    work = Path(tempfile.mkdtemp(prefix="pam_ocp_wheel_"))
    try:
        python, commands = environment(work / "venv")
        look = "import pam_ocp; print(pam_ocp.__version__)"
        version = tell(python, "-c", look, folder=ROOT)
        print(f"{version} imports in the clone, where nothing is installed", flush=True)

        builder, _ = environment(work / "builder")
        pip(builder, "install", "build", "twine", *REQUIRED)
        # a copy, so that the clone stays as it is; the wheel is built out of the source archive
        clone = shutil.copytree(
            ROOT,
            work / "clone",
            ignore=shutil.ignore_patterns(
                ".*", "build", "_build", "generated", "*.egg-info", "tour"
            ),
        )
        build = (builder, "-m", "build", "--no-isolation")
        tell(*build, "--outdir", work / "dist", clone, folder=work)
        (wheel,), (archive,) = (work / "dist").glob("*.whl"), (work / "dist").glob("*.tar.gz")
        require(f"-{version}-" in wheel.name, f"{wheel.name} is not version {version}")
        tell(builder, "-m", "twine", "check", "--strict", wheel, archive, folder=work)
        look_into_archive(archive)
        files = look_into_wheel(wheel)
        tell(*build, "--wheel", "--outdir", work / "direct", clone, folder=work)
        (direct,) = (work / "direct").glob("*.whl")
        require(look_into_wheel(direct) == files, "the wheels of clone and archive differ")
        require_same_again(build, clone, work, [direct, archive])
        print(f"{wheel.name} ({len(files)} files) and {archive.name} hold what belongs", flush=True)

        pip(python, "install", wheel)
        light = tell(python, "-c", LIGHT, folder=work)
        print(f"the wheel without extras: {light}", flush=True)
        pip(python, "install", f"{wheel}[cross,excel]")
        run_installed(python, commands, work / "of_wheel", tour=True)
        print("the wheel runs in an empty folder: import, FMU, tour", flush=True)
        pip(python, "uninstall", "--yes", "pam_ocp")
        tell(python, "-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{EXPORT}", folder=work)
        print("the clone exports an FMU where only the dependencies are installed", flush=True)
        pip(python, "install", "--no-deps", archive)
        run_installed(python, commands, work / "of_archive", tour=False)
        print("the source archive installs and runs: import, FMU", flush=True)
    finally:
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main()
