"""The Gaussians as squares, and what colours they have."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from plgs.engine.errors import PlgsError
from plgs.engine.passes.ply import columns_of, write_ply_table
from plgs.engine.posed.splat_file import read_gaussians
from plgs.plgs_blender import lift_scene, splats
from plgs.plgs_blender.inspecting.lists import registered
from tiny_lift import mend_manifest, write_tiny_lift
from tiny_scene import CHAIR_ID


def write_gaussians(path: Path) -> None:
    """A flat red one in the plane z = 1, one on edge, and one that can hardly be seen."""
    n = 3
    red = np.full((n, 3), -1.0, np.float32) * [-1.7724539, 1.7724539, 1.7724539]
    turn = np.zeros((n, 4), np.float32)
    turn[:, 0], turn[1] = 1.0, (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)
    columns = {
        **columns_of("x y z", np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1]], np.float32)),
        **columns_of("f_dc_0 f_dc_1 f_dc_2", red.astype(np.float32)),
        "opacity": np.array([2.0, 2.0, -6.0], np.float32),
        **columns_of("scale_0 scale_1 scale_2", np.log(np.array([[0.1, 0.2, 0.01]] * n, np.float32))),
        **columns_of("rot_0 rot_1 rot_2 rot_3", turn),
        "class_id": np.full(n, CHAIR_ID, np.int32),
        "instance_id": np.array([1, 0, 0], np.int32),
    }
    write_ply_table(path, columns)


def test_squares_span_the_two_longest_axes_and_face_the_cameras_that_saw_them(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "gaussians.ply")
    rows = read_gaussians(tmp_path / "gaussians.ply")
    for above in (5.0, -5.0):
        assert splats.seen(rows).tolist() == [0, 1]
        corners = splats.squares(rows, np.array([[0.0, 0.0, above]]))
        assert np.ptp(corners[0], axis=0) == pytest.approx([0.4, 0.8, 0.0], abs=1e-6)
        assert np.ptp(corners[1], axis=0) == pytest.approx([0.4, 0.0, 0.8], abs=1e-6)
        normal = np.cross(corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 1])
        assert np.sign(normal[2]) == np.sign(above)


def test_what_cameras_see_from_both_sides_has_two_squares(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "gaussians.ply")
    rows = read_gaussians(tmp_path / "gaussians.ply")[:1]
    down, up = [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]

    def seen(*cameras: tuple[float, list[float]]) -> list[int]:
        places = np.array([[0.0, 0.0, height] for height, _ in cameras])
        ahead = np.array([ahead for _, ahead in cameras])
        eyes = splats.Eyes(places, ahead, np.full(len(cameras), 0.9))
        columns = splats._columns(rows, eyes)
        both = splats.seen_from_behind(splats.squares(rows, eyes.places), eyes)
        assert len(columns["opacity"]) == 4 + 4 * len(both) and len(columns["position"]) == 12 * (1 + len(both))
        return list(both)

    assert seen((2.0, down)) == seen((2.0, down), (-9.0, down)) == []
    assert seen((2.0, down), (-9.0, up)) == [0]


def test_splats_have_the_colour_around_them_if_the_file_has_it(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "gaussians.ply")
    rows = read_gaussians(tmp_path / "gaussians.ply")
    told = np.zeros(len(rows), rows.dtype.descr + [(name, "u1") for name in ("red", "green", "blue")])
    for name in rows.dtype.names:
        told[name] = rows[name]
    told["green"] = 255
    nowhere = splats.Eyes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert splats._columns(rows, nowhere)["Col"].reshape(-1, 4)[0] == pytest.approx([1, 0, 0, 1], abs=1e-3)
    assert splats._columns(told, nowhere)["Col"].reshape(-1, 4)[0].tolist() == [0, 1, 0, 1]


def test_a_file_without_splats_is_refused(tmp_path: Path) -> None:
    write_ply_table(tmp_path / "points.ply", columns_of("x y z", np.zeros((2, 3), np.float32)))
    with pytest.raises(PlgsError, match="holds no splats"):
        read_gaussians(tmp_path / "points.ply")


@pytest.mark.skipif(splats.has_native_splats(), reason="this Blender has splats of its own")
def test_a_lift_opens_as_splats_in_photo_colours_and_is_recoloured(tmp_path: Path) -> None:
    lift = write_tiny_lift(tmp_path / "lift", frames=4, bake=False).path
    write_gaussians(lift / "result" / "gaussians.ply")
    mend_manifest(lift)
    root = lift_scene.place_lift(lift, bpy.context.scene)
    mesh = bpy.data.objects["Gaussians"].data
    shown = {each.name: not each.hide_viewport for each in root.children}
    assert shown["Gaussians"] and not shown["Semantic points"]

    def colours() -> np.ndarray:
        values = np.zeros(4 * len(mesh.vertices), np.float32)
        mesh.attributes["Col"].data.foreach_get("color", values)
        return values.reshape(-1, 4)

    photo = colours()
    assert photo == pytest.approx(np.tile([1.0, 0.0, 0.0, 1.0], (8, 1)), abs=1e-3)
    with registered():
        root.plgs.look = "INSTANCES"
        own = bpy.data.objects[next(ob.name for ob in root.all_objects if ob.get("plgs_key") == "instance:1")].color
        assert colours()[0] == pytest.approx([*own], abs=1e-5) and np.ptp(colours()[4, :3]) < 1e-6
        root.plgs.look = "CLASSES"
        assert colours()[4] == pytest.approx([*bpy.data.objects["chair"].color], abs=1e-5)
        classes = colours()
        root.plgs.look = "UNCERTAINTY"
        assert not np.allclose(colours(), photo) and not np.allclose(colours(), classes)
        root.plgs.look = "PHOTO"
        assert np.array_equal(colours(), photo)
        lift_scene.show_lift_as(root, bpy.context.scene, "POINTS")
        assert bpy.data.objects["Gaussians"].users_collection[0].hide_render
        with pytest.raises(PlgsError, match="no meshes yet"):
            lift_scene.show_lift_as(root, bpy.context.scene, "SURFACE")
    lift_scene.place_lift(lift, bpy.context.scene)
    assert [ob.name for ob in bpy.data.objects if ob.name.startswith("Gaussians")] == ["Gaussians"]
