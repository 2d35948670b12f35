"""HPIPM, called directly: the quadratic program of shooting, stage by stage, in fixed memory.

CasADi's interface to HPIPM goes through sparse matrices and gives each open end of a bound a
barrier of its own. Here the library that comes in CasADi's wheel is called as its C header declares
it: dense blocks per stage, vectors read where they stand, open ends masked (Frison and Diehl,
HPIPM, IFAC 2020).
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..kinds import Array
from .shooting import UNBOUNDED, TrackingPoint

Index: TypeAlias = NDArray[np.intp]

SPEED_ABS = 0
"""HPIPM's mode: absolute formulation, no residuals computed on the way."""
ITERATIONS = 20
"""At most so many of the interior-point method in one quadratic program: where more would be
needed, the reference has just jumped, and the next program sees the rest.
"""
GAP = 1e-10
"""Complementarity that ends it: leaves some 1e-5 (scaled) in the step where limits hold it back,
below what SQP looks at; 1e-8 leaves 6e-4 there, for an iteration less.
"""

_SET = "A B b Q S R q r idxbx lbx ubx idxbu lbu ubu C D lg ug Zl Zu zl zu idxs idxs_rev ls us"
_GET = "u x ls us pi lam_lb lam_ub lam_lg lam_ug lam_ls lam_us"
"""Arguments of d_ocp_qp_set_all and d_ocp_qp_sol_get_all in the version this is written for."""


@cache
def _library() -> ctypes.CDLL | None:
    """The library in CasADi's wheel; None where it is missing or declares another interface."""
    folder = Path(ca.__file__).parent
    names = (f"{start}hpipm.{end}" for start in ("lib", "") for end in ("so", "dylib", "dll"))
    found = next((folder / n for n in names if (folder / n).is_file()), None)
    if found is None:
        return None
    for header, function, expected in (
        ("hpipm_d_ocp_qp.h", "d_ocp_qp_set_all", _SET),
        ("hpipm_d_ocp_qp_sol.h", "d_ocp_qp_sol_get_all", _GET),
    ):
        try:
            text = (folder / "include" / header).read_text(errors="ignore")
        except OSError:
            return None
        declared = re.search(rf"void {function}\(([^)]*)\)", text)
        if declared is None or re.findall(r"\*\*(\w+)", declared[1]) != expected.split():
            return None
    try:
        return ctypes.CDLL(str(found))
    except OSError:
        return None


def available() -> bool:
    """Whether HPIPM can be called directly here."""
    return _library() is not None


class StageQp:
    """The quadratic program at ``point``; a call leaves its solution in ``direction``.

    All memory is taken at construction. ``iterations`` are those of the last call. Raises
    RuntimeError where :func:`available` is False.
    """

    def __init__(self, point: TrackingPoint, direction: Array) -> None:
        library = _library()
        if library is None:
            raise RuntimeError("CasADi's wheel brings no HPIPM of the interface known here")
        self._library, self._point = library, point
        self._memory: list[Any] = [direction]
        self._places()
        self._create()
        self._set = self._setter()
        self._get = self._getter(direction)
        self._count = ctypes.c_int(0)
        self._mask()

    @property
    def iterations(self) -> int:
        """Of the interior-point method in the last call."""
        self._library.d_ocp_qp_ipm_get_iter(self._work, ctypes.byref(self._count))
        return int(self._count.value)

    def __call__(self) -> None:
        point = self._point
        self._blocks[self._a_to] = point.a[self._a_in]
        self._blocks[self._h_to] = point.h[self._h_in]
        np.negative(point.a_low, out=self._defects)
        self._library.d_ocp_qp_set_all(*self._set)
        self._library.d_ocp_qp_ipm_solve(self._qp, self._solution, self._arg, self._work)
        self._library.d_ocp_qp_sol_get_all(*self._get)

    # ---- layout ---------------------------------------------------------------------------------
    def _places(self) -> None:
        """Where each stage's vectors begin,
        and each entry of ``a`` and ``h`` among dense blocks.
        """
        p = self._point.program
        self._n = n = p.horizon
        nx, nu, ng = (np.array(p.dimensions[name], dtype=np.intp) for name in ("nx", "nu", "ng"))
        self._nx, self._nu, self._ng = nx, nu, ng
        nb = np.append(nx[1:], 0)
        self._x_at = np.cumsum(nx + nu) - nu - nx
        self._row_at = np.cumsum(nb + ng) - nb - ng
        sizes = {
            "A": nb * nx,
            "B": nb * nu,
            "C": ng * nx,
            "D": ng * nu,
            "Q": nx * nx,
            "S": nu * nx,
            "R": nu * nu,
        }
        begins = np.cumsum(np.concatenate([[0], *sizes.values()]))
        self._begin = dict(zip(sizes, begins[:-1].reshape(len(sizes), n + 1), strict=True))
        self._blocks: Array = np.zeros(int(begins[-1]))
        of_column = _stages(nx, nu)
        of_row = _stages(nb, ng)
        self._a_in, self._a_to = self._entries(
            p.a_rows, p.a_columns, of_row, of_column, (("A", "B"), ("C", "D"))
        )
        rows, columns = (np.array(e, dtype=np.intp) for e in p.h_sparsity.get_triplet())
        self._h_in, self._h_to = self._entries(
            rows, columns, of_column, of_column, (("Q", ""), ("S", "R"))
        )

    def _entries(
        self,
        i: Index,
        j: Index,
        of_row: tuple[Index, ...],
        of_column: tuple[Index, ...],
        names: Sequence[Sequence[str]],
    ) -> tuple[Index, Index]:
        """(which entries stand in a block, where in the blocks); the rest is known to HPIPM.

        ``names[a][b]`` is the block of rows of part a and columns of part b of one stage.
        """
        stage, row_part, row, height = (e[i] for e in of_row)
        same, column_part, column, _ = (e[j] for e in of_column)
        inside, to = [], []
        for a, part in enumerate(names):
            for b, name in enumerate(part):
                if not name:
                    continue
                here = (stage == same) & (row_part == a) & (column_part == b)
                at = np.flatnonzero(here)
                inside.append(at)
                to.append(self._begin[name][stage[at]] + row[at] + column[at] * height[at])
        return np.concatenate(inside), np.concatenate(to)

    # ---- memory of HPIPM ------------------------------------------------------------------------
    def _new(self, kind: str, *needs: Any) -> Any:
        """A structure of HPIPM with the memory that it asks for."""
        size = getattr(self._library, f"d_ocp_qp_{kind}strsize")
        memory = getattr(self._library, f"d_ocp_qp_{kind}memsize")
        size.restype = memory.restype = ctypes.c_size_t
        structure = ctypes.create_string_buffer(size())
        store = ctypes.create_string_buffer(memory(*needs))
        getattr(self._library, f"d_ocp_qp_{kind}create")(*needs, structure, store)
        self._memory += [structure, store]
        return structure

    def _create(self) -> None:
        library, p = self._library, self._point.program
        dim = self._new("dim_", self._n)
        finite = (p.w_low > -UNBOUNDED) | (p.w_high < UNBOUNDED)
        self._bounded = [
            np.any(finite[at : at + nx]) for at, nx in zip(self._x_at, self._nx, strict=True)
        ]
        for k in range(self._n + 1):
            nbx = int(self._nx[k]) if self._bounded[k] else 0
            for name, value in (
                ("nx", self._nx[k]),
                ("nu", self._nu[k]),
                ("ng", self._ng[k]),
                ("nbx", nbx),
                ("nbu", self._nu[k]),
            ):
                getattr(library, f"d_ocp_qp_dim_set_{name}")(k, int(value), dim)
        self._qp, self._solution = self._new("", dim), self._new("sol_", dim)
        self._arg = self._new("ipm_arg_", dim)
        library.d_ocp_qp_ipm_arg_set_default(SPEED_ABS, self._arg)
        library.d_ocp_qp_ipm_arg_set_iter_max(ctypes.byref(ctypes.c_int(ITERATIONS)), self._arg)
        library.d_ocp_qp_ipm_arg_set_tol_comp(ctypes.byref(ctypes.c_double(GAP)), self._arg)
        self._work = self._new("ipm_ws_", dim, self._arg)

    def _mask(self) -> None:
        """Tell HPIPM which ends of bounds are open."""
        p = self._point.program
        self._library.d_ocp_qp_set_all(*self._set)
        for side, w, rows in (
            ("l", p.w_low > -UNBOUNDED, p.a_low > -UNBOUNDED),
            ("u", p.w_high < UNBOUNDED, p.a_high < UNBOUNDED),
        ):
            for k in range(self._n + 1):
                x, u = self._x_at[k], self._x_at[k] + self._nx[k]
                g = self._row_at[k] + (self._nx[k + 1] if k < self._n else 0)
                parts = [("bu", w[u : u + self._nu[k]]), ("g", rows[g : g + self._ng[k]])]
                if self._bounded[k]:
                    parts.append(("bx", w[x:u]))
                for name, closed in parts:
                    values = np.ascontiguousarray(closed, dtype=float)
                    setter = getattr(self._library, f"d_ocp_qp_set_{side}{name}_mask")
                    setter(k, ctypes.c_void_p(values.ctypes.data), self._qp)

    def _pointers(self, array: NDArray[Any], begins: Index) -> Any:
        """The addresses in an array at which its stages begin, as a C array of pointers."""
        self._memory.append(array)
        addresses = (ctypes.c_void_p * (self._n + 1))(
            *(array.ctypes.data + array.itemsize * int(b) for b in begins)
        )
        self._memory.append(addresses)
        return addresses

    def _setter(self) -> list[Any]:
        """The arguments of d_ocp_qp_set_all: vectors of the point itself, and the blocks."""
        point, n = self._point, self._n
        self._defects = np.zeros(len(point.a_low))
        u_at = self._x_at + self._nx
        limits = self._row_at + np.append(self._nx[1:], 0)
        indices = np.arange(max(int(self._nx.max()), int(self._nu.max())) + 1, dtype=np.intc)
        first = np.zeros(n + 1, dtype=np.intp)
        vectors: dict[str, tuple[NDArray[Any], Index]] = {
            "b": (self._defects, self._row_at),
            "q": (point.gradient, self._x_at),
            "r": (point.gradient, u_at),
            "lbx": (point.w_low, self._x_at),
            "ubx": (point.w_high, self._x_at),
            "lbu": (point.w_low, u_at),
            "ubu": (point.w_high, u_at),
            "lg": (point.a_low, limits),
            "ug": (point.a_high, limits),
            "idxbx": (indices, first),
            "idxbu": (indices, first),
        }
        vectors |= {name: (self._blocks, begin) for name, begin in self._begin.items()}
        nothing = self._pointers(np.zeros(1), first)
        arguments = [self._pointers(*vectors[e]) if e in vectors else nothing for e in _SET.split()]
        return [*arguments, self._qp]

    def _getter(self, direction: Array) -> list[Any]:
        """The arguments of d_ocp_qp_sol_get_all; multipliers are written, and not used."""
        largest = int(np.max(self._nx + self._nu + self._ng))
        unused = self._pointers(np.zeros(largest), np.zeros(self._n + 1, dtype=np.intp))
        wanted = {
            "x": self._pointers(direction, self._x_at),
            "u": self._pointers(direction, self._x_at + self._nx),
        }
        return [self._solution, *(wanted.get(e, unused) for e in _GET.split())]


def _stages(first: Index, second: Index) -> tuple[Index, Index, Index, Index]:
    """(stage, part, place in the part, size of the part) of items that stand stage after stage."""
    stages = np.arange(len(first))
    sizes = np.stack([first, second], axis=1).ravel()
    part = np.repeat(np.tile([0, 1], len(first)), sizes)
    place = np.concatenate([np.arange(s) for s in sizes])
    return np.repeat(stages, first + second), part, place, np.repeat(sizes, sizes)
