"""The files of a C export: header, source, self-test, CMake and README."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.block import Block
from ...core.errors import ExportError
from ...core.variables import Variable
from ..source import C_KEYWORDS
from .generated import Counts, Precision, StepCode, inexact, library_functions, portable_functions

Array: TypeAlias = NDArray[np.float64]

_ELSEWHERE = """
    and asm bool catch class delete explicit export false friend mutable namespace new not operator
    or private protected public template this throw true try typename using virtual xor
    EOF INFINITY NAN NULL linux unix
"""
"""Words of C++, which the header is for, too, and macros of C libraries and compilers."""
_KEYWORDS = C_KEYWORDS | {"real", "memory", "scratch", *_ELSEWHERE.split()}


WIDE = 80
"""Characters of a comment in the header; README.md has the whole."""


@dataclass(frozen=True)
class Vectors:
    """What the self-test compares: inputs (n, inputs) and outputs (n, outputs) of n steps.

    An output that is NaN is not compared.
    """

    inputs: Array
    outputs: Array
    tolerance: float
    """Of an output, relative to itself and to its nominal."""


def field_names(variables: Sequence[Variable]) -> list[str]:
    """Names in C, for the fields of a struct. Raises ExportError where two become one."""
    found: dict[str, str] = {}
    for v in variables:
        name = v.name.replace(".", "_")
        name = f"{name}_" if name in _KEYWORDS else name
        if name in found:
            raise ExportError(f"{v.name} and {found[name]} are both {name} in C; rename one")
        found[name] = v.name
    return list(found)


@dataclass(frozen=True)
class CExport:
    """All that is written of one block."""

    block: Block
    code: StepCode
    precision: Precision
    counts: Counts
    vectors: Vectors
    prefix: str

    def files(self) -> dict[str, str]:
        """{name: text}."""
        p = self.prefix
        found = {
            f"{p}.h": self.header(),
            f"{p}.c": self.source(),
            f"{p}_selftest.c": self.selftest(),
            "CMakeLists.txt": self.cmake(),
            "README.md": self.readme(),
        }
        if portable := portable_functions(self.code, self.precision):
            found["elementary.h"] = portable
        return found

    # ---- sizes --------------------------------------------------------------------------------
    @property
    def _scratch(self) -> int:
        b = self.block
        return len(b.inputs) + len(b.parameters) + len(b.outputs) + len(b.memory) + self.code.reals

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each struct."""
        b, real = self.block, 8 if self.precision.name == "double" else 4
        whole = max(len(b.memory), 1) + max(self._scratch, 1)
        return {
            "state": real * whole,
            "inputs": real * max(len(b.inputs), 1),
            "parameters": real * max(len(b.parameters), 1),
            "outputs": real * len(b.outputs),
        }

    # ---- header -------------------------------------------------------------------------------
    def header(self) -> str:
        p, b = self.prefix, self.block
        guard = f"{p.upper()}_H"
        structs = "\n".join(
            self._struct(kind, getattr(b, kind)) for kind in ("inputs", "parameters", "outputs")
        )
        return f"""/* {_plain(b.description or b.name)}. C99; no heap, no global state. */
#ifndef {guard}
#define {guard}
#ifdef __cplusplus
extern "C" {{
#endif
typedef {self.precision.ctype} {p}_real;
#define {p.upper()}_SAMPLE_TIME {b.sample_time!r}{self.precision.suffix} /* [s] */
{structs}
typedef struct {{
    {p}_real memory[{max(len(b.memory), 1)}];  /* carried from step to step */
    {p}_real scratch[{max(self._scratch, 1)}]; /* of no meaning between two steps */
}} {p}_state;
/* Once before the first step, and to begin anew: start values for all three. */
void {p}_init({p}_state *state, {p}_parameters *parameters, {p}_inputs *inputs);
/* Every {p.upper()}_SAMPLE_TIME seconds: from inputs to outputs. A measurement may be NAN. */
void {p}_step({p}_state *state, const {p}_parameters *parameters, const {p}_inputs *inputs,
{" " * len(f"void {p}_step(")}{p}_outputs *outputs);
#ifdef __cplusplus
}}
#endif
#endif
"""

    def _struct(self, kind: str, variables: Sequence[Variable]) -> str:
        p = self.prefix
        fields = [
            f"    {p}_real {name}; /* {_about(v)} */"
            for name, v in zip(field_names(variables), variables, strict=True)
        ]
        body = "\n".join(fields or [f"    {p}_real none; /* there are none */"])
        return f"typedef struct {{\n{body}\n}} {p}_{kind};"

    # ---- source -------------------------------------------------------------------------------
    def source(self) -> str:
        p, b, c = self.prefix, self.block, self.code
        n = [len(part) for part in (b.memory, b.inputs, b.parameters, b.outputs)]
        starts = {
            "state->memory": [f"[{i}]" for i in range(n[0])],
            "parameters": [f"->{f}" for f in field_names(b.parameters)],
            "inputs": [f"->{f}" for f in field_names(b.inputs)],
        }
        kinds = {"state->memory": "memory", "parameters": "parameters", "inputs": "inputs"}
        lines = {
            k: [
                f"    {k}{place} = {self.precision.literal(v)};"
                for place, v in zip(places, b.start(kinds[k]), strict=True)
            ]
            for k, places in starts.items()
        }
        init = "\n".join(
            part or f"    (void){k.partition('->')[0]};"
            for k, part in ((k, "\n".join(found)) for k, found in lines.items())
        )
        gather = "\n".join(
            [f"    u[{i}] = inputs->{f};" for i, f in enumerate(field_names(b.inputs))]
            + [f"    q[{i}] = parameters->{f};" for i, f in enumerate(field_names(b.parameters))]
        )
        give = "\n".join(
            f"    outputs->{f} = y[{i}];" for i, f in enumerate(field_names(b.outputs))
        )
        portable = '#include "elementary.h"\n' if portable_functions(c, self.precision) else ""
        iw = f"    int iw[{c.integers}];\n" if c.integers else ""
        none = "" if b.parameters else "    (void)parameters;\n"
        none += "" if b.inputs else "    (void)inputs;\n"
        said = _plain(b.description or b.name)
        needs_math = c.functions or re.search(r"\b(?:INFINITY|NAN)\b", c.text + init)
        math = "#include <math.h>\n" if needs_math else ""
        return f"""/* {said}: see {p}.h. Written by pam_ocp; do not edit. */
#include "{p}.h"
{math}{portable}#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif
typedef {p}_real real;

{c.text}
void {p}_init({p}_state *state, {p}_parameters *parameters, {p}_inputs *inputs) {{
{init}
}}

void {p}_step({p}_state *state, const {p}_parameters *parameters, const {p}_inputs *inputs,
{" " * len(f"void {p}_step(")}{p}_outputs *outputs) {{
    real *const u = state->scratch, *const q = u + {n[1]}, *const y = q + {n[2]};
    real *const next = y + {n[3]}, *const w = next + {n[0]};
    const real *arg[{max(c.arguments, 3)}];
    real *res[{max(c.results, 2)}];
{iw}    int i;
{none}{gather}
    arg[0] = state->memory;
    arg[1] = u;
    arg[2] = q;
    res[0] = next;
    res[1] = y;
    (void)casadi_f0(arg, res, {"iw" if c.integers else "0"}, w, 0);
    for (i = 0; i < {n[0]}; ++i) state->memory[i] = next[i];
{give}
}}
"""

    # ---- self-test ------------------------------------------------------------------------------
    def selftest(self) -> str:
        p, b, v, lit = self.prefix, self.block, self.vectors, self.precision.literal
        rows, columns = v.inputs.shape
        columns = max(columns, 1)  # C has no empty arrays
        inputs = _table(v.inputs if v.inputs.size else np.zeros((rows, 1)), lit)
        outputs = _table(v.outputs, lit)
        nominal = ", ".join(lit(o.nominal) for o in b.outputs)
        fill = "\n".join(
            f"        inputs.{f} = GIVEN[k][{i}];"
            for i, f in enumerate(field_names(b.inputs) or ["none"])
        )
        take = "\n".join(
            f"        found[{i}] = outputs.{f};" for i, f in enumerate(field_names(b.outputs))
        )
        return f"""/* Test vectors of {p}: {rows} steps. Returns 0 when all outputs are as expected.
   The bits of all outputs are summed up, to compare one machine with another. */
#include "{p}.h"
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#define STEPS {rows}
#define INPUTS {columns}
#define OUTPUTS {len(b.outputs)}
static const {p}_real GIVEN[STEPS][INPUTS] = {inputs};
static const {p}_real EXPECTED[STEPS][OUTPUTS] = {outputs};
static const {p}_real NOMINAL[OUTPUTS] = {{{nominal}}};
static const {p}_real TOLERANCE = {lit(v.tolerance)};

static {p}_state state; /* of the test, not of the controller */

static uint32_t bits_of(uint32_t sum, {p}_real value) {{
    unsigned char bytes[sizeof value];
    size_t i;
    memcpy(bytes, &value, sizeof value);
    for (i = 0; i < sizeof value; ++i) sum = (sum ^ bytes[i]) * 16777619u;
    return sum;
}}

static int run(uint32_t *sum, {p}_real *worst) {{
    {p}_parameters parameters;
    {p}_inputs inputs;
    {p}_outputs outputs;
    {p}_real found[OUTPUTS];
    int k, i, wrong = 0;
    {p}_init(&state, &parameters, &inputs);
    *sum = 2166136261u;
    *worst = 0;
    for (k = 0; k < STEPS; ++k) {{
{fill}
        {p}_step(&state, &parameters, &inputs, &outputs);
{take}
        for (i = 0; i < OUTPUTS; ++i) {{
            const {p}_real size = NOMINAL[i] + ({p}_real)fabs((double)EXPECTED[k][i]);
            const {p}_real off = ({p}_real)fabs((double)(found[i] - EXPECTED[k][i])) / size;
            *sum = bits_of(*sum, found[i]);
            if (EXPECTED[k][i] != EXPECTED[k][i]) continue; /* a flag that rounding turns over */
            if (!(off <= TOLERANCE)) {{
                if (++wrong <= 5)
                    printf("step %d, output %d: %.17g, expected %.17g\\n", k, i, (double)found[i],
                           (double)EXPECTED[k][i]);
            }}
            if (off > *worst) *worst = off;
        }}
    }}
    return wrong;
}}

int main(void) {{
    uint32_t first, again;
    {p}_real worst;
    int wrong = run(&first, &worst);
    wrong += run(&again, &worst); /* begun anew, the same bits */
    if (first != again) {{
        printf("a second run gave other bits\\n");
        ++wrong;
    }}
    printf("{p}: %d steps, largest deviation %.3g, bits %08lx, %s\\n", STEPS, (double)worst,
           (unsigned long)first, wrong ? "FAILED" : "passed");
    return wrong ? 1 : 0;
}}
"""

    # ---- CMake and README -----------------------------------------------------------------------
    def cmake(self) -> str:
        p = self.prefix
        return f"""cmake_minimum_required(VERSION 3.13)
project({p} C)
add_library({p} STATIC {p}.c)
set_target_properties({p} PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON C_EXTENSIONS OFF)
target_include_directories({p} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
if(NOT MSVC)
  # no product fused with a sum: the same bits on every machine
  target_compile_options({p} PRIVATE -ffp-contract=off -Wall -Wextra -Wpedantic)
  target_link_libraries({p} PUBLIC m)
endif()
add_executable({p}_selftest {p}_selftest.c)
target_link_libraries({p}_selftest PRIVATE {p})
enable_testing()
add_test(NAME selftest COMMAND {p}_selftest)
"""

    def readme(self) -> str:
        p, b, c = self.prefix, self.block, self.code
        sizes = "\n".join(f"| `{p}_{k}` | {v} |" for k, v in self.sizes.items())
        pointers = max(c.arguments, 3) + max(c.results, 2)
        counted = "\n".join(f"| {k} | {v} |" for k, v in self.counts.by_kind.items() if v)
        loops = (
            "\n".join(f"- {k}: {v}" for k, v in b.loops.items())
            or "- none: the code of a step runs straight through"
        )
        whole = "at most" if self.counts.whole else "at least (linear systems are not counted)"
        straight = ""
        if b.step.is_a("SXFunction"):
            straight = " (nothing is skipped: each step takes the same time)"
        rough = inexact(c, self.precision)
        bits = (
            "The same bits on every machine that computes by IEEE 754 and fuses no product with a "
            "sum (`-ffp-contract=off`; never `-ffast-math`)."
        )
        if rough:
            bits = (
                f"It calls {', '.join(rough)} of the C library, whose last bit differs from one "
                "library to the next; all else is the same on every machine."
            )
        return f"""# {p}

{_plain(b.description or b.name)}; one step every {b.sample_time:g} s, in
{self.precision.name} precision. Written by pam_ocp.

## How to call it

```c
#include "{p}.h"

static {p}_state state;
static {p}_parameters parameters;
static {p}_inputs inputs;
static {p}_outputs outputs;

{p}_init(&state, &parameters, &inputs);   /* once */
/* every {b.sample_time:g} s: */
{_example(b)}
{p}_step(&state, &parameters, &inputs, &outputs);
```

Values are in the units of the tables below. Each instance has its own `{p}_state`; nothing else is
kept, so that several run side by side, in any thread or interrupt, one call at a time each. A copy
of `memory` is a saved state.

## What it takes

| struct | bytes |
|---|---|
{sizes}

The stack holds {pointers} pointers, {4 * c.integers} bytes of indices, and the compiler's own
variables. Nothing is allocated; no function of the system is called, of the C library
{_list(library_functions(c, self.precision))}.

Operations of one step, {whole}{straight}:

| operation | count |
|---|---|
{counted}

Repeated within a step, at most:

{loops}

## Inputs, outputs, parameters

{_documentation(b)}

## Bits

{bits}

`{p}_selftest` runs {len(self.vectors.inputs)} steps (missing measurements and switching off among
them) and compares all outputs with those of pam_ocp to {self.vectors.tolerance:.0e} of their size;
it prints the sum of their bits.

```sh
cmake -B build && cmake --build build && ctest --test-dir build
```
"""


def _table(values: Array, literal: object) -> str:
    assert callable(literal)
    rows = ["{" + ", ".join(literal(float(v)) for v in row) + "}" for row in values]
    return "{\n    " + ",\n    ".join(rows) + "}"


def _plain(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("*/", "* /").replace("/*", "/ *")


def _about(v: Variable) -> str:
    unit = "" if v.unit == "1" else f"[{v.unit}] "
    words = _plain(f"{unit}{v.description or v.name}").strip()
    return words if len(words) <= WIDE else f"{words[:WIDE].rpartition(' ')[0]} ... (README)"


def _list(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "none"


def _example(b: Block) -> str:
    first = b.inputs[0] if b.inputs else None
    return f"inputs.{field_names([first])[0]} = ...;" if first else "/* no inputs */"


def _documentation(b: Block) -> str:
    rows = ["| | field | unit | start | |", "|---|---|---|---|---|"]
    kinds: Mapping[str, Sequence[Variable]] = {
        "input": b.inputs,
        "output": b.outputs,
        "parameter": b.parameters,
    }
    for kind, variables in kinds.items():
        for name, v in zip(field_names(variables), variables, strict=True):
            rows.append(
                f"| {kind} | `{name}` | {v.unit} | {v.start or 0.0:.6g} | {_plain(v.description)} |"
            )
    return "\n".join(rows)
