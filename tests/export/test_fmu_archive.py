"""An archive or a description that is not safe to read is a finding, told before it is unpacked."""

from __future__ import annotations

import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from conftest import benchmark_slide
from fmu_tools import exported
from hostile import contents, packed

import pam_ocp as pam
from pam_ocp import check_fmu
from pam_ocp.cli.main import main
from pam_ocp.export.archive import UnsafeFileError, require_safe
from pam_ocp.export.runner import UnpackedFmu

DESCRIPTION = "modelDescription.xml"


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(benchmark_slide(), tmp_path_factory.mktemp("honest"))


def with_description(path: Path, text: bytes | str) -> Path:
    return packed(path, {DESCRIPTION: text.encode() if isinstance(text, str) else text})


def refused(path: Path) -> str:
    with pytest.raises(UnsafeFileError) as error:
        require_safe(path)
    return str(error.value)


def test_every_export_is_safe(honest, tmp_path):
    for path in (honest, exported(benchmark_slide(), tmp_path, "3.0")):
        require_safe(path)


def test_an_unsafe_archive_is_a_finding_and_exit_code_1(tmp_path, capsys):
    path = packed(tmp_path / "unit.fmu", {DESCRIPTION: b"<a/>", "../../outside": b"here"})
    checked = check_fmu(path)
    (finding,) = checked.findings
    assert "'../../outside' leads out of the archive's folder" in finding
    assert checked.fmi == ""
    assert main(["check", str(path)]) == 1
    assert finding in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *((name, "leads out") for name in ("../a", "resources/../../a")),
        *((name, "absolute path") for name in ("/etc/a", "C:/a", "c:a")),
        *((name, "no name of a file") for name in ("..\\a", "resources\\a")),
    ],
)
def test_names_that_lead_elsewhere_are_refused(tmp_path, name, words):
    path = packed(tmp_path / "unit.fmu", {DESCRIPTION: b"<a/>", name: b""})
    assert words in refused(path)
    with pytest.raises(pam.InputError, match=words):
        UnpackedFmu(path, tmp_path / "unpacked")
    assert not (tmp_path / "unpacked").exists()


def test_a_name_that_is_there_twice_is_refused(tmp_path):
    path = tmp_path / "unit.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(DESCRIPTION, "<a/>")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr(DESCRIPTION, "<b/>")
    assert "in the archive twice" in refused(path)


def test_twenty_thousand_files_are_refused(tmp_path):
    path = tmp_path / "unit.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(20_000):
            archive.writestr(f"resources/{i}", b"")
    assert "20000 files, 10000 are allowed" in refused(path)


def grown(path: Path, name: str, size: int) -> None:
    """Let the archive's directory say that a file has another size."""
    data = bytearray(path.read_bytes())
    at = data.find(b"PK\x01\x02")
    while at >= 0:
        length = struct.unpack_from("<H", data, at + 28)[0]
        if data[at + 46 : at + 46 + length] == name.encode():
            struct.pack_into("<I", data, at + 24, size)
        at = data.find(b"PK\x01\x02", at + 4)
    path.write_bytes(bytes(data))


def test_a_bomb_is_refused_by_its_directory(tmp_path):
    content = {DESCRIPTION: b"<a/>", "resources/zeros": bytes(1_000_000)}
    path = packed(tmp_path / "unit.fmu", content)
    grown(path, "resources/zeros", 0xFFFFFFF0)
    assert "unpacks to 4295 MB, 1074 are allowed" in refused(path)


def test_zeros_that_are_small_in_the_archive_are_refused(tmp_path):
    path = packed(tmp_path / "unit.fmu", {DESCRIPTION: b"<a/>", "resources/zeros": bytes(40 << 20)})
    assert "more than 200 times its size" in refused(path)


def test_a_directory_that_lies_about_a_size_is_a_finding(honest, tmp_path):
    """What is unpacked ends at the size that was told; then its checksum is wrong."""
    content = contents(honest) | {"resources/zeros": bytes(20 << 20)}
    path = packed(tmp_path / "unit.fmu", content)
    grown(path, "resources/zeros", 10)
    (finding,) = check_fmu(path).findings
    assert "cannot be read as an FMU" in finding


# ---- XML -----------------------------------------------------------------------------------------

LAUGHS = '<!DOCTYPE a [<!ENTITY l0 "ha">' + "".join(
    f'<!ENTITY l{i + 1} "&l{i};&l{i};&l{i};&l{i};&l{i};&l{i};&l{i};&l{i};">' for i in range(30)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f'<?xml version="1.0"?>{LAUGHS}]><fmiModelDescription a="&l30;"/>', "DOCTYPE"),
        ('<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', "DOCTYPE"),
        ('<!DOCTYPE a SYSTEM "http://localhost/a.dtd"><a/>', "DOCTYPE"),
        ("<html><body/></html>", "the root of modelDescription.xml is <html>"),
        ('<fmiModelDescription fmiVersion="1.0"/>', "fmiVersion '1.0'; FMI 2.0 and 3.0"),
        ("<fmiModelDescription/>", "fmiVersion ''"),
        ('<fmiModelDescription fmiVersion="2.0">', "cannot be read (no element found"),
        ("", "cannot be read (no element found"),
        ("not XML", "cannot be read (syntax error"),
        ('<fmiModelDescription fmiVersion="3.0">' + "<a>" * 5000, "more than 100 deep"),
        (b"\x00\x01\x02", "cannot be read"),
    ],
)
def test_foreign_descriptions_have_a_sentence_each(tmp_path, text, words):
    assert words in refused(with_description(tmp_path / "unit.fmu", text))


def test_a_doctype_in_another_encoding_is_seen(tmp_path):
    text = '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'
    assert "DOCTYPE" in refused(with_description(tmp_path / "unit.fmu", text.encode("utf-16")))


@pytest.mark.parametrize(
    "name", ["terminalsAndIcons/terminalsAndIcons.xml", "sources/buildDescription.xml"]
)
def test_entities_in_the_neighbours_are_seen(honest, tmp_path, name):
    content = contents(honest) | {name: f"{LAUGHS}]><a/>".encode()}
    assert f"{name} has a DOCTYPE" in refused(packed(tmp_path / "unit.fmu", content))


def test_a_huge_description_is_refused(tmp_path):
    path = tmp_path / "unit.fmu"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(DESCRIPTION, b" " * (65 << 20))
    assert "68 MB, 67 are allowed" in refused(path)


def test_an_archive_without_description_is_no_fmu(tmp_path):
    path = packed(tmp_path / "unit.fmu", {"readme.txt": b""})
    assert "no modelDescription.xml" in check_fmu(path).findings[0]


def test_an_fmu_of_no_kind_that_can_be_run_is_a_finding(honest, tmp_path):
    content = contents(honest)
    text = content[DESCRIPTION].decode()
    for kind in ("ModelExchange", "CoSimulation"):
        text = re.sub(rf"(?s)<{kind} .*?</{kind}>", "", text)
    content[DESCRIPTION] = text.encode()
    checked = check_fmu(packed(tmp_path / "unit.fmu", content))
    assert not checked.ok


def test_terminals_get_nothing_but_plain_text(honest, tmp_path):
    """Words of a unit may hold codes that move the cursor."""
    content = contents(honest)
    text = content[DESCRIPTION].decode().replace('name="x"', 'name="x\u009b2J\u202e"', 1)
    content[DESCRIPTION] = text.encode()
    checked = check_fmu(packed(tmp_path / "unit.fmu", content))
    assert checked.findings
    assert all(line.isprintable() for line in str(checked).splitlines())


def test_damaged_archives_are_findings_or_refused_in_a_sentence(honest, tmp_path):
    """Bytes changed anywhere: what can be told without running the unit, here and quickly."""
    sentences = []
    whole, rng = honest.read_bytes(), np.random.default_rng(4)
    for trial in range(150):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 1 + trial % 20):
            damaged[at] = rng.integers(256)
        if trial % 3 == 0:
            del damaged[int(rng.integers(len(damaged))) :]
        if trial % 3 == 1:  # in the directory at the end
            at = int(rng.integers(max(0, len(damaged) - 2000), len(damaged)))
            damaged[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / "damaged.fmu"
        path.write_bytes(bytes(damaged))
        try:
            UnpackedFmu(path, tmp_path / "unpacked")
        except pam.InputError as error:
            sentences.append(str(error))
    assert len(sentences) > 50
    assert all("cannot be read as an FMU" in s for s in sentences)
