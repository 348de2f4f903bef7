"""Labels, the legend and the highlight: where they stand, and that they are seen."""

import os
from types import SimpleNamespace

import bpy
import gpu
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mathutils import Matrix, Vector
from plgs.plgs_blender.inspecting import drawing, highlight
from plgs.plgs_blender.inspecting.selection import boxes_of

WIDTH, HEIGHT = 480, 300


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-50, 700), st.floats(-50, 500), st.floats(10, 200)), max_size=40),
    st.lists(st.tuples(st.floats(0, 600), st.floats(0, 400)), max_size=2),
)
def test_names_do_not_overlap(labels: list[tuple[float, float, float]], corners: list[tuple[float, float]]) -> None:
    anchors, widths = [(x, y) for x, y, _ in labels], [width for _, _, width in labels]
    free = [(x, y, x + 80.0, y + 60.0) for x, y in corners]
    placed = drawing.place_labels(anchors, widths, 18.0, (640.0, 480.0), free)
    assert set(placed) <= {i for i, (x, y) in enumerate(anchors) if 0 <= x <= 640 and 0 <= y <= 480}
    rectangles = {i: (x, y, x + widths[i], y + 18.0) for i, (x, y) in placed.items()}
    for one, (left, low, right, high) in rectangles.items():
        assert 0.0 <= left and 0.0 <= low and high <= 480.0
        others = [*free, *(each for other, each in rectangles.items() if other != one)]
        assert not any(left < x and x0 < right and low < y and y0 < high for x0, y0, x, y in others)
    assert sum(widths[i] * 18.0 for i in [*placed][1:]) <= 0.03 * 640 * 480, "the room stays visible"
    inside = [i for i, (x, y) in enumerate(anchors) if 0 <= x <= 640 and 0 <= y <= 480]
    assert free or not inside or inside[0] in placed, "the first has its name"


class Seen:
    """A view from a camera, as a RegionView3D has it."""

    is_perspective = True

    def __init__(self, camera: bpy.types.Object) -> None:
        graph = bpy.context.evaluated_depsgraph_get()
        self.view_matrix = camera.matrix_world.inverted()
        self.window_matrix = camera.calc_matrix_camera(graph, x=WIDTH, y=HEIGHT)

    @property
    def region(self) -> drawing.ViewRegion:
        return drawing.ViewRegion(WIDTH, HEIGHT, 0, self.window_matrix @ self.view_matrix, 1.0)


@pytest.fixture
def seen(root: bpy.types.Collection) -> Seen:
    return Seen(bpy.data.objects["Overview"])


def test_object_names_are_drawn_at_their_boxes(root: bpy.types.Collection, seen: Seen) -> None:
    text_boxes = drawing.label_text_boxes(root.plgs.instances, boxes_of(root), active=1, region=seen.region)
    assert {text_box.text for text_box in text_boxes} == {"chair 1", "cabinet 1"}
    for text_box in text_boxes:
        box = bpy.data.objects[f"{text_box.text} box"]
        at = seen.region.pixel_of(box.matrix_world.translation)
        assert at is not None and text_box.x < at[0] < text_box.x + text_box.width and text_box.y > at[1]
    chair, cabinet = sorted(text_boxes, key=lambda text_box: text_box.text, reverse=True)
    assert max(chair.ground) > max(cabinet.ground), "the selected one in its full colour"
    bpy.data.objects.remove(bpy.data.objects["chair 1 box"])
    text_boxes = drawing.label_text_boxes(root.plgs.instances, boxes_of(root), active=1, region=seen.region)
    assert [text_box.text for text_box in text_boxes] == ["cabinet 1"]


def test_the_name_of_a_selected_object_out_of_view_says_so(root: bpy.types.Collection, seen: Seen) -> None:
    boxes, region = boxes_of(root), seen.region
    at = region.pixel_of(bpy.data.objects["chair 1 box"].matrix_world.translation)
    free = [(at[0] - 80.0, 0.0, at[0] + 80.0, float(HEIGHT))]
    assert "chair 1" not in {
        each.text
        for each in drawing.label_text_boxes(
            root.plgs.instances, boxes, active=0, region=region, hovered=0, keep_free=free
        )
    }
    one_only = drawing.ViewRegion(WIDTH, 24, 0, region.perspective, 1.0)
    for number, name in ((1, "chair 1"), (2, "cabinet 1")):
        first = drawing.label_text_boxes(root.plgs.instances, boxes, active=0, region=one_only, hovered=number)[0]
        assert (first.text, first.instance) == (name, number)
    boxes[1].matrix_world = Matrix.Translation((0.0, 0.0, 500.0)) @ boxes[1].matrix_world
    bpy.context.view_layer.update()
    texts = {each.text for each in drawing.label_text_boxes(root.plgs.instances, boxes, active=1, region=region)}
    assert any(text.startswith("chair 1 is out of view") for text in texts)
    assert not any(
        "chair" in each.text for each in drawing.label_text_boxes(root.plgs.instances, boxes, active=0, region=region)
    )


def test_the_legend_lists_only_classes_that_are_shown(root: bpy.types.Collection, seen: Seen) -> None:
    rows = root.plgs.classes
    text_boxes = drawing.legend_text_boxes(drawing.shown_classes(rows), seen.region)
    assert {text_box.text for text_box in text_boxes} == {row.name for row in rows}
    order = [text_box.text for text_box in sorted(text_boxes, key=lambda text_box: -text_box.y)]
    points = {row.name: row.points for row in rows}
    assert [points[name] for name in order] == sorted(points.values(), reverse=True)
    rows[0].visible = False
    assert len(drawing.legend_text_boxes(drawing.shown_classes(rows), seen.region)) == len(rows) - 1
    low = drawing.ViewRegion(WIDTH, 70, 0, Matrix.Identity(4), 1.0)
    few = drawing.legend_text_boxes(drawing.shown_classes(rows), low)
    assert len(few) == 2 and few[-1].text.startswith("and ")


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
def test_the_overlay_draws_names_and_legend(root: bpy.types.Collection, seen: Seen) -> None:
    box, colour = boxes_of(root)[1], (0.9, 0.2, 0.1)
    points = highlight.highlight_of(root, 1, lambda cloud: True)

    def draw() -> None:
        in_pixels()
        drawing.draw_mark(highlight.mark_of(points, seen, (WIDTH, HEIGHT), drawing.brightened(colour)))
        drawing.draw_text_boxes(
            drawing.label_text_boxes(root.plgs.instances, boxes_of(root), active=1, region=seen.region)
        )
        drawing.draw_text_boxes(drawing.legend_text_boxes(drawing.shown_classes(root.plgs.classes), seen.region))
        drawing.draw_outline([(300, 20), (400, 20), (400, 90), (300, 90)], (0.2, 0.9, 0.3))

    drawn = picture(draw)[..., :3].astype(int)
    at = seen.region.pixel_of(box.matrix_world.translation)
    row, column = HEIGHT - int(at[1]), int(at[0])
    inside = drawn[row - 3 : row + 4, column - 3 : column + 4]
    assert (np.abs(inside - 128) < 40).all() and (inside[..., 0] > inside[..., 1]).all(), "tinted, not painted over"
    red = (drawn[..., 0] > 180) & (drawn[..., 1] < 130) & (drawn[..., 2] < 130)
    around = red[row - 60 : row + 60, column - 60 : column + 60]
    assert 40 < around.sum() < 0.2 * around.size, "an outline of its colour"
    assert around[:60].any() and around[60:].any() and around[:, :60].any() and around[:, 60:].any()
    green = (drawn[..., 1] > 200) & (drawn[..., 0] < 160) & (drawn[..., 2] < 180)
    assert green[205:285, 295:405].sum() > 400, "the rectangle of the mask"
    assert (drawn.min(axis=-1) > 230)[:HEIGHT].sum() > 100, "white letters"


@pytest.mark.skipif(bool(os.environ.get("PLGS_NO_EGL")), reason="this machine has no EGL")
def test_the_drawn_camera_path_breaks_at_jumps(root: bpy.types.Collection) -> None:
    def draw() -> None:
        in_pixels()
        drawing.draw_path([Vector((x, 50.0, 0.0)) for x in (20, 40, 60, 80, 300, 320)])

    drawn = picture(draw)[HEIGHT - 52 : HEIGHT - 48].astype(int)
    amber = ((drawn[..., 0] > 200) & (drawn[..., 2] < 140)).any(axis=0)
    assert amber[22:78].all() and amber[302:318].all() and not amber[90:290].any()


def test_the_highlight_of_a_mesh_follows_its_silhouette(extension: None) -> None:
    """Within two pixels of a ball's outline, without the circles of sparse points."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=6, radius=1.0)
    ball = bpy.context.active_object
    lens, size, away = 1.5, (800, 800), 5.0
    window = np.array([[lens, 0, 0, 0], [0, lens, 0, 0], [0, 0, -1.002, -0.2], [0, 0, -1, 0]])
    pose = np.eye(4)
    pose[2, 3] = -away
    view = SimpleNamespace(window_matrix=window, view_matrix=pose)
    found = highlight.highlight_of_mesh(bpy.context.scene.collection, ball)
    mark = highlight.mark_of(found, view, size, (1.0, 0.5, 0.0))
    true = lens * 400.0 / np.sqrt(away**2 - 1.0)
    left, low, right, high = mark.place
    rows, columns = np.nonzero(mark.pixels[..., 3] == np.float32(0.1))
    cell = (right - left) / mark.pixels.shape[1]
    x, y = left + (columns + 0.5) * cell - 400.0, low + (rows + 0.5) * cell - 400.0
    angle = np.arctan2(y, x)
    for start in np.linspace(-3.1, 3.0, 40):
        reach = np.hypot(x, y)[np.abs(angle - start) < 0.05].max()
        assert abs(reach - true) <= 2.0, start
    assert (right - left) - 2.0 * true < 14.0, "with the line and its margin"
