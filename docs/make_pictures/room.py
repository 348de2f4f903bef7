"""Render a picture of a lift in a .blend file: the room from above, or a frame, with coloured points, boxes and labels.

    python -m docs.make_pictures.room LIFT.blend OUT.png [--view FRAME] [--colours class|photo] [--size 1280x800]

Rendered with Cycles on the processor: it shades points like the surfaces they lie on. Needs no window and no GPU. The
file is not changed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
from plgs.plgs_blender.compat import use_nodes
from plgs.plgs_blender.inspecting.lookup import is_box
from plgs.plgs_blender.inspecting.text_boxes import place_labels, top_of
from plgs.plgs_blender.materials import CLASS_COLOURS, RELIEF, value_node
from plgs.plgs_blender.module_exit import end_process
from plgs.plgs_blender.viewport import set_ground

_LABEL_HEIGHT = 0.021
"""Height of a label's text box in picture heights."""
_LETTER_WIDTH = 0.5
"""Mean width of a letter in text box heights."""
_BAR = 0.018
"""Thickness of a box's bars, metres."""
_NEARNESS = 0.3
"""Labels stand at this share of the way from the camera to their box, so that nothing stands before them."""


def render_picture(
    blend: Path,
    out: Path,
    view: str = "Overview",
    size: tuple[int, int] = (1280, 800),
    colours: str = "class",
    labels: bool = True,
) -> None:
    """Render the view (a marker's name) of the lift in `blend` to the PNG file `out` of `size` (width, height) in
    pixels.

    `colours` is "class", or "photo" for the points' own. ValueError when the file has no such view.
    """
    bpy.ops.wm.open_mainfile(filepath=str(blend.absolute()))
    scene, camera = _find_view(view)
    _set_up(scene, size)
    _colour_points(scene, colours)
    scene.camera = camera
    scene.view_layers[0].update()
    boxes = [ob for ob in scene.objects if is_box(ob) and not ob.hide_get(view_layer=scene.view_layers[0])]
    _draw(boxes)
    if labels:
        _label(scene, camera, boxes)
    scene.render.filepath = str(out.absolute())
    with bpy.context.temp_override(scene=scene):
        bpy.ops.render.render(write_still=True)
    if not out.exists():
        raise RuntimeError(f"Blender rendered nothing to {out}")


def _find_view(view: str) -> tuple[bpy.types.Scene, bpy.types.Object]:
    for scene in bpy.data.scenes:
        for marker in scene.timeline_markers:
            if marker.camera is not None and marker.name == view:
                return scene, marker.camera
    raise ValueError(f"the file has no view {view!r} of a lift")


def _set_up(scene: bpy.types.Scene, size: tuple[int, int]) -> None:
    """Cycles with just enough rays for smooth edges: nothing here casts light."""
    render = scene.render
    render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 16, False
    scene.cycles.use_adaptive_sampling, scene.cycles.max_bounces = False, 0
    render.use_compositing = render.use_sequencer = False
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
    render.film_transparent = False
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("Ground")
    set_ground(scene.world)
    # In a still, a marker's camera would win over ours.
    scene.timeline_markers.clear()


def _colour_points(scene: bpy.types.Scene, colours: str) -> None:
    """Set what the points' material shows: class colours with relief, or photo colours as they are."""
    value = 1.0 if colours == "class" else 0.0
    materials = {slot.material for ob in scene.objects for slot in ob.material_slots if slot.material}
    for material in materials:
        for label in (CLASS_COLOURS, RELIEF):
            node = value_node(material, label)
            if node is not None:
                node.outputs[0].default_value = value


def _draw(boxes: Sequence[bpy.types.Object]) -> None:
    """Draw boxes as bars in their colours. Renders show none of themselves."""
    material = bpy.data.materials.new("flat")
    tree = use_nodes(material)
    tree.nodes.clear()
    kinds = ("ShaderNodeObjectInfo", "ShaderNodeEmission", "ShaderNodeOutputMaterial")
    own, light, end = (tree.nodes.new(kind) for kind in kinds)
    tree.links.new(own.outputs["Color"], light.inputs["Color"])
    tree.links.new(light.outputs[0], end.inputs["Surface"])
    for ob in boxes:
        ob.data.materials[0], ob.hide_render = material, False
        bars = ob.modifiers.new("Bars", "WIREFRAME")
        bars.thickness, bars.offset = _BAR, 1.0  # outside the box, where its points do not cover them


def _label(scene: bpy.types.Scene, camera: bpy.types.Object, boxes: Sequence[bpy.types.Object]) -> None:
    """Put a text box in its instance's colour, with its name, above each box. Of those that
    would overlap the nearest stays."""
    aspect = scene.render.resolution_x / scene.render.resolution_y
    seen = [(world_to_camera_view(scene, camera, top_of(ob)), ob) for ob in boxes]
    seen = [(at, ob) for at, ob in seen if at.z > 0.0 and 0.0 < at.x < 1.0 and 0.0 < at.y < 1.0]
    seen.sort(key=lambda each: each[0].z)
    anchors = [(at.x * aspect, at.y + 0.008) for at, _ in seen]
    widths = [(len(ob.name) + 1.2) * _LETTER_WIDTH * _LABEL_HEIGHT for _, ob in seen]
    for index, (left, low) in place_labels(anchors, widths, 1.1 * _LABEL_HEIGHT, (aspect, 1.0)).items():
        at, ob = seen[index]
        _add_label(scene, camera, ob, ((left + widths[index] / 2.0) / aspect, low), at.z * _NEARNESS)


def _add_label(
    scene: bpy.types.Scene, camera: bpy.types.Object, ob: bpy.types.Object, at: tuple[float, float], depth: float
) -> None:
    """Add a text box that faces the camera at the place `at` of its picture (0..1 from the lower left)."""
    frame = [corner * (depth / -corner.z) for corner in camera.data.view_frame(scene=scene)]
    left, right = min(c.x for c in frame), max(c.x for c in frame)
    low, high = min(c.y for c in frame), max(c.y for c in frame)
    place = Vector((left + (right - left) * at[0], low + (high - low) * at[1], -depth))
    unit = _LABEL_HEIGHT * (high - low)

    curve = bpy.data.curves.new("label", "FONT")
    curve.body, curve.align_x, curve.align_y, curve.size = ob.name, "CENTER", "CENTER", 0.78
    half = (len(ob.name) + 1.2) * _LETTER_WIDTH / 2.0
    mesh = bpy.data.meshes.new("text box")
    mesh.from_pydata([(-half, -0.5, 0), (half, -0.5, 0), (half, 0.5, 0), (-half, 0.5, 0)], [], [(0, 1, 2, 3)])
    material = ob.material_slots[0].material
    dark = tuple(0.35 * channel for channel in ob.color[:3])
    for data, colour, nearer in ((mesh, (*dark, 1.0), 0.0), (curve, (1.0, 1.0, 1.0, 1.0), 0.02)):
        part = bpy.data.objects.new("label", data)
        part.color = colour
        data.materials.append(material)
        part.matrix_world = camera.matrix_world.normalized() @ Matrix.LocRotScale(
            place * (1.0 - nearer), None, Vector((unit, unit, unit)) * (1.0 - nearer)
        )
        scene.collection.objects.link(part)


def main(arguments: Sequence[str]) -> int:
    """The command line of this module; its exit code."""
    command = "python -m docs.make_pictures.room"
    parser = argparse.ArgumentParser(prog=command, description="Render a picture of a lift.")
    parser.add_argument("blend", type=Path, help="the .blend file that holds the lift")
    parser.add_argument("out", type=Path, help="the PNG file to write")
    parser.add_argument("--view", default="Overview", help="a frame's name; the whole room when left out")
    parser.add_argument("--size", default="1280x800", help="WIDTHxHEIGHT in pixels (1280x800)")
    parser.add_argument("--colours", choices=("class", "photo"), default="class", help="what the points show (class)")
    parser.add_argument("--no-labels", action="store_true", help="leave out the instances' names")
    options = parser.parse_args(arguments)
    width, _, height = options.size.partition("x")
    if not (width.isdigit() and height.isdigit()):
        parser.error(f"--size is WIDTHxHEIGHT, not {options.size!r}")
    if not options.blend.is_file():
        parser.error(f"{options.blend} does not exist")
    try:
        size = int(width), int(height)
        render_picture(options.blend, options.out, options.view, size, options.colours, not options.no_labels)
    except ValueError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    end_process(main(sys.argv[1:]))
