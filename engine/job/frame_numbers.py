"""Frames as studios number them: "1001", "1001,1003", "10-200", "-5-20", "10-200:2" or "10-200x2"."""

from __future__ import annotations

import re

_PART = re.compile(r"(-?\d{1,9})(?:-(-?\d{1,9})(?:[:x]([1-9]\d{0,8}))?)?")


def frame_numbers(text: str) -> tuple[range, ...]:
    """The frames in order of the text. Raises ValueError, which says what is wrong."""
    found = []
    for part in text.split(","):
        match = _PART.fullmatch(part.strip())
        if match is None:
            raise ValueError(f"{text!r} is not a list of frames, such as 1-250, -5-20, 1-250:2 or 1001,1003")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ValueError(f"{text!r} ends before it begins; a range looks like 1-250")
        found.append(range(first, last + 1, int(match[3] or 1)))
    return tuple(found)
