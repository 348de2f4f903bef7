"""Name the views of shots, and find which of these names Blender can step through as one sequence."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import bpy

from ..engine.errors import PlgsError
from ..engine.job.cameras import filled_name, safe_name

VERSION = re.compile(r"(?:^|[._-])v(\d{1,6})(?=$|[._-])", re.IGNORECASE)
"""The version in a file's name, as in "shot_v012.blend"."""
_LAST_NUMBER = re.compile(r"(?s)(.*?)(\d+)(\D*)")
BEFORE_0 = re.compile(r"(?s)(.*)\.-\d+")
"""The name of a shot's frame before 0. Blender counts from 0, so these frames are a sequence of their own."""
_LARGEST_NUMBER = 2**31 - 1  # Blender counts frames in 32 bits
_LONGEST_NAME = 80  # maximum length of a shot's name, to which each view adds a number


def shot_name(camera: str, given: str = "", later: int = 0) -> str:
    """Return the name of a camera's views, without their numbers: ``given``, else the names of the .blend and the
    camera. If these are long they are cut, and end in a hash, so that different names stay different. ``given`` may
    have fields: {shot} (the .blend's name without its version), {camera}, {layer} ("passes"), {version} (the .blend's,
    such as 12 of "_v012", else 1, plus ``later``), and at the end ".{frame:04d}", which all names have. Raises
    PlgsError for other fields and for a given name that is too long."""
    if "{" in given or "}" in given:
        given = _filled(given, camera, later)
    if len(given) > _LONGEST_NAME:
        what = f"the shot's name has {len(given)} characters, over {_LONGEST_NAME}"
        raise PlgsError("long-name", what, given, "Give it a shorter one with --shot.", option="--shot")
    words = [given] if given else [bpy.path.display_name_from_filepath(bpy.data.filepath), camera]
    most = _LONGEST_NAME // len(words)
    return safe_name("_".join(_short(word, most) for word in words if word))


def next_versions_name(given: str) -> str:
    """Return the name that a user gave a shot ("": that of the .blend and the camera), with a field for its version."""
    return given if "{version" in given else f"{given or '{shot}_{camera}'}_v{{version:03d}}"


def _short(text: str, most: int) -> str:
    name = safe_name(text)
    return name if len(name) <= most else f"{name[: most - 9]}_{zlib.crc32(text.encode(errors='replace')):08x}"


def _filled(template: str, camera: str, later: int) -> str:
    blend = bpy.path.display_name_from_filepath(bpy.data.filepath)
    version = VERSION.search(blend)
    number = int(version[1]) if version else 1
    try:
        return filled_name(template, VERSION.sub("", blend) or "untitled", camera, number + later)
    except ValueError as error:
        fix = "Use {shot}, {camera}, {layer}, {version:03d}, and {frame:04d} only at its end, after a dot."
        what = f"the shot's name cannot be filled in ({error})"
        raise PlgsError("bad-template", what, template, fix, option="--shot") from error


@dataclass(frozen=True)
class NumberedNames:
    """Names that Blender can step through: name i is `first` (the opened file) with `numbers[i]` as its number."""

    first: str
    numbers: tuple[int, ...]


def numbered(names: Sequence[str]) -> NumberedNames | None:
    """Return the names as one numbered sequence, possibly with gaps, None if they form no sequence. Blender replaces
    the last number in the opened name, padded to its width: this must give all the other names."""
    parts = [_LAST_NUMBER.fullmatch(name) for name in names]
    if not parts or any(part is None for part in parts):
        return None
    split = [part.groups() for part in parts if part is not None]
    head, digits, tail = min(split, key=lambda each: len(each[1]))  # the padded width
    numbers = tuple(int(number) for _, number, _ in split)
    counted = [f"{head}{number:0{len(digits)}d}{tail}" for number in numbers]
    if counted != [*names] or max(numbers) > _LARGEST_NUMBER:
        return None
    return NumberedNames(head + digits + tail, numbers)


def sequences(names: Sequence[str]) -> dict[str, list[str]]:
    """Group names that Blender can step through, by the text before the number: "shot" for "shot.0001", "shot before 0"
    for "shot.-0001". A name that fits no group is a group of its own."""
    groups: dict[str, list[str]] = {}
    for name in names:
        parts, before = _LAST_NUMBER.fullmatch(name), BEFORE_0.fullmatch(name)
        stem = name if parts is None else parts[1].rstrip(" ._-") if before is None else f"{before[1]} before 0"
        groups.setdefault(stem, []).append(name)
    found: dict[str, list[str]] = {}
    for stem, group in groups.items():
        found |= {stem or group[0]: group} if numbered(group) else {name: [name] for name in group}
    return found
