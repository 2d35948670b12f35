"""The C function of a block's step: of what CasADi generates only what a target has a use for.

CasADi's file brings an interface for loading it as a library (counts of references, names,
sparsities). Here only the functions that compute remain, all of them static. Their operations are
counted in CasADi's instructions.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca

from ...core.block import Block
from ...core.errors import ExportError
from ..source import c_text, casadi_code

STEP = "block_step"
LARGEST_SINGLE, SMALLEST_SINGLE = 3.4028235e38, 1.1754944e-38


@dataclass(frozen=True)
class Precision:
    """double or single: the type in C, and how its functions and constants are spelt."""

    name: str
    ctype: str
    suffix: str
    digits: float
    """Spacing of numbers at 1."""

    def literal(self, value: float) -> str:
        """A number as C reads it to the last bit."""
        if value != value:
            return f"(({self.ctype})NAN)"
        if abs(value) == float("inf"):
            return f"(({self.ctype}){'-' if value < 0 else ''}INFINITY)"
        return float(value).hex() + self.suffix


PRECISIONS = {
    "double": Precision("double", "double", "", 2.0**-52),
    "single": Precision("single", "float", "f", 2.0**-23),
}


@dataclass(frozen=True)
class StepCode:
    """The functions in C, and the work memory that one call takes."""

    text: str
    arguments: int
    results: int
    integers: int
    reals: int
    functions: tuple[str, ...]
    """Of the C library that are called."""


_LIBRARY = re.findall(
    r"\w+",
    "acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh erf exp expm1 floor fmod hypot "
    "log log1p pow remainder sin sinh sqrt tan tanh",
)
_PORTABLE = ("exp", "expm1", "tanh")
"""Those of fmu/src/elementary.h, the same to the last bit on every platform."""
_EXACT = {"ceil", "copysign", "floor", "fmod", "remainder", "sqrt"}
"""Those that every C library rounds correctly."""
_REFUSED = ("casadi_malloc", "malloc(", "calloc(", "fprintf", "PRINTF", "static casadi_real *")


def step_code(block: Block, precision: Precision) -> StepCode:
    """The step of a block in C. Raises ExportError where it calls what a target does not have."""
    kept: Any = block.step
    arguments = kept.sx_in() if kept.is_a("SXFunction") else kept.mx_in()
    step = ca.Function(STEP, arguments, kept.call(arguments))
    options = {"casadi_real": precision.ctype, "verbose": False}
    text = _computing(casadi_code(f"{STEP}.c", [step], **options))
    for word in _REFUSED:
        if word in text:
            raise ExportError(
                f"{block.name}: its step calls what a target does not have ({word.strip('( ')}); "
                "build it of functions that CasADi writes as plain C"
            )
    used = tuple(n for n in _LIBRARY if re.search(rf"(?<![\w.]){n}\(", text))
    sizes = step.sz_arg(), step.sz_res(), step.sz_iw(), step.sz_w()
    return StepCode(_spelt(text, precision, used), *sizes, used)


def _computing(raw: str) -> str:
    """Of CasADi's file the functions that compute, static, without what is unused."""
    raw = re.sub(r"(?ms)^#if __STDC_VERSION__ < 199901L\n.*?^#else\n(.*?)^#endif\n", r"\1", raw)
    raw = re.sub(r'(?m)^(extern "C" \{|\} /\* extern "C" \*/)\n', "", raw)
    raw = raw.replace("casadi_to_int(", "(casadi_int)(")  # macros of CasADi's, written out
    raw = re.sub(r"CASADI_CAST\((\w+), *([^()]+)\)", r"((\1)(\2))", raw)
    raw = re.sub(r"(?m)^ *#.*(?:\\\n.*)*\n", "", raw)
    for name, sign in (("fmin", "<"), ("fmax", ">")):  # of -0 and 0 C libraries take either
        raw = raw.replace(f"return {name}(x, y);", f"return (x {sign} y || y != y) ? x : y;")
    raw = raw.replace("return fabs(x);", "return x > 0 ? x : 0 - x;")
    raw = re.sub(r"(?ms)^CASADI_SYMBOL_EXPORT [^\n{]*\{[^\n]*\}\n", "", raw)  # of one line
    raw = re.sub(r"(?ms)^CASADI_SYMBOL_EXPORT .*?^\}\n", "", raw)
    raw = re.sub(r"/\*.*?\*/", "", raw, flags=re.S)
    raw = re.sub(r"(?m)^(casadi_(?:real|int) |void )(casadi_\w+\()", r"static \1\2", raw)
    raw = re.sub(
        r"(?m)^(static int casadi_f\d+\(.*\)) \{$",
        r"\1 {\n  (void)arg; (void)res; (void)iw; (void)w; (void)mem;",
        raw,
    )
    return _used(re.sub(r"\n\s*\n+", "\n", raw).strip() + "\n")


def _used(text: str) -> str:
    """The text without constants and functions that the last function does not lead to."""
    pieces = re.split(r"(?m)^(?=static )", text)
    defined = [k for k, p in enumerate(pieces) if p.startswith("static ")]
    places: dict[str, list[int]] = {}
    for k in defined:
        places.setdefault(_defined(pieces[k]), []).append(k)
    kept = set(range(len(pieces))) - set(defined)
    ahead = defined[-1:]
    while ahead:
        k = ahead.pop()
        if k not in kept:
            kept.add(k)
            ahead += [at for word in set(_WORD.findall(pieces[k])) for at in places.get(word, ())]
    return "".join(p for k, p in enumerate(pieces) if k in kept)


_WORD = re.compile(r"\w+")


def _defined(piece: str) -> str:
    found = re.match(r"static (?:const )?\w+ \*?(\w+)", piece)
    return found.group(1) if found else ""


def _spelt(text: str, precision: Precision, used: tuple[str, ...]) -> str:
    """With the type, the constants and the functions of a precision."""
    text = re.sub(r"\bcasadi_real\b", "real", text)
    text = re.sub(r"\bcasadi_int\b", "int", text)
    text = re.sub(r"\bcasadi_inf\b", "((real)INFINITY)", text)
    text = re.sub(r"\bcasadi_nan\b", "((real)NAN)", text)
    atom = r"(\w+(?:\[\w+\])?|\(?\*\w+(?:\+\+)?\)?)"
    text = re.sub(rf"\({atom}\?{atom}:0\)", r"(\1!=0?\2:0)", text)  # a number is no condition
    text = re.sub(rf"\(! *{atom} *\)", r"(\1==0)", text)
    text = re.sub(rf"\({atom}(&&|\|\|){atom}\)", r"(\1!=0\2\3!=0)", text)
    text = text.replace("*(ng-1)/dg", "*(real)(ng-1)/dg")
    for name in used:
        spelt = name + precision.suffix
        if precision.name == "double" and name in _PORTABLE:
            spelt = f"portable_{name}"
        text = re.sub(rf"(?<![\w.]){name}\(", f"{spelt}(", text)
    if precision.suffix:
        text = re.sub(
            r"(?<![\w.])(\d+\.\d*(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+)(?![\w.])", _single, text
        )
    return text


def portable_functions(code: StepCode, precision: Precision) -> str:
    """fmu/src/elementary.h where its functions are called; "" elsewhere."""
    if precision.name != "double" or not set(code.functions) & set(_PORTABLE):
        return ""
    text = re.sub(r"\bINFINITY\b", "(double)INFINITY", c_text("elementary.h"))
    return re.sub(r"(?m)^static double (?=\w+\()", "static inline double ", text)


def _single(found: re.Match[str]) -> str:
    """A constant in single precision; what is too large or too small for it is its last number."""
    value = float(found[1])
    if value > LARGEST_SINGLE:
        return "3.4028235e38f"
    return "1.1754944e-38f" if 0 < value < SMALLEST_SINGLE else f"{found[1]}f"


def library_functions(code: StepCode, precision: Precision) -> tuple[str, ...]:
    """The functions of the C library that are called."""
    own = _PORTABLE if precision.name == "double" else ()
    return tuple(f"{n}{precision.suffix}" for n in code.functions if n not in own)


def inexact(code: StepCode, precision: Precision) -> tuple[str, ...]:
    """The functions called whose last bit differs from one C library to the next."""
    safe = _EXACT | (set(_PORTABLE) if precision.name == "double" else set())
    return tuple(n for n in code.functions if n not in safe)


_KINDS: Mapping[str, str] = {
    "additions and subtractions": "ADD SUB NEG",
    "multiplications": "MUL SQ TWICE",
    "divisions": "DIV INV",
    "square roots": "SQRT",
    "comparisons and choices": "LT LE EQ NE NOT AND OR IF_ELSE_ZERO FMIN FMAX FABS SIGN COPYSIGN",
    "roundings": "FLOOR CEIL FMOD REMAINDER",
    "elementary functions": (
        "EXP LOG POW CONSTPOW SIN COS TAN ASIN ACOS ATAN SINH COSH TANH ASINH ACOSH ATANH ATAN2 "
        "ERF LOG1P EXPM1 HYPOT"
    ),
}


@dataclass(frozen=True)
class Counts:
    """Numbers of operations by kind; ``whole`` False where some part could not be counted."""

    by_kind: dict[str, int]
    whole: bool

    @property
    def total(self) -> int:
        return sum(self.by_kind.values())


_CODES = {
    getattr(ca, f"OP_{op}"): kind
    for kind, ops in _KINDS.items()
    for op in ops.split()
    if hasattr(ca, f"OP_{op}")
}
_UNCOUNTED = (ca.OP_SOLVE, ca.OP_INVERSE, ca.OP_DETERMINANT)
_Found: TypeAlias = "tuple[Counter[str], bool]"
"""Operations of one call, and whether all were understood."""


def counted(function: ca.Function) -> Counts:
    """The operations of one call."""
    found, whole = _within(function, {})
    return Counts({kind: found[kind] for kind in _KINDS}, whole)


def _within(function: ca.Function, known: dict[str, _Found]) -> _Found:
    """Of a function that may be called at several places."""
    key = f"{function.name()} {function.__hash__()}"
    if key not in known:
        known[key] = _counted(function, known)
    return known[key]


def _counted(function: ca.Function, known: dict[str, _Found]) -> _Found:
    if function.is_a("SXFunction") or function.is_a("MXFunction"):
        return _instructions(function, known)
    if function.is_a("Map") and function.info().get("f") is not None:
        found, whole = _within(function.info()["f"], known)
        return Counter({kind: n * function.info()["n"] for kind, n in found.items()}), whole
    if function.class_name() == "Switch":  # one of the branches is taken: at most the longest
        branches = [*function.info()["f"], function.info()["f_def"]]
        parts = [_within(branch, known) for branch in branches]
        return max((found for found, _ in parts), key=Counter.total), all(w for _, w in parts)
    return Counter(), False


def _instructions(function: ca.Function, known: dict[str, _Found]) -> _Found:
    found: Counter[str] = Counter()
    whole, scalars = True, function.is_a("SXFunction")
    nodes = function.instructions_sx() if scalars else ()
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        node = nodes[k] if scalars else function.instruction_MX(k)
        if code == ca.OP_CALL:
            inside, understood = _within(node.which_function(), known)
            found.update(inside)
            whole = whole and understood
        elif code == ca.OP_MTIMES:
            left, right = node.dep(1), node.dep(2)
            products = left.shape[0] * left.shape[1] * right.shape[1]
            found["multiplications"] += products
            found["additions and subtractions"] += products
        elif code in _CODES:
            found[_CODES[code]] += 1 if scalars else node.nnz()
        elif code in _UNCOUNTED:
            whole = False
    return found, whole
