"""Hypersim's folders, as its README describes them. HDF5 is written by h5py, where it is installed."""

from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats.room import cast, check_on_room, views, write_colour

USUAL = np.array([[0.5773502886169104, 0.0, 0.0], [0.0, 0.4330127164626828, 0.0], [0.0, 0.0, -1.0]])
# ai_007_005's, whose lens is shifted: its picture's plane is tilted.
TILTED = np.array([[0.59255447, 0.0, 0.0], [0.0, 0.43310778, 0.0], [0.0, 0.09961479, -1.02633443]])
SHIFTED = np.array([[0.5, 0.0, 0.05], [0.0, 0.37, -0.03], [0.0, 0.0, -1.0]])
UNIT = 0.0254
WIDTH, HEIGHT = 128, 96


def write_hypersim(folder: Path, M: np.ndarray, table: bool = True, linear: bool = False) -> Path:
    """Two cameras; rays as the project's notebook casts them: u to the right, v up, from pixel centres."""
    h5py = pytest.importorskip("h5py")
    u = -1.0 + (2.0 * np.arange(WIDTH) + 1.0) / WIDTH
    v = 1.0 - (2.0 * np.arange(HEIGHT) + 1.0) / HEIGHT
    rays = np.stack([*np.meshgrid(u, v), np.ones((HEIGHT, WIDTH))], axis=-1) @ M.T
    (folder / "_detail").mkdir(parents=True)
    (folder / "_detail" / "metadata_scene.csv").write_text(
        f"parameter_name, parameter_value\nmeters_per_asset_unit, {UNIT}\n"
    )
    for camera, seen in (("cam_00", views()[:4]), ("cam_01", views()[4:])):
        detail, images = folder / "_detail" / camera, folder / "images"
        detail.mkdir()
        turns = [np.stack([view.right, view.up, -view.forward], axis=1) for view in seen]
        for name, values in (("orientations", turns), ("positions", [view.eye / UNIT for view in seen])):
            with h5py.File(detail / f"camera_keyframe_{name}.hdf5", "w") as file:
                file["dataset"] = np.array(values)
        geometry, final = images / f"scene_{camera}_geometry_hdf5", images / f"scene_{camera}_final_hdf5"
        geometry.mkdir(parents=True)
        final.mkdir()
        for i, view in enumerate(seen):
            x, y, z = np.moveaxis(rays, -1, 0)
            direction = (x / -z)[..., None] * view.right + (y / -z)[..., None] * view.up + view.forward
            picture = cast(view, direction)
            distance = picture.distance.astype(np.float16 if linear else np.float32)
            distance[:2] = np.nan
            with h5py.File(geometry / f"frame.{i:04d}.depth_meters.hdf5", "w") as file:
                file.create_dataset("dataset", data=distance, compression="gzip")
            if linear:
                with h5py.File(final / f"frame.{i:04d}.color.hdf5", "w") as file:
                    file.create_dataset("dataset", data=((picture.colour / 255.0) ** 2.2 * 7.0).astype(np.float16))
            else:
                preview = images / f"scene_{camera}_final_preview" / f"frame.{i:04d}.tonemap.jpg"
                write_colour(preview, picture.colour)
    if table:
        entries = {f"M_cam_from_uv_{i}{j}": str(M[i, j]) for i in range(3) for j in range(3)}
        head, row = ",".join(["scene_name", *entries]), ",".join([folder.name, *entries.values()])
        (folder.parent / "metadata_camera_parameters.csv").write_text(f"{head}\nother{',1' * 9}\n{row}\n")
    return folder


def test_a_tilted_hypersim_lens_is_corrected(tmp_path: Path) -> None:
    scene = open_scene(write_hypersim(tmp_path / "ai_007_005", TILTED))
    assert not scene.frames[0].file_shows_colour
    # Depth takes the nearest pixel, up to 0.7 pixels aside: 2 cm at a slant.
    check_on_room(scene, tolerance=0.025, share=0.97, colour_step=60, colour_share=0.92)  # it is black at the corners


def test_without_its_camera_table_hypersim_uses_the_default_lens(tmp_path: Path) -> None:
    scene = open_scene(write_hypersim(tmp_path / "ai_001_001", USUAL, table=False, linear=True))
    assert any("metadata_camera_parameters.csv is missing" in warning for warning in scene.warnings)
    check_on_room(scene, tolerance=0.005, colour_step=255)
    one = scene.frames[0].read_colour(None).astype(int)
    assert 190 < np.percentile(one @ [0.3, 0.59, 0.11], 90) < 215 and not scene.frames[0].file_shows_colour
