"""What a lift's scene was made of is compared, whatever file says it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.job import LiftFolder, LiftRequest
from engine.known_scene import stored_scene, write_known
from engine.scene import digests_of_files, open_scene
from engine.scene_of_lift import _digests_of, digest_of_masks, masks_differ, refuse_changed, remember_scene
from tests.raises_key import raises_key
from tests.scene.formats.test_record3d import lzfse  # noqa: F401 - a fixture
from tests.scene.samples import WRITERS, Sample, opened, samples, with_content  # noqa: F401 - a fixture among them
from tests.tiny_scene import write_tiny_scene

Change = Callable[[bytes], bytes]


def longer(data: bytes) -> bytes:
    return data + b"\n"


def in_json(**changes: object) -> Change:
    return lambda data: json.dumps(json.loads(data) | changes).encode()


@pytest.mark.parametrize("name", WRITERS)
def test_every_frame_of_a_lift_is_compared_with_its_scene(sample: Sample, name: str) -> None:
    """A frame whose files cannot be read as files, as a folder cannot, would stand for any other."""
    assert all(all(digests) for digests in _digests_of(opened(sample(name), name).frames))


@pytest.mark.parametrize("name", WRITERS)
def test_a_lift_of_an_earlier_version_can_be_used(sample: Sample, name: str, tmp_path: Path) -> None:
    """Its records know the photos and the depth as files, not how these are read, nor confidence."""
    scene = opened(sample(name), name)
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=sample(name)))
    files = digests_of_files([(frame.colour_path, frame.depth_path) for frame in scene.frames])
    known = stored_scene(scene, scene.frames)
    frames = tuple(replace(frame, files=digest) for frame, digest in zip(known.frames, files, strict=True))
    write_known(folder, replace(known, frames=frames))
    refuse_changed(folder, scene)


@pytest.mark.parametrize(
    ("name", "file", "change"),
    [
        ("record3d", "a.r3d", longer),
        ("record3d-unpacked", "rgbd/3.jpg", longer),
        ("record3d-unpacked", "rgbd/3.depth", longer),
        ("record3d-unpacked", "rgbd/3.conf", longer),
        ("stray", "confidence/000003.png", longer),
        ("polycam", "keyframes/confidence/*.png", longer),
        ("scanner-app", "conf_00002.png", longer),
        ("nerfstudio", "transforms.json", in_json(integer_depth_scale=0.0005)),
        ("nerfstudio", "transforms.json", in_json(k1=0.2)),
    ],
)
def test_a_lift_refuses_changed_pictures(sample: Sample, name: str, file: str, change: Change, tmp_path: Path) -> None:
    scene, path = sample(name), min(sample(name).glob(file))
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene))
    remember_scene(folder, opened(scene, name))
    refuse_changed(folder, opened(scene, name))
    with with_content(path, change(path.read_bytes())), raises_key("other-scene"):
        refuse_changed(folder, opened(scene, name))
    refuse_changed(folder, opened(scene, name))


def test_a_lift_notices_changed_masks_of_its_scene(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path / "scene", frames=3, size=(16, 12)))
    before = digest_of_masks(scene)
    assert not masks_differ("", scene) and not masks_differ(before, scene)
    mask = tmp_path / "scene" / "panoptic" / "0001.png"
    assert cv2.imwrite(str(mask), np.zeros_like(cv2.imread(str(mask))))
    assert masks_differ(before, open_scene(tmp_path / "scene"))
