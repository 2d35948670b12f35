"""Small files that unpack to much are refused before they are read, in one sentence."""

import io
import json
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.core import files, foreign
from pam_ocp.core.files import json_of, members_of, most_unpacked, read_npz, write_json, write_npz
from pam_ocp.core.foreign import read_hdf5, read_mat
from pam_ocp.export.archive import require_safe
from pam_ocp.fitting.tables.trees import chosen_table

MIB = 2**20


def refused(read, path, words, most=64 * MIB):
    """By these words, and without that much memory."""
    tracemalloc.start()
    try:
        with pytest.raises(pam.InputError, match=words) as found:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
    assert path.name in str(found.value) or "archive" in str(found.value)
    assert "\n" not in str(found.value)


def npy(array):
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def npz(path, method=zipfile.ZIP_DEFLATED, **members):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def read_plan_file(path):
    return read_npz(path, "a plan file")


# ---- tables in arrays ----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("shapes", "words"),
    [
        ([(20_000_001,)], "has 20000001 rows, more than the 20000000 allowed"),
        ([(20_000_000,)] * 6, "holds 120000000 numbers, more than the 100000000 allowed"),
    ],
)
def test_arrays_of_very_many_numbers_become_no_table(shapes, words):
    """What a file of some hundred kilobytes unpacks to; arrays of one number take no memory."""
    arrays = {f"t{i}": np.broadcast_to(0.0, shape) for i, shape in enumerate(shapes)}
    tracemalloc.start()
    try:
        with pytest.raises(pam.InputError, match=words):
            chosen_table({"deep": [arrays]}, "rig.npz", None)
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


# ---- zip files -----------------------------------------------------------------------------------
def test_what_stands_beside_arrays_is_bounded_before_it_is_read(tmp_path):
    """A text of 70 million characters, packed to some hundred kilobytes."""
    head = npy(np.array("a"))[:-4].replace(b"<U1", b"<U%d" % 70_000_000, 1)
    head = head[:8] + struct.pack("<H", len(head) - 10) + head[10:]
    path = npz(tmp_path / "plan.npz", meta=head + bytes(280_000_000))
    assert path.stat().st_size < MIB
    refused(read_plan_file, path, r"'meta' unpacks to 267 MiB, more than the 256 allowed")


def test_a_text_of_a_million_lists_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_JSON_PARTS", 1000)
    path = npz(tmp_path / "plan.npz", meta=npy(np.array("[" + "[]," * 1000 + "[]]")))
    refused(read_plan_file, path, "1002 lists and mappings with 1000 values, more than the 1000")
    monkeypatch.setattr(files, "MOST_JSON_PARTS", 1002)
    with pytest.raises(pam.InputError, match="is no plan file"):
        read_plan_file(path)
    monkeypatch.setattr(files, "MOST_JSON_VALUES", 999)
    refused(read_plan_file, path, "and 999 allowed")


def test_brackets_and_commas_in_words_are_no_lists(monkeypatch):
    monkeypatch.setattr(files, "MOST_JSON_PARTS", 1)
    monkeypatch.setattr(files, "MOST_JSON_VALUES", 0)
    said = {"words": "[[[,,,\\"}
    assert json_of(json.dumps(said).encode()) == said


@pytest.mark.parametrize("wrong", [np.array(["a", "b"]), np.array(1.0), np.array(b"{}")])
def test_what_stands_beside_arrays_is_one_text(tmp_path, wrong):
    path = npz(tmp_path / "plan.npz", meta=npy(wrong))
    refused(read_plan_file, path, "'meta' is not one text")


def test_what_could_not_be_read_again_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_JSON", 1000)
    path = tmp_path / "a"
    for write in (lambda c: write_json(path, c), lambda c: write_npz(path, c, {})):
        write({"a": "x" * 900})
        before = path.read_bytes()
        with pytest.raises(pam.InputError, match="was not written"):
            write({"a": "x" * 1000})
        assert path.read_bytes() == before


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_what_unpacks_without_a_bound_is_not_unpacked(tmp_path, method):
    """Of bzip2 one step is 4 kB, which 45 bytes for each 900 kB fill."""
    path = npz(tmp_path / "plan.npz", method, meta=npy(np.array("{}")))
    refused(read_plan_file, path, "packed by method .*; pack it anew, deflated")
    refused(pam.read_table, path, "packed by method")
    refused(require_safe, path, "packed by method .* the archive is not unpacked")


def test_a_directory_that_lies_about_a_size_gets_no_more_than_it_says(tmp_path):
    path = npz(tmp_path / "plan.npz", meta=npy(np.array("{}")), a=npy(np.zeros(10**6)))
    content = path.read_bytes()
    told = struct.pack("<L", 8 * 10**6 + 128)
    assert content.count(told) == 2  # the member's own head, and the directory
    path.write_bytes(content.replace(told, struct.pack("<L", 1000)))
    refused(read_plan_file, path, "cannot be read as a plan file", most=4 * MIB)


def test_a_directory_of_very_many_members_is_not_read(tmp_path):
    path = tmp_path / "plan.npz"
    entry = struct.pack("<4s4B4HL2L5H2L", b"PK\1\2", 20, 0, 20, *[0] * 8, 1, *[0] * 6) + b"a"
    many = 2 * files.MOST_DIRECTORY // len(entry)
    assert len(entry) == 47
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0, 0, many * len(entry), 0, 0)
    path.write_bytes(entry * many + end)
    refused(read_plan_file, path, "its directory has more than 4 MiB")
    refused(require_safe, path, "its directory has more than 4 MiB")
    path.write_bytes(entry * 3 + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 3, 3, 141, 0, 0))
    assert [m.filename for m in members_of(path)] == ["a"] * 3


def test_arrays_that_are_packed_as_nothing_measured_is_are_not_unpacked(tmp_path):
    """66 MiB in 70 kB; in a file of a hundred times that size they are read."""
    zeros = np.zeros(66 * MIB // 8)
    small = npz(tmp_path / "rig.npz", a=npy(zeros))
    refused(pam.read_table, small, "of 66 MiB; at most 1000 parts of 64 MiB are allowed")
    matlab = mat_file(tmp_path / "rig.mat", matrix(6, (zeros.size, 1), element(9, bytes(zeros))))
    refused(read_mat, matlab, "unpacks to more than", most=140 * MIB)
    assert most_unpacked(10**6) == 300 * 10**6
    assert most_unpacked(10**9) == files.MOST_UNPACKED


# ---- MATLAB --------------------------------------------------------------------------------------
def element(kind, content):
    return struct.pack("<2I", kind, len(content)) + content + bytes(-len(content) % 8)


def matrix(kind, shape, *parts):
    flags = element(6, struct.pack("<2I", kind, 0))
    sizes = element(5, struct.pack(f"<{len(shape)}i", *shape))
    return element(14, flags + sizes + element(1, b"a") + b"".join(parts))


def mat_file(path, *matrices):
    packed = [zlib.compress(m) for m in matrices]
    head = b"MATLAB 5.0".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + b"".join(struct.pack("<2I", 15, len(p)) + p for p in packed))
    return path


@pytest.mark.parametrize("shape", [(1, 11_000_000), (11_000_000, 1)])
def test_a_text_of_very_many_characters_is_not_made(tmp_path, shape):
    """Each would be an object of Python, or a row of them."""
    path = mat_file(tmp_path / "a.mat", matrix(4, shape, element(4, bytes(22_000_000))))
    assert path.stat().st_size < 50_000
    refused(read_mat, path, "its text has more than 10000000 characters")


def test_a_cell_of_very_many_entries_is_not_made(tmp_path, monkeypatch):
    monkeypatch.setattr(foreign, "MOST_ENTRIES", 10_000)
    path = mat_file(tmp_path / "a.mat", matrix(1, (1, 10**6), element(14, b"") * 10**6))
    refused(read_mat, path, "more than 10000 entries")


def test_cells_within_cells_are_not_copied(tmp_path):
    inner = matrix(6, (10**6, 1), element(9, bytes(8 * 10**6)))
    for _ in range(12):
        inner = matrix(1, (1, 1), inner)
    path = mat_file(tmp_path / "a.mat", inner)
    tracemalloc.start()
    try:
        found = read_mat(path)["a"]
        assert tracemalloc.get_traced_memory()[1] < 4 * 8 * 10**6
    finally:
        tracemalloc.stop()
    for _ in range(12):
        found = found[0, 0]
    assert np.array_equal(found, np.zeros((10**6, 1)))


# ---- HDF5 ----------------------------------------------------------------------------------------
@pytest.fixture
def h5py():
    return pytest.importorskip("h5py")


def test_texts_that_all_lie_in_one_place_are_counted_each(tmp_path, h5py, monkeypatch):
    """Ten thousand references to one text of a megabyte are ten gigabytes."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        kind = h5py.string_dtype()
        file.create_dataset("a", data=np.array(["x" * MIB, "y" * MIB], dtype=object), dtype=kind)
    content = path.read_bytes()
    with h5py.File(path) as file:
        at = file["a"].id.get_offset()
    one = content[at : at + 16]
    with h5py.File(path, "w") as file:
        data = file.create_dataset("a", (10_000,), dtype=h5py.string_dtype())
        data[0] = "x" * MIB
        file.flush()
        place = data.id.get_offset()
    content = bytearray(path.read_bytes())
    one = bytes(content[place : place + 16])
    content[place : place + 160_000] = one * 10_000
    path.write_bytes(content)
    monkeypatch.setattr(files, "MOST_UNPACKED", 20 * MIB)
    refused(read_hdf5, path, "unpacks to more than is allowed")


def test_texts_of_any_length_are_read_as_they_are(tmp_path, h5py):
    said = [["a", "bb", ""], ["äö", "x" * 5000, "z"]]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=np.array(said, dtype=object), dtype=h5py.string_dtype())
    assert read_hdf5(tmp_path / "a.h5")["a"].tolist() == [t for row in said for t in row]


@pytest.mark.parametrize("what", ["letters", "references"])
def test_very_many_texts_or_cells_are_not_made(tmp_path, h5py, monkeypatch, what):
    monkeypatch.setattr(foreign, "MOST_ENTRIES", 1000)
    path = tmp_path / "a.h5"
    kind = "S1" if what == "letters" else h5py.ref_dtype
    with h5py.File(path, "w") as file:
        file.create_dataset("a", (10**6,), dtype=kind, chunks=(10**5,), compression="gzip")
    refused(read_hdf5, path, "more than 1000 texts and cells")


# ---- text ----------------------------------------------------------------------------------------
def test_a_table_in_one_line_is_refused_before_its_separator_is_sought(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"1" + b",1" * MIB)
    refused(pam.read_table, path, "line 1 has 2097153 characters, at most 1048576 are read")
