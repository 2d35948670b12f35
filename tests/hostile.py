"""Units that mean harm: a plant's FMU whose functions do what the environment variable HOSTILE
says.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from conftest import benchmark_slide

from pam_ocp.export import export_fmu
from pam_ocp.export.compile import compile_library, native

_SOURCE = r"""
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#ifndef _WIN32
#include <signal.h>
#include <sys/mman.h>
#include <sys/types.h>
#include <unistd.h>
#else
#define getpid() 0
#endif
#include "fmu.c"

static volatile int zero = 0;
static void tell_pid(long pid) {
    const char *path = getenv("HOSTILE_PID");
    FILE *file = path ? fopen(path, "w") : NULL;
    if (file == NULL) return;
    fprintf(file, "%ld\n", pid);
    fclose(file);
}
static void harm(const char *place) {
    const char *wish = getenv("HOSTILE");
    const char *at = wish ? strchr(wish, ' ') : NULL;
    if (at == NULL || strcmp(at + 1, place) != 0) return;
    size_t n = (size_t)(at - wish);
#define IS(word) (n == strlen(word) && strncmp(wish, word, n) == 0)
    if (IS("segfault")) *(volatile int *)(size_t)zero = 1;
    if (IS("abort")) abort();
    if (IS("exit0")) exit(0);
    if (IS("_exit0")) _Exit(0);
    if (IS("exit3")) exit(3);
    if (IS("spin")) for (;;) zero = 0;
    if (IS("stack")) { char big[1 << 16];
        memset(big, zero, sizeof big);
        harm(place);
        zero = big[9]; }
    if (IS("memory")) for (;;) { volatile char *p = malloc(1 << 26); p[0] = 1; }
    if (IS("print")) for (int i = 0; i < 2000; i++) {
        printf("{\"done\": true}\n"); fprintf(stderr, "noise\n"); }
#ifndef _WIN32
    if (IS("hang")) { tell_pid(getpid()); for (;;) pause(); }
    if (IS("killed")) kill(getpid(), SIGKILL);
    if (IS("close")) for (int i = 0; i < 64; i++) close(i);
    if (IS("escape")) { int ready[2]; char told;
        if (pipe(ready)) return;
        if (fork() == 0) { setsid(); /* and a grandchild without a parent */
            if (fork() == 0) { tell_pid(getpid()); write(ready[1], "", 1); for (;;) pause(); }
            _exit(0); }
        if (read(ready[0], &told, 1) < 0) return;
        for (;;) pause(); }
    if (IS("escape_and_die")) { if (fork() == 0) { setsid();
            if (fork() == 0) { tell_pid(getpid()); for (;;) pause(); }
            _exit(0); }
        sleep(1); _exit(0); }
    if (IS("fork")) { pid_t pid = fork(); if (pid == 0) for (;;) pause(); tell_pid(pid); }
#endif
}
__attribute__((constructor)) static void loaded(void) { harm("loading"); }
__attribute__((destructor)) static void unloaded(void) { harm("unloading"); }
"""
_FUNCTIONS = {
    "2.0": """
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean keep) {
    harm("DoStep");
    return fmi2RealDoStep(c, t, h, keep);
}
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    harm("ExitInitializationMode");
    return fmi2RealExitInitializationMode(c);
}
void fmi2FreeInstance(fmi2Component c) { harm("FreeInstance"); fmi2RealFreeInstance(c); }
""",
    "3.0": """
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean keep,
                      fmi3Boolean *event, fmi3Boolean *end, fmi3Boolean *early, fmi3Float64 *last) {
    harm("DoStep");
    return fmi3RealDoStep(c, t, h, keep, event, end, early, last);
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    harm("ExitInitializationMode");
    return fmi3RealExitInitializationMode(c);
}
void fmi3FreeInstance(fmi3Instance c) { harm("FreeInstance"); fmi3RealFreeInstance(c); }
""",
}
_HEAD = '#define _GNU_SOURCE 1\n#pragma GCC diagnostic ignored "-Wnull-dereference"\n'


def hostile_unit(folder: Path, fmi: str) -> Path:
    """The benchmark's slide, harmless while HOSTILE is not set."""
    honest = export_fmu(benchmark_slide(), folder / "honest.fmu", fmi=fmi, platforms="native")  # type: ignore[arg-type]
    with zipfile.ZipFile(honest) as archive:
        content = {n: archive.read(n) for n in archive.namelist()}
    sources = {
        n.removeprefix("sources/"): text.decode()
        for n, text in content.items()
        if n.startswith("sources/") and n.endswith((".c", ".h"))
    }
    layer = f"fmi{fmi[0]}.c"
    for name in ("DoStep", "FreeInstance", "ExitInitializationMode"):
        own, renamed = f" fmi{fmi[0]}{name}(", f" fmi{fmi[0]}Real{name}("
        assert sources[layer].count(own) == 1
        sources[layer] = sources[layer].replace(own, renamed)
    sources["hostile.c"] = _HEAD + _SOURCE.replace("@", fmi[0]) + _FUNCTIONS[fmi]
    (binary,) = (n for n in content if n.startswith("binaries/"))
    identifier = Path(binary).stem
    content[binary] = compile_library(sources, "hostile.c", native(), identifier)
    return packed(folder / f"hostile{fmi[0]}.fmu", content)


def packed(path: Path, content: dict[str, bytes]) -> Path:
    """An archive of these files."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


def replaced(path: Path, target: Path, file: str, old: str, new: str) -> Path:
    """A copy of an archive in which a file says something else at one place."""
    content = contents(path)
    assert old.encode() in content[file], old
    return packed(target, content | {file: content[file].replace(old.encode(), new.encode(), 1)})


def contents(path: Path) -> dict[str, bytes]:
    """The files of an archive."""
    with zipfile.ZipFile(path) as archive:
        return {n: archive.read(n) for n in archive.namelist()}
