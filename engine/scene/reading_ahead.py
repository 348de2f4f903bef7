"""Frames read by several threads, in their order: decoding a picture holds no lock of Python's."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from .frame import Frame

Read = TypeVar("Read")
READERS = 2
"""Threads; with more, the pictures that wait would take the memory."""


def read_ahead(frames: Sequence[Frame], read: Callable[[Frame], Read]) -> Iterator[Read]:
    """``read`` of each frame, a few frames ahead of who asks. Frames of one file, such as a video, are read one after
    another, as they lie in it. Raises what ``read`` raises, at the frame's own place."""
    if not all(frame.file_shows_colour for frame in frames):
        yield from map(read, frames)
        return
    with ThreadPoolExecutor(READERS, "read") as pool:
        waiting: deque[Future[Read]] = deque()
        try:
            for frame in frames:
                waiting.append(pool.submit(read, frame))
                if len(waiting) > 2 * READERS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
