from __future__ import annotations

import json
from pathlib import Path

from engine.posed.plain_folders import default_split, read_split

NAMES = tuple(f"{index:03d}" for index in range(20))


def test_every_eighth_frame_is_held_out_beginning_with_the_fifth() -> None:
    split = default_split(NAMES)
    assert split.test == ("004", "012") and len(split.train) == 18 and split.warnings == ()


def test_a_scene_too_short_to_hold_a_frame_out_is_reported() -> None:
    split = default_split(NAMES[:4])
    assert split.train == NAMES[:4] and split.test == () and "too few frames" in split.warnings[0]


def test_a_split_file_is_honoured_in_recording_order(tmp_path: Path) -> None:
    path = tmp_path / "splits.json"
    path.write_text(json.dumps({"train": ["003", "001", "lost"], "test": ["002"], "comment": "ours"}))
    split = read_split(path, NAMES[:5], dropped=["lost"])
    assert (split.train, split.test) == (("001", "003"), ("002",))
    assert split.warnings == ("2 frames are left out by splits.json: 000, 004",)


def test_nothing_held_out_is_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "splits.json"
    path.write_text(json.dumps({"train": list(NAMES), "test": []}))
    assert read_split(path, NAMES, []).warnings == ("no frame is held out: nothing is measured on unseen views",)
