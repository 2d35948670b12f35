"""MAT files of version 5 hold what SciPy wrote into them, nested as deep as it goes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.io import savemat

from pam_ocp.core.foreign import MOST_LEVELS, matrices_of

KINDS = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?")


def made(rng: np.random.Generator, level: int) -> Any:
    """A random value: matrix, text, cells, structure, or an array of structures."""
    what = int(rng.integers(5 if level < 4 else 2))
    if what == 0:
        shape = tuple(int(n) for n in rng.integers(1, 5, int(rng.integers(2, 4))))
        return (100 * rng.standard_normal(shape)).astype(str(rng.choice(KINDS)))
    if what == 1:
        return "".join(rng.choice(list("abc 1äß"), int(rng.integers(1, 9)))) + "."
    if what == 2:
        cells = np.empty((int(rng.integers(1, 4)), int(rng.integers(1, 4))), object)
        for index in np.ndindex(cells.shape):
            cells[index] = made(rng, level + 1)
        return cells
    names = [f"field{i}" for i in range(int(rng.integers(1, 4)))]
    if what == 3:
        return {name: made(rng, level + 1) for name in names}
    several = np.empty((1, int(rng.integers(2, 4))), [(n, object) for n in names])
    for i in range(several.shape[1]):
        several[0, i] = tuple(made(rng, level + 1) for _ in names)
    return several


def check(found: Any, written: Any) -> None:
    if isinstance(written, str):
        assert list(found) == [written.rstrip()]
    elif isinstance(written, dict):
        assert set(found) == set(written)
        for name in written:
            check(found[name], written[name])
    elif written.dtype.names:
        assert len(found) == written.size
        for one, row in zip(found, written.ravel(), strict=True):
            for name in written.dtype.names:
                check(one[name], row[name])
    elif written.dtype == object:
        assert found.shape == written.shape
        for index in np.ndindex(written.shape):
            check(found[index], written[index])
    else:
        shape = np.atleast_2d(written).shape
        assert np.squeeze(found).shape == np.squeeze(np.zeros(shape)).shape
        np.testing.assert_array_equal(np.squeeze(found), np.squeeze(written))


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("seed", range(15))
def test_random_nested_data_comes_back_as_it_was_written(seed, packed, tmp_path):
    rng = np.random.default_rng(seed)
    written = {f"v{i}": made(rng, 0) for i in range(4)}
    savemat(tmp_path / "a.mat", written, do_compression=packed)
    found = matrices_of((tmp_path / "a.mat").read_bytes(), 10**7)
    assert set(found) == set(written)
    for name, value in written.items():
        check(found[name], value)


def test_cells_within_cells_are_read_to_a_depth_and_no_further(tmp_path):
    deep: Any = np.array([[1.0]])
    for _ in range(MOST_LEVELS + 2):
        cell = np.empty((1, 1), object)
        cell[0, 0] = deep
        deep = cell
    savemat(tmp_path / "a.mat", {"deep": deep})
    with pytest.raises(ValueError, match="nested more than"):
        matrices_of((tmp_path / "a.mat").read_bytes(), 10**7)


def test_other_versions_are_refused():
    refused("no MAT file of version 5", matrices_of, b"MATLAB 7.3 MAT-file".ljust(128), 10**7)
