"""Labels, the legend and the highlight: where they stand, and that they are seen."""

from __future__ import annotations

import os

import bpy
import gpu
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mathutils import Matrix, Vector
from plgs.plgs_blender.inspecting import highlight
from plgs.plgs_blender.inspecting.drawing import draw_highlight, draw_outline, draw_path, draw_text_boxes
from plgs.plgs_blender.inspecting.lookup import boxes_of
from plgs.plgs_blender.inspecting.text_boxes import (
    ViewRegion,
    label_text_boxes,
    legend_text_boxes,
    shown_classes,
    stack_labels,
)

WIDTH, HEIGHT = 480, 300


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(-50, 700), st.floats(-50, 500), st.floats(10, 200)), max_size=25))
def test_labels_do_not_cover_each_other(labels: list[tuple[float, float, float]]) -> None:
    anchors, widths = [(x, y) for x, y, _ in labels], [width for _, _, width in labels]
    placed = stack_labels(anchors, widths, 18.0, (640.0, 480.0))
    inside = {i for i, (x, y) in enumerate(anchors) if 0 <= x <= 640 and 0 <= y <= 480}
    assert set(placed) <= inside
    for one in inside - set(placed):  # it would have to move farther than four heights: at least three are in its way
        assert sum(-18.0 < low - anchors[one][1] < 90.0 for _, low in placed.values()) >= 3
    for one, (x, y) in placed.items():
        assert 0.0 <= x and y >= anchors[one][1]
        for other, (left, low) in placed.items():
            apart = x >= left + widths[other] or left >= x + widths[one] or abs(y - low) >= 18.0
            assert one == other or apart


class Seen:
    """A view from a camera, as a RegionView3D has it."""

    is_perspective = True

    def __init__(self, camera: bpy.types.Object) -> None:
        graph = bpy.context.evaluated_depsgraph_get()
        self.view_matrix = camera.matrix_world.inverted()
        self.window_matrix = camera.calc_matrix_camera(graph, x=WIDTH, y=HEIGHT)

    @property
    def region(self) -> ViewRegion:
        return ViewRegion(WIDTH, HEIGHT, 0, self.window_matrix @ self.view_matrix, 1.0)


@pytest.fixture
def seen(root: bpy.types.Collection) -> Seen:
    return Seen(bpy.data.objects["Overview"])


def test_labels_stand_at_their_boxes(root: bpy.types.Collection, seen: Seen) -> None:
    text_boxes = label_text_boxes(root.plgs.instances, boxes_of(root), 1, seen.region)
    assert {text_box.text for text_box in text_boxes} == {"chair 1", "cabinet 1"}
    for text_box in text_boxes:
        box = bpy.data.objects[text_box.text]
        at = seen.region.pixel_of(box.matrix_world.translation)
        assert at is not None and text_box.x < at[0] < text_box.x + text_box.width and text_box.y > at[1]
    chair, cabinet = sorted(text_boxes, key=lambda text_box: text_box.text, reverse=True)
    assert max(chair.ground) > max(cabinet.ground), "the selected one in its full colour"
    bpy.data.objects.remove(bpy.data.objects["chair 1"])
    text_boxes = label_text_boxes(root.plgs.instances, boxes_of(root), 1, seen.region)
    assert [text_box.text for text_box in text_boxes] == ["cabinet 1"]


def test_the_legend_has_the_classes_that_are_shown(root: bpy.types.Collection, seen: Seen) -> None:
    rows = root.plgs.classes
    text_boxes = legend_text_boxes(shown_classes(rows), seen.region)
    assert {text_box.text for text_box in text_boxes} == {row.name for row in rows}
    order = [text_box.text for text_box in sorted(text_boxes, key=lambda text_box: -text_box.y)]
    points = {row.name: row.points for row in rows}
    assert [points[name] for name in order] == sorted(points.values(), reverse=True)
    rows[0].visible = False
    assert len(legend_text_boxes(shown_classes(rows), seen.region)) == len(rows) - 1
    low = ViewRegion(WIDTH, 70, 0, Matrix.Identity(4), 1.0)
    few = legend_text_boxes(shown_classes(rows), low)
    assert len(few) == 2 and few[-1].text.startswith("and ")


def test_points_behind_the_eye_are_nowhere(seen: Seen) -> None:
    camera = bpy.data.objects["Overview"]
    assert seen.region.pixel_of(camera.matrix_world @ Vector((0.0, 0.0, 3.0))) is None


def picture(draw: object) -> np.ndarray:
    """What a function draws over grey, uint8 [H, W, 4], row 0 at the top."""
    if hasattr(gpu, "init"):
        gpu.init()
    else:  # before 5.2 a render makes the context
        scene = bpy.data.scenes.new("gpu")
        scene.render.engine = "BLENDER_WORKBENCH"
        scene.render.resolution_x = scene.render.resolution_y = 4
        scene.camera = bpy.data.objects["Overview"]
        bpy.ops.render.render(scene=scene.name)
        bpy.data.scenes.remove(scene)
    screen = gpu.types.GPUOffScreen(WIDTH, HEIGHT)
    with screen.bind():
        buffer = gpu.state.active_framebuffer_get()
        buffer.clear(color=(0.5, 0.5, 0.5, 1.0), depth=1.0)
        draw()  # type: ignore[operator]
        pixels = buffer.read_color(0, 0, WIDTH, HEIGHT, 4, 0, "UBYTE")
        pixels.dimensions = WIDTH * HEIGHT * 4
        result = np.array(pixels, np.uint8).reshape(HEIGHT, WIDTH, 4)[::-1]
    screen.free()
    return result


def in_pixels() -> None:
    to_clip = Matrix.Diagonal((2.0 / WIDTH, 2.0 / HEIGHT, 1.0, 1.0))
    gpu.matrix.load_matrix(Matrix.Translation((-1.0, -1.0, 0.0)) @ to_clip)
    gpu.matrix.load_projection_matrix(Matrix.Identity(4))


@pytest.mark.skipif(bool(os.environ.get("PLGS_NO_EGL")), reason="this machine has no EGL")
def test_what_is_drawn_is_seen(root: bpy.types.Collection, seen: Seen) -> None:
    box, colour = boxes_of(root)[1], (0.9, 0.2, 0.1)
    points = highlight.highlight_of(root, 1, lambda cloud: True)

    def draw() -> None:
        gpu.matrix.load_projection_matrix(seen.window_matrix)
        draw_highlight(seen, (WIDTH, HEIGHT), points, box, colour, dim=True)  # type: ignore[arg-type]
        in_pixels()
        draw_text_boxes(label_text_boxes(root.plgs.instances, boxes_of(root), 1, seen.region))
        draw_text_boxes(legend_text_boxes(shown_classes(root.plgs.classes), seen.region))
        draw_outline([(300, 20), (400, 20), (400, 90), (300, 90)], (0.2, 0.9, 0.3))

    drawn = picture(draw)[..., :3].astype(int)
    if "PLGS_PICTURES" in os.environ:
        save(drawn, os.path.join(os.environ["PLGS_PICTURES"], f"overlay_{bpy.app.version[0]}.png"))
    assert (drawn[2, 2] < 90).all(), "the rest is darker than the ground of 128"
    at = seen.region.pixel_of(box.matrix_world.translation)
    assert at is not None
    around = drawn[HEIGHT - int(at[1]) - 12 : HEIGHT - int(at[1]) + 12, int(at[0]) - 12 : int(at[0]) + 12]
    assert ((around[..., 0] > 130) & (around[..., 1] < 160)).mean() > 0.5, "the chair's points are highlighted"
    green = (drawn[..., 1] > 200) & (drawn[..., 0] < 160) & (drawn[..., 2] < 180)
    assert green[205:285, 295:405].sum() > 400, "the rectangle of the mask"
    assert (drawn.min(axis=-1) > 230)[:HEIGHT].sum() > 100, "white letters"


@pytest.mark.skipif(bool(os.environ.get("PLGS_NO_EGL")), reason="this machine has no EGL")
def test_a_path_is_a_line_that_breaks_at_jumps(root: bpy.types.Collection) -> None:
    def draw() -> None:
        in_pixels()
        draw_path([Vector((x, 50.0, 0.0)) for x in (20, 40, 60, 80, 300, 320)])

    drawn = picture(draw)[HEIGHT - 52 : HEIGHT - 48].astype(int)
    amber = ((drawn[..., 0] > 200) & (drawn[..., 2] < 140)).any(axis=0)
    assert amber[22:78].all() and amber[302:318].all() and not amber[90:290].any()


def save(pixels: np.ndarray, path: str) -> None:
    image = bpy.data.images.new("picture", WIDTH, HEIGHT)
    rgba = np.ones((HEIGHT, WIDTH, 4), np.float32)
    rgba[..., :3] = pixels[::-1] / 255.0
    image.pixels.foreach_set(rgba.ravel())
    image.filepath_raw, image.file_format = path, "PNG"
    image.save()
