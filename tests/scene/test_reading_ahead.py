"""Frames read by several threads: in their order, and only a few ahead."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.scene import Camera, Frame, SceneError
from engine.scene.reading_ahead import READERS, read_ahead

CAMERA = Camera(4, 3, 1.0, 1.0, 2.0, 1.5, np.eye(4))
FRAMES = [
    Frame(f"{number}", CAMERA, False, Path("x.png"), None, lambda size: np.zeros((3, 4, 3), np.uint8), None, None)
    for number in range(20)
]


def test_the_order_is_kept_whoever_is_first() -> None:
    """The second frame is done before the first one may be."""
    second_is_done = threading.Event()

    def read(frame: Frame) -> str:
        if frame.name == "0":
            assert second_is_done.wait(20)
        if frame.name == "1":
            second_is_done.set()
        return frame.name

    assert list(read_ahead(FRAMES, read)) == [frame.name for frame in FRAMES]


def test_no_more_is_read_than_a_few_frames_ahead() -> None:
    begun: list[str] = []

    def read(frame: Frame) -> str:
        begun.append(frame.name)
        return frame.name

    reading = read_ahead(FRAMES, read)
    assert next(reading) == "0"
    assert len(begun) <= 2 * READERS + 1
    reading.close()  # type: ignore[attr-defined]
    assert len(begun) <= 2 * READERS + 1


def test_a_bad_frame_is_told_at_its_place() -> None:
    def read(frame: Frame) -> str:
        if frame.name == "7":
            raise SceneError("it is bad", frame.colour_path, "Mend it.")
        return frame.name

    reading = read_ahead(FRAMES, read)
    assert [next(reading) for _ in range(7)] == [str(number) for number in range(7)]
    with pytest.raises(SceneError, match="bad"):
        next(reading)


def test_frames_of_one_file_are_read_by_one_thread() -> None:
    frames = [replace(frame, file_shows_colour=False) for frame in FRAMES]
    assert set(read_ahead(frames, lambda frame: threading.get_ident())) == {threading.get_ident()}
