"""preview.json: what is written is read again, and what is not a camera is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.job.cameras import PreviewCamera, read_preview_request, write_preview_request

POSE = ((0.0, 0.0, 1.0, 4.0), (1.0, 0.0, 0.0, 5.0), (0.0, 1.0, 0.0, 6.0), (0.0, 0.0, 0.0, 1.0))
LENS = ((300.0, 0.0, 160.0), (0.0, 310.0, 120.0), (0.0, 0.0, 1.0))
CAMERA = PreviewCamera(POSE, LENS, 320, 240)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "preview.json"
    assert read_preview_request(path) is None
    for wanted in ("0004", CAMERA):
        write_preview_request(path, wanted)
        assert read_preview_request(path) == wanted
    assert [each.name for each in tmp_path.iterdir()] == ["preview.json"]


@pytest.mark.parametrize(
    "change",
    [
        {"camera_to_world": None},
        {"camera_to_world": [[1, 0, 0, 0]] * 4},
        {"camera_to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]},
        {"camera_to_world": [[1, 0, 0, 1e999], *([0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1])]},
        {"K": [[0, 0, 160], [0, 310, 120], [0, 0, 1]]},
        {"K": [[300, 5, 160], [0, 310, 120], [0, 0, 1]]},
        {"K": [["300", 0, 160], [0, 310, 120], [0, 0, 1]]},
        {"width": 0},
        {"height": 1e9},
        {"height": True},
        {"frame": 4, "width": None},
    ],
)
def test_what_is_not_a_camera_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    path = tmp_path / "preview.json"
    whole = {"camera_to_world": POSE, "K": LENS, "width": 320, "height": 240}
    path.write_text(json.dumps(whole | change))
    with pytest.raises(PlgsError):
        read_preview_request(path)


@pytest.mark.parametrize("content", ["", "{", "[]", "{}", "\0\0"])
def test_a_broken_file_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "preview.json"
    path.write_text(content)
    with pytest.raises(PlgsError):
        read_preview_request(path)
