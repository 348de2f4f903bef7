"""ScanNet++'s iPhone data, as its toolkit takes it apart."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import lz4.block
import numpy as np
import pytest

from engine.scene import open_scene
from tests.raises_key import raises_key
from tests.scene.formats.room import Lens, check_on_room, in_steps, look, opencv_pose, views, write_colour, write_grey

DEPTH = Lens(256, 192, 220.0, 220.0, 131.0, 93.0)
LENS = DEPTH.scaled(0.75)


def raw_deflate(data: bytes) -> bytes:
    packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def one_stream(depths: list[np.ndarray]) -> bytes:
    return raw_deflate(b"".join(depth.astype("<f4").tobytes() for depth in depths))


def lz4_blocks(depths: list[np.ndarray]) -> bytes:
    blocks = [lz4.block.compress(in_steps(depth, 1000).astype("<u2").tobytes(), store_size=False) for depth in depths]
    return b"".join(struct.pack("<I", len(block)) + block for block in blocks)


def deflated_blocks(depths: list[np.ndarray]) -> bytes:
    blocks = [raw_deflate(depth.astype("<f4").tobytes()) for depth in depths]
    return b"".join(struct.pack("<I", len(block)) + block for block in blocks)


def depths_with_a_flat_top() -> list[np.ndarray]:
    depths = [look(view, DEPTH).depth for view in views()]
    for depth in depths:
        depth[3:40] = 0.0
    return depths


def write_table(folder: Path, **changes: object) -> None:
    """pose is ARKit's own, in another world than aligned_pose."""
    table: dict[str, object] = {}
    for i, view in reversed([*enumerate(views())]):
        K = [[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1]]
        table[f"frame_{i:06d}"] = {
            "timestamp": i / 60, "pose": np.eye(4).tolist(), "intrinsic": K, "aligned_pose": opencv_pose(view).tolist(),
        }  # fmt: skip
    table["frame_000006"] = {"pose": np.eye(4).tolist(), "intrinsic": K}
    (folder / "pose_intrinsic_imu.json").write_text(json.dumps(table | changes))


def write_scannetpp(folder: Path, pack: Callable[[list[np.ndarray]], bytes]) -> Path:
    iphone = folder / "iphone"
    iphone.mkdir()
    video = cv2.VideoWriter(str(iphone / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60, (LENS.width, LENS.height))
    for view in [*views(), views()[0]]:
        video.write(np.ascontiguousarray(look(view, LENS).colour[..., ::-1]))
    video.release()
    (iphone / "depth.bin").write_bytes(pack(depths_with_a_flat_top()))
    write_table(iphone)
    return folder


@pytest.mark.parametrize("pack", [one_stream, lz4_blocks, deflated_blocks])
def test_points_of_a_scannetpp_scan_lie_on_the_walls(tmp_path: Path, pack: Callable[[list[np.ndarray]], bytes]) -> None:
    scene = open_scene(write_scannetpp(tmp_path, pack))
    assert scene.format == "scannetpp" and scene.frames[1].name == "frame_000001"
    assert "1 frame without a pose is left out: frame_000006" in scene.warnings
    check_on_room(scene, colour_step=60)
    assert not scene.frames[0].depth()[3:40].any()
    np.testing.assert_allclose(scene.frames[0].depth(), depths_with_a_flat_top()[0], atol=6e-4)  # behind: starts again


def test_scannetpp_pictures_and_depth_may_be_extracted_already(tmp_path: Path) -> None:
    write_table(tmp_path)
    for i, view in enumerate(views()):
        write_colour(tmp_path / "rgb" / f"frame_{i:06d}.jpg", look(view, LENS).colour)
        write_grey(tmp_path / "depth" / f"frame_{i:06d}.png", in_steps(look(view, DEPTH).depth, 1000))
    scene = open_scene(tmp_path)
    assert scene.frames[0].file_shows_colour
    check_on_room(scene, colour_step=60)


@pytest.mark.parametrize("pack", [one_stream, lz4_blocks, deflated_blocks])
def test_cut_off_scannetpp_depth_is_a_one_line_error(tmp_path: Path, pack: Callable[[list[np.ndarray]], bytes]) -> None:
    path = write_scannetpp(tmp_path, pack) / "iphone" / "depth.bin"
    path.write_bytes(path.read_bytes()[:-2000])
    scene = open_scene(tmp_path)
    with raises_key("depth-damaged"):
        scene.frames[5].depth()
