"""Unique names of objects and classes, for Cryptomatte, files and USD prims."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from unicodedata import normalize

_NOT_IN_MATTES = str.maketrans(dict.fromkeys(",\"'\\", " "))


def unique_names(names: Mapping[int, str], mark: str = " #") -> dict[int, str]:
    """Return the names by key, with ``mark`` and the key added to those that are not unique. Names that differ only in
    case count as equal, as some file systems do not tell them apart, and so do names with equal Cryptomatte hashes."""
    seen = Counter(form for name in names.values() for form in _forms(name))
    unique = {key: name for key, name in names.items() if all(seen[form] == 1 for form in _forms(name))}
    taken = {form for name in unique.values() for form in _forms(name)}
    for key in sorted(names.keys() - unique.keys()):
        name = f"{names[key]}{mark}{key}"
        while taken & _forms(name):
            name = f"{name}{mark}{key}"
        unique[key] = name
        taken |= _forms(name)
    return {key: unique[key] for key in names}


def _forms(name: str) -> set[str | int]:
    return {normalize("NFC", normalize("NFD", name).casefold()), name_bits(name)}


def matte_names(names: Mapping[int, str]) -> dict[int, str]:
    """Unique Cryptomatte names for classes or instances, without commas, quotes and backslashes."""
    clean = {key: " ".join(name.translate(_NOT_IN_MATTES).split()) or f"id {key}" for key, name in names.items()}
    return unique_names(clean)


def name_bits(name: str) -> int:
    """Return a name's Cryptomatte hash: MurmurHash3_32 of its UTF-8, in which an exponent bit is flipped if the float
    with these bits would not be a normal number."""
    hashed = murmur3(name.encode())
    return hashed ^ (1 << 23) if (hashed >> 23 & 255) in (0, 255) else hashed


def murmur3(data: bytes, seed: int = 0) -> int:
    """Return MurmurHash3 (x86, 32 bits) of ``data``. The algorithm is in the public domain."""
    whole = len(data) // 4 * 4
    state = seed
    for start in range(0, whole, 4):
        state ^= _scramble(int.from_bytes(data[start : start + 4], "little"))
        state = (_rotate(state, 13) * 5 + 0xE6546B64) & 0xFFFFFFFF
    if whole < len(data):
        state ^= _scramble(int.from_bytes(data[whole:], "little"))
    state ^= len(data)
    state = (state ^ state >> 16) * 0x85EBCA6B & 0xFFFFFFFF
    state = (state ^ state >> 13) * 0xC2B2AE35 & 0xFFFFFFFF
    return state ^ state >> 16


def _scramble(block: int) -> int:
    return _rotate(block * 0xCC9E2D51 & 0xFFFFFFFF, 15) * 0x1B873593 & 0xFFFFFFFF


def _rotate(value: int, bits: int) -> int:
    return (value << bits | value >> 32 - bits) & 0xFFFFFFFF
