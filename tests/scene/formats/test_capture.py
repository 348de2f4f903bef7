"""What readers of all formats share."""

from __future__ import annotations

import pytest

from engine.scene.formats.capture import frame_names


@pytest.mark.parametrize("odd", ["", ".", "/", "//", "\\", "..", "./."])
def test_a_path_without_a_name_is_a_frame_too(odd: str) -> None:
    """Random search found it in a COLMAP model: an image whose name was cut off."""
    names = frame_names(["a/0001.png", odd])
    assert names[0] == "0001" and names[1] and "/" not in names[1]
    assert all(frame_names([odd, odd, "a/0001.png", "b/0001.png"]))
