"""A click picks what is seen, however the lift is shown."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector
from plgs.engine.passes.ply import columns_of, write_ply_table
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.inspecting import picking, rays
from plgs.plgs_blender.inspecting.drawing import TextBox, ViewRegion, label_text_boxes
from plgs.plgs_blender.inspecting.selection import boxes_of
from plgs.plgs_blender.meshes import mesh_folder
from surface_file import write_surface
from tiny_lift import mend_manifest, write_tiny_lift
from tiny_scene import CABINET_ID, CHAIR_ID, FLOOR_ID, tiny_intrinsics, trace_view, write_tiny_scene

SIZE = (480, 300)


def view_from(camera: bpy.types.Object, size: tuple[int, int]) -> rays.View:
    """What a camera sees, with the walls left out from where it stands."""
    lens = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=size[0], y=size[1])
    eye = tuple(camera.matrix_world.translation)
    return rays.View(rays.rows_of(camera.matrix_world.inverted()), rays.rows_of(lens), *size, eye)


class Seen:
    """A view from a place to another, as a RegionView3D has it."""

    def __init__(self, eye: Vector, target: Vector, is_perspective: bool = True) -> None:
        data = bpy.data.cameras.new("eye")
        data.type, data.ortho_scale, data.clip_start = ("PERSP" if is_perspective else "ORTHO"), 4.0, 0.01
        camera = bpy.data.objects.new("eye", data)
        bpy.context.scene.collection.objects.link(camera)
        turned = (target - eye).to_track_quat("-Z", "Y").to_matrix().to_4x4()
        camera.matrix_world = Matrix.Translation(eye) @ turned
        bpy.context.view_layer.update()
        self.view = view_from(camera, SIZE)
        bpy.data.objects.remove(camera)

    @property
    def region(self) -> ViewRegion:
        return ViewRegion(*SIZE, 0, Matrix(self.view.lens) @ Matrix(self.view.looks), 1.0)

    def pixel(self, point: Vector) -> tuple[float, float]:
        at = self.region.pixel_of(point)
        assert at is not None
        return at


def middle(root: bpy.types.Collection, number: int) -> Vector:
    return boxes_of(root)[number].matrix_world.translation


@pytest.mark.parametrize("is_perspective", [True, False])
def test_a_click_on_the_middle_of_an_object_selects_it(root: bpy.types.Collection, is_perspective: bool) -> None:
    for number, class_id in ((1, CHAIR_ID), (2, CABINET_ID)):
        seen = Seen(middle(root, number) + Vector((0.4, 0.3, 2.0)), middle(root, number), is_perspective)
        found = picking.drawn_under([root], seen.view, seen.pixel(middle(root, number)))
        assert found is not None and (found.instance, found.class_id) == (number, class_id)
        root.plgs.isolated = 3 - number
        other = picking.drawn_under([root], seen.view, seen.pixel(middle(root, number)))
        assert other is None or other.instance != number, "what is hidden is not picked"
        root.plgs.isolated = 0


@pytest.mark.parametrize("is_perspective", [True, False])
def test_a_click_hits_the_surface_of_a_mesh(
    extension: None, empty_file: None, lift: Path, tmp_path: Path, is_perspective: bool
) -> None:
    """Against the plane of the floor and of the square above it, seen from afar; from below, backs are open."""
    mine = Path(shutil.copytree(lift, tmp_path / "mine"))
    write_surface(mesh_folder(mine) / "mesh.ply")
    root = lift_scene.place_lift(mine, bpy.context.scene)
    bpy.context.view_layer.update()
    assert root.plgs.show_as == "SURFACE"
    target = Vector((2.0, 1.5, 0.0))
    seen = Seen(target + Vector((9.0, 4.0, 14.0)), target, is_perspective)
    picked, wanted = [], []
    inverse = (Matrix(seen.view.lens) @ Matrix(seen.view.looks)).inverted()
    for row in range(4, SIZE[1], 9):
        for column in range(4, SIZE[0], 9):
            at = (2.0 * (column + 0.5) / SIZE[0] - 1.0, 2.0 * (row + 0.5) / SIZE[1] - 1.0)
            near, far = (end.xyz / end.w for end in (inverse @ Vector((*at, z, 1.0)) for z in (-1.0, 1.0)))
            hits = [near.lerp(far, (height - near.z) / (far.z - near.z)) for height in (0.5, 0.0)]
            is_on = [1.0 < hits[0].x < 2.0 and 1.0 < hits[0].y < 2.0, 0.0 < hits[1].x < 4.0 and 0.0 < hits[1].y < 3.0]
            found = picking.drawn_under([root], seen.view, (column + 0.5, row + 0.5))
            picked.append(None if found is None else found.instance)
            wanted.append(1 if is_on[0] else 0 if is_on[1] else None)
    assert {0, 1, None} == {*wanted} and picked == wanted
    start, end, middle_of = (Vector(seen.pixel(Vector((x, y, 0.5)))) for x, y in ((2.0, 1.0), (2.0, 2.0), (1.5, 1.5)))
    aside = (end - start).orthogonal().normalized()
    aside *= 1.0 if aside.dot(start - middle_of) > 0.0 else -1.0
    root.plgs.classes[[row.class_id for row in root.plgs.classes].index(FLOOR_ID)].visible = False
    for away in (-3.0, 1.0, 6.5, 9.5):
        found = picking.drawn_under([root], seen.view, tuple((start + end) / 2.0 + away * aside))
        assert (found is not None) == (away < rays.MISS)
    below = Seen(target - Vector((0.1, 0.2, 9.0)), target, is_perspective)
    assert picking.drawn_under([root], below.view, below.pixel(target)) is None


@pytest.mark.parametrize("is_perspective", [True, False])
def test_a_click_selects_the_object_of_the_nearest_splat(
    extension: None, empty_file: None, lift: Path, tmp_path: Path, is_perspective: bool
) -> None:
    """Squares, or Blender's own splats: a faint one of the cabinet is seen through, down to the chair's."""
    mine = Path(shutil.copytree(lift, tmp_path / "mine"))
    instance = np.array([CHAIR_ID, CABINET_ID], np.int32) == CHAIR_ID
    write_ply_table(
        mine / "result" / "gaussians.ply",
        {
            **columns_of("x y z", np.array([[2.0, 1.5, 1.0], [2.0, 1.5, 1.2]], np.float32)),
            **columns_of("f_dc_0 f_dc_1 f_dc_2", np.zeros((2, 3), np.float32)),
            "opacity": np.array([4.0, -2.15], np.float32),  # 0.98, and just above the faintest
            **columns_of("scale_0 scale_1 scale_2", np.log(np.array([[0.3, 0.15, 0.01]] * 2, np.float32))),
            **columns_of("rot_0 rot_1 rot_2 rot_3", np.array([[1.0, 0.0, 0.0, 0.0]] * 2, np.float32)),
            "class_id": np.where(instance, CHAIR_ID, CABINET_ID).astype(np.int32),
            "instance_id": np.where(instance, 1, 2).astype(np.int32),
        },
    )
    mend_manifest(mine)
    root = lift_scene.place_lift(mine, bpy.context.scene)
    bpy.context.view_layer.update()
    assert root.plgs.show_as == "SPLATS"
    target = Vector((2.0, 1.5, 1.0))
    seen = Seen(target + Vector((0.0, -0.01, 5.0)), target, is_perspective)
    for aside, number in (((0.0, 0.0), 1), ((0.25, 0.0), 1), ((0.0, 0.5), None), ((1.5, 0.0), None)):
        found = picking.drawn_under([root], seen.view, seen.pixel(target + Vector((*aside, 0.0))))
        assert (None if found is None else found.instance) == number, aside


def test_clicks_on_a_frame_find_what_its_pixels_show(root: bpy.types.Collection) -> None:
    """Against the room's own ray tracer, away from edges. The points have gaps, where no view came near."""
    size, agree, total = (320, 240), 0, 0
    for name in ("0001", "0004", "0007"):
        camera = bpy.data.objects[name]
        turn = np.diag([1.0, -1.0, -1.0, 1.0])
        truth = trace_view(np.array(camera.matrix_world) @ turn, tiny_intrinsics(size), size).instance
        view = view_from(camera, size)
        for row in range(12, size[1] - 12, 8):
            for column in range(12, size[0] - 12, 8):
                if len(np.unique(truth[row - 8 : row + 9, column - 8 : column + 9])) == 1:
                    found = picking.drawn_under([root], view, (column + 0.5, size[1] - row - 0.5))
                    total, agree = total + 1, agree + (found is not None and found.instance == truth[row, column])
    assert total > 1000 and agree > 0.97 * total, f"{agree} of {total}"


def test_a_click_on_an_objects_name_selects_the_object(root: bpy.types.Collection) -> None:
    seen = Seen(middle(root, 1) + Vector((1.5, 1.5, 3.0)), middle(root, 1))
    region = seen.region
    names = label_text_boxes(root.plgs.instances, boxes_of(root), active=0, region=region)
    assert {each.instance for each in names} == {1, 2}
    for each in names:
        assert picking.name_under(names, (each.x + each.width / 2.0, each.y + each.height / 2.0)) == each.instance
    assert picking.name_under(names, (-1.0, -1.0)) == 0


def drawn_from(root: bpy.types.Collection, aside: Vector) -> tuple[SimpleNamespace, ViewRegion]:
    """The context of a view that looks at the first object from beside it, and the view's region."""
    seen = Seen(middle(root, 1) + aside, middle(root, 1))
    region = SimpleNamespace(view_perspective="")
    view = SimpleNamespace(overlay=SimpleNamespace(show_overlays=True), region_3d=region, local_view=None)
    area = SimpleNamespace(as_pointer=lambda: 1)
    context = SimpleNamespace(space_data=view, region=area, view_layer=bpy.context.view_layer)
    return context, seen.region


def test_hovering_highlights_the_name_of_one_lift_only(root: bpy.types.Collection, lift: Path, tmp_path: Path) -> None:
    """Objects of two lifts in one file have the same numbers."""
    scene = write_tiny_scene(tmp_path / "other room", frames=4, size=(64, 48))
    other = lift_scene.place_lift(write_tiny_lift(tmp_path / "lift", scene, bake=False).path, bpy.context.scene)
    context, region = drawn_from(root, Vector((1.5, 1.5, 3.0)))
    root.plgs.show_boxes = other.plgs.show_boxes = False
    for under, beside in ((root, other), (other, root)):
        picking.hovered[:] = [(under.session_uid, 1)]
        lit, dull = (opacities(picking.names_to_draw(context, each, region)) for each in (under, beside))
        assert lit[1] > lit[2] == dull[1] == dull[2]
    picking.forget()


def opacities(drawn: list[TextBox]) -> dict[int, float]:
    return {each.instance: each.opacity for each in drawn}
