"""File names that Blender can count through. Plain Python."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_LAST_NUMBER = re.compile(r"(?s)(.*?)(\d+)(\D*)")
_LARGEST = 2**31 - 1


@dataclass(frozen=True)
class NumberedNames:
    """`first` is the name to open; `numbers[i]` takes its number's place to give the i-th name."""

    first: str
    numbers: tuple[int, ...]


def numbered(names: Sequence[str]) -> NumberedNames | None:
    """Read names as one numbered sequence, gaps allowed, or None when they are not.

    Blender replaces the last number in a name and pads it to the width that it has in the opened file. So all
    names must have the same text around that number, and the padding of the shortest must give all the
    others.
    """
    parts = [_LAST_NUMBER.fullmatch(name) for name in names]
    if not parts or any(part is None for part in parts):
        return None
    split = [part.groups() for part in parts if part is not None]
    head, digits, tail = min(split, key=lambda each: len(each[1]))
    numbers = tuple(int(number) for _, number, _ in split)
    if any(
        f"{head}{number:0{len(digits)}d}{tail}" != name for number, name in zip(numbers, names, strict=True)
    ):
        return None
    return NumberedNames(head + digits + tail, numbers) if max(numbers) <= _LARGEST else None


def sequences(names: Sequence[str]) -> dict[str, list[str]]:
    """Names in groups that Blender can count through, each by what stands before the number: "shot" of "shot.0001"
    and "shot.0002". A name that fits in no group is one by itself.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        parts = _LAST_NUMBER.fullmatch(name)
        groups.setdefault(parts[1].rstrip(" ._-") if parts is not None else name, []).append(name)
    found: dict[str, list[str]] = {}
    for stem, group in groups.items():
        found |= {stem or group[0]: group} if numbered(group) else {name: [name] for name in group}
    return found
