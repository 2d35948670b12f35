"""Which functions a shared library lets others see: small readers of ELF, Mach-O and PE."""

from __future__ import annotations

import struct


def exported_symbols(library: bytes) -> list[str]:
    """Names of the exported symbols of a shared library, sorted. ELF and PE also of 32 bits.

    Raises ValueError when the format is not known.
    """
    magic = library[:4]
    if magic == b"\x7fELF":
        found = _elf(library)
    elif magic == b"\xcf\xfa\xed\xfe":
        found = _mach_o(library)
    elif magic == b"\xca\xfe\xba\xbe":
        found = _universal(library)
    elif magic[:2] == b"MZ":
        found = _pe(library)
    else:
        raise ValueError("neither ELF, Mach-O nor PE")
    return sorted(set(found))


def _string(data: bytes, offset: int) -> str:
    return data[offset : data.index(b"\0", offset)].decode("utf-8", "replace")


def _elf(data: bytes) -> list[str]:
    """Global defined symbols of .dynsym."""
    wide = data[4] == 2  # 64 bits: other sizes, and another order of the fields of a symbol
    (start,) = struct.unpack_from("<Q" if wide else "<I", data, 0x28 if wide else 0x20)
    size, count = struct.unpack_from("<HH", data, 0x3A if wide else 0x2E)
    layout = "<IIQQQQIIQQ" if wide else "<10I"
    sections = [struct.unpack_from(layout, data, start + i * size) for i in range(count)]
    names = []
    for section in sections:
        kind, offset, length, link = section[1], section[4], section[5], section[6]
        if kind != 11:  # SHT_DYNSYM
            continue
        strings = sections[link][4]
        for at in range(offset, offset + length, 24 if wide else 16):
            if wide:
                name, info, _, index = struct.unpack_from("<IBBH", data, at)
            else:
                name, _, _, info, _, index = struct.unpack_from("<IIIBBH", data, at)
            if index != 0 and info >> 4 in (1, 2):  # defined, global or weak
                names.append(_string(data, strings + name))
    return names


def _mach_o(data: bytes) -> list[str]:
    """Names in the export trie, without the leading underscore."""
    (commands,) = struct.unpack_from("<I", data, 16)
    at = 32
    for _ in range(commands):
        command, size = struct.unpack_from("<II", data, at)
        if command == 0x80000033:  # LC_DYLD_EXPORTS_TRIE
            offset, length = struct.unpack_from("<II", data, at + 8)
            return _trie(data[offset : offset + length])
        if command in (0x22, 0x80000022):  # LC_DYLD_INFO, LC_DYLD_INFO_ONLY
            offset, length = struct.unpack_from("<II", data, at + 40)
            return _trie(data[offset : offset + length])
        at += size
    return []


def _uleb(data: bytes, at: int) -> tuple[int, int]:
    """An unsigned LEB128 number and the place behind it."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _trie(data: bytes) -> list[str]:
    names, waiting = [], [(0, "")] if data else []
    while waiting:
        at, prefix = waiting.pop()
        terminal, at = _uleb(data, at)
        if terminal:
            names.append(prefix.removeprefix("_"))
        at += terminal
        children, at = data[at], at + 1
        for _ in range(children):
            label = _string(data, at)
            child, at = _uleb(data, at + len(label) + 1)
            waiting.append((child, prefix + label))
    return names


def _universal(data: bytes) -> list[str]:
    (count,) = struct.unpack_from(">I", data, 4)
    names = []
    for i in range(count):
        _, _, offset, size, _ = struct.unpack_from(">IIIII", data, 8 + 20 * i)
        names += _mach_o(data[offset : offset + size])
    return names


def _pe(data: bytes) -> list[str]:
    """Names of the export table of a PE32 (32 bits) or PE32+ library."""
    (header,) = struct.unpack_from("<I", data, 0x3C)
    (sections,) = struct.unpack_from("<H", data, header + 6)
    (optional,) = struct.unpack_from("<H", data, header + 20)
    (kind,) = struct.unpack_from("<H", data, header + 24)
    (exports,) = struct.unpack_from("<I", data, header + 24 + (112 if kind == 0x20B else 96))
    table = header + 24 + optional

    def position(address: int) -> int:
        for i in range(sections):
            length, start, _, raw = struct.unpack_from("<IIII", data, table + 40 * i + 8)
            if start <= address < start + length:
                return int(raw + address - start)
        raise ValueError("address outside all sections")

    if exports == 0:
        return []
    at = position(exports)
    count, _, names = struct.unpack_from("<III", data, at + 24)
    first = position(names)
    return [
        _string(data, position(struct.unpack_from("<I", data, first + 4 * i)[0]))
        for i in range(count)
    ]
