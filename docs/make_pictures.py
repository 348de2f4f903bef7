"""Make the pictures of docs/passes.md of a finished lift of the sample:

    python docs/make_pictures.py camera LIFT          writes LIFT/shot.blend, with a moving camera "dolly" to bake
    python docs/make_pictures.py PICTURE... LIFT      mask, layers, shot, matte, group, meshes, catcher; or all

All that is seen was made by the project's own commands, which that page tells; here it is lit, cut and labelled. Needs
no window and no GPU. The lift is only read.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import bpy
import cv2
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from run_plgs import load_package  # noqa: E402

load_package()
from plgs.engine.passes.contact_sheet import BACKGROUND, TEXT  # noqa: E402
from plgs.engine.passes.exr import read_exr  # noqa: E402
from plgs.engine.passes.previews import colour_picture, instance_picture, semantic_picture, shaded  # noqa: E402
from plgs.engine.scene import distinct_colour  # noqa: E402
from plgs.plgs_blender import compat  # noqa: E402
from plgs.plgs_blender.meshes import place_meshes_anew  # noqa: E402
from plgs.plgs_blender.pass_nodes import CLASSES, INSTANCES, node_of, output_of, panoptic_node  # noqa: E402
from plgs.plgs_blender.results import LiftResult, read_result  # noqa: E402

Picture = NDArray[np.uint8]
"""uint8 [H, W, 3], RGB."""
PICTURES = ROOT / "docs" / "pictures"
JPEG_QUALITY = 82
GAP, BAR = 6, 30
MASK_FRAME = "0016"
"""Held out, and its mask has what lifting mends: holes, a vase that is a bin, pieces of windows."""
CAMERA, SHOT_SIZE, SHOT_FRAMES, SHOT_FRAME = "dolly", (960, 540), (1, 25), 9
"""The moving camera, its picture, its first and last frame, and the frame that most pictures show."""
CATCHER_SIZE = (640, 360)
ROOM = np.s_[55:375, 130:490]
"""Where the room is in the picture of the overview camera, 600x375 pixels."""
WAY = ("0006", "0010")
"""The camera goes from where this frame was taken to where that one was, which is between the training's frames."""
SOFA = "sofa 1"


def tiled(tiles: Mapping[str, Picture], columns: int, width: int) -> Picture:
    """A sheet: each picture under its caption, ``width`` pixels wide."""
    cells = [_captioned(caption, picture, width) for caption, picture in tiles.items()]
    height = max(len(cell) for cell in cells)
    rows = -(-len(cells) // columns)
    sheet = np.full((rows * (height + GAP) + GAP, columns * (width + GAP) + GAP, 3), BACKGROUND, np.uint8)
    for k, cell in enumerate(cells):
        top, left = GAP + k // columns * (height + GAP), GAP + k % columns * (width + GAP)
        sheet[top : top + len(cell), left : left + width] = cell
    return sheet


def _captioned(caption: str, picture: Picture, width: int) -> Picture:
    shape = (width, round(picture.shape[0] * width / picture.shape[1]))
    smooth = cv2.INTER_AREA if width < picture.shape[1] else cv2.INTER_CUBIC
    bar = np.full((BAR, width, 3), BACKGROUND, np.uint8)
    cv2.putText(bar, caption, (4, BAR - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.55, TEXT, 1, cv2.LINE_AA)
    return np.concatenate([bar, np.asarray(cv2.resize(picture, shape, interpolation=smooth), np.uint8)])


def save(name: str, picture: Picture) -> None:
    path = PICTURES / f"passes_{name}.jpg"
    if not cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]):
        raise OSError(f"{path} cannot be written")
    print(f"{path.relative_to(ROOT)}: {picture.shape[1]}x{picture.shape[0]}, {path.stat().st_size // 1000} kB")


# The camera


def write_camera(lift: Path) -> None:
    """The lift's .blend with the moving camera, as LIFT/shot.blend."""
    scene = open_lift(lift)
    ends = [bpy.data.objects[name].matrix_world.copy() for name in WAY]
    data = bpy.data.cameras.new(CAMERA)
    data.lens = 24.0
    camera = bpy.data.objects.new(CAMERA, data)
    camera.rotation_mode = "QUATERNION"
    scene.collection.objects.link(camera)
    for frame, end in zip(SHOT_FRAMES, ends, strict=True):
        camera.location, camera.rotation_quaternion = end.translation, end.to_quaternion()
        for path in ("location", "rotation_quaternion"):
            camera.keyframe_insert(path, frame=frame)
    scene.timeline_markers.clear()  # they would change the camera
    scene.camera, (scene.frame_start, scene.frame_end) = camera, SHOT_FRAMES
    scene.render.resolution_x, scene.render.resolution_y = SHOT_SIZE
    scene.render.resolution_percentage = 100
    bpy.ops.wm.save_as_mainfile(filepath=str(lift / "shot.blend"), compress=True, copy=True)


def open_lift(lift: Path, name: str = "lift.blend") -> bpy.types.Scene:
    """The scene of a .blend of the lift's that the frames' cameras are in."""
    bpy.ops.wm.open_mainfile(filepath=str(lift / name))
    return next(scene for scene in bpy.data.scenes if WAY[0] in scene.objects)


# Layers


def mask_picture(result: LiftResult) -> Picture:
    """A held-out frame: photo, the machine mask, and what was lifted, which saw neither."""
    frame = next(each for each in result.scene.frames if each.name == MASK_FRAME)
    photo, mask = frame.read_colour(frame.size), frame.mask(frame.size)
    layers = read_exr(result.passes[MASK_FRAME])
    return tiled(
        {
            f"photo, frame {MASK_FRAME}": photo,
            "its machine mask (black: none)": shaded(semantic_picture(mask.class_map(), result.classes), photo),
            "lifted classes": shaded(semantic_picture(layers.semantic, result.classes), photo),
            "lifted instances": shaded(instance_picture(layers.instance, instance_colours(result)), photo),
        },
        2,
        560,
    )


def layers_picture(result: LiftResult) -> Picture:
    """All layers of one frame of the moving camera."""
    import OpenEXR

    path = result.shots[f"{CAMERA}.{SHOT_FRAME:04d}"]
    layers = read_exr(path)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        planes = {name: channel.pixels for name, channel in file.channels().items()}
    normal, position = (
        np.stack([planes[f"PLGS.{name}.{axis}"] for axis in "XYZ"], axis=-1) for name in ("Normal", "Position")
    )
    return tiled(
        {
            "Combined": colour_picture(layers),
            "Semantic (class ids)": semantic_picture(layers.semantic, result.classes),
            "Instance (ids; grey: none)": instance_picture(layers.instance, instance_colours(result)),
            "Depth, near is bright": grey(1.0 - layers.depth / np.percentile(layers.depth, 99.5)),
            "Normal, world": bytes_of(normal * 0.5 + 0.5),
            "Position, world": bytes_of((position + (3.0, 6.0, 0.0)) / (10.0, 8.0, 2.6)),
            "Confidence, white is sure": grey(layers.confidence),
            "Entropy, white is unsure": grey(layers.entropy),
            "CryptoInstance, by coverage": cryptomatte_picture(planes, INSTANCES),
        },
        3,
        440,
    )


def cryptomatte_picture(planes: Mapping[str, NDArray[np.float32]], layer: str) -> Picture:
    """Each name in a colour of its own, mixed by its coverage of the pixel; black where nothing is."""
    found: dict[float, tuple[int, int, int]] = {}
    mixed = np.zeros((*planes[f"{layer}00.r"].shape, 3))
    for rank in range(3):
        for name, share in ("rg", "ba"):
            ids, coverage = planes[f"{layer}{rank:02d}.{name}"], planes[f"{layer}{rank:02d}.{share}"]
            for one in np.unique(ids[coverage > 0]).tolist():
                colour = found.setdefault(one, distinct_colour(len(found) + 1))
                mixed += np.where(ids == one, coverage, 0.0)[..., None] * np.array(colour) / 255
    return bytes_of(mixed)


def instance_colours(result: LiftResult) -> dict[int, tuple[int, int, int]]:
    return {one.id: one.colour for one in result.instances}


def grey(values: NDArray[np.floating]) -> Picture:
    """0..1 as a grey picture."""
    return np.repeat(bytes_of(values)[..., None], 3, axis=-1)


def bytes_of(values: NDArray[np.floating]) -> Picture:
    """0..1 as bytes."""
    return np.asarray(np.rint(np.clip(values, 0.0, 1.0) * 255), np.uint8)


# The compositor


def shot_picture(result: LiftResult) -> Picture:
    """Frames of the moving camera: what was rendered, and the instances' colours over it."""
    numbers = [int(name.rpartition(".")[2]) for name in result.shots if name.startswith(f"{CAMERA}.")]
    scene = shot_scene(result)
    frames = {f"frame {number}": composited(scene, number) for number in numbers}
    return tiled(frames | {" " * (k + 1): composited(scene, n, Overlay=0.6) for k, n in enumerate(numbers)}, 4, 350)


def matte_picture(result: LiftResult) -> Picture:
    """A matte that the group gives, and what it cuts out."""
    scene = shot_scene(result)
    return tiled(
        {
            f"Matte of {SOFA}": composited(scene, SHOT_FRAME, "Matte"),
            "Isolate = 1": composited(scene, SHOT_FRAME, Isolate=1.0),
        },
        2,
        600,
    )


def group_picture(result: LiftResult) -> Picture:
    """What else the group does with it."""
    scene = shot_scene(result)
    return tiled(
        {
            "Overlay = 0.55, Outline = 1": composited(scene, SHOT_FRAME, Overlay=0.55, Outline=1.0),
            "Recolour = 1": composited(scene, SHOT_FRAME, Recolour=1.0),
            "Hold out = 1": composited(scene, SHOT_FRAME, Hold_out=1.0),
            "By class = 1: rug, Recolour = 1": composited(scene, SHOT_FRAME, By_class=1.0, Recolour=1.0),
        },
        2,
        600,
    )


def shot_scene(result: LiftResult) -> bpy.types.Scene:
    """The compositor's scene of the moving camera, with these mattes."""
    open_lift(result.folder)
    scene = next(each for each in bpy.data.scenes if each.name.endswith(f" {CAMERA}"))
    tree = nodes_of(scene)
    node_of(tree, INSTANCES).matte_id, node_of(tree, CLASSES).matte_id = SOFA, "rug"
    return scene


def nodes_of(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The compositor's nodes of a scene with passes."""
    tree = compat.compositor_tree(scene)
    if tree is None:
        raise SystemExit(f"{scene.name} has no compositor nodes")
    return tree


def composited(scene: bpy.types.Scene, frame: int, output: str = "Overlay", **controls: float) -> Picture:
    """What an output of the group gives with these controls, all others 0; before a chequered ground."""
    tree = nodes_of(scene)
    inputs = panoptic_node(tree).inputs
    for name in ("By class", "Overlay", "Recolour", "Outline", "Isolate", "Hold out"):
        inputs[name].default_value = controls.get(name.replace(" ", "_"), 0.0)
    result = next(node for node in tree.nodes if node.bl_idname == compat.COMPOSITE_OUTPUT)
    tree.links.new(output_of(tree, output), result.inputs[0])
    scene.frame_set(frame)
    return before_ground(rendered(scene))


def rendered(scene: bpy.types.Scene) -> NDArray[np.uint8]:
    """The scene's picture, uint8 [H, W, 4], colours not multiplied by alpha. RuntimeError when there is none."""
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "8"
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "picture.png")
        with bpy.context.temp_override(scene=scene):
            bpy.ops.render.render(write_still=True)
        picture = cv2.imread(scene.render.filepath, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise RuntimeError(f"Blender rendered nothing of {scene.name}")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA), np.uint8)


def before_ground(picture: NDArray[np.uint8], square: int = 20) -> Picture:
    """A picture with alpha before grey squares."""
    rows, columns = np.indices(picture.shape[:2]) // square
    ground = np.where((rows + columns) % 2, 96.0, 70.0)[..., None]
    return over(picture, np.repeat(ground, 3, axis=-1))


def over(picture: NDArray[np.uint8], ground: NDArray[np.floating] | Picture) -> Picture:
    """A picture with alpha, uint8 [H, W, 4], before another, [H, W, 3]."""
    alpha = picture[..., 3:] / 255.0
    return np.asarray(np.rint(alpha * picture[..., :3] + (1.0 - alpha) * ground), np.uint8)


# Meshes


def meshes_picture(result: LiftResult) -> Picture:
    """The meshes seen from above, in the photos' colours, and in those of the objects and classes."""
    scene = open_lift(result.folder)
    meshes = only_meshes(result, scene)
    light(scene, sun=2.2, sky=0.75)
    scene.camera = bpy.data.objects["Overview"]
    scene.render.resolution_x, scene.render.resolution_y = 600, 375
    material = meshes[0].material_slots[0].material
    see_through_backs(material)
    photo = rendered(scene)
    show_object_colours(material)
    tiles = {"Col, of the photos": whiten(photo), "objects and classes": whiten(rendered(scene))}
    return tiled({name: tile[ROOM] for name, tile in tiles.items()}, 2, 480)


def catcher_picture(result: LiftResult) -> Picture:
    """Two things that were never there, before the baked picture: meshes take their shadows and hide what is behind."""
    scene = open_lift(result.folder, "shot.blend")
    for ob in only_meshes(result, scene):
        ob.is_shadow_catcher = True
    add_things(scene)
    light(scene, sun=3.0, sky=0.9)
    scene.cycles.samples, scene.cycles.max_bounces = 8, 1
    scene.render.resolution_x, scene.render.resolution_y = CATCHER_SIZE
    scene.frame_set(SHOT_FRAME)
    baked = colour_picture(read_exr(result.shots[f"{CAMERA}.{SHOT_FRAME:04d}"]))
    return over(rendered(scene), np.asarray(cv2.resize(baked, CATCHER_SIZE, interpolation=cv2.INTER_AREA), np.uint8))


def only_meshes(result: LiftResult, scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The lift's exported meshes, everything else hidden. SystemExit when there are none."""
    meshes = place_meshes_anew(result.folder, scene)
    if not meshes:
        raise SystemExit("the lift has no meshes: export them first, see docs/passes.md")
    for ob in scene.objects:
        ob.hide_render = ob not in meshes
    return meshes


def add_things(scene: bpy.types.Scene) -> None:
    """A golden head over the low table, and a red ball behind a dining chair."""
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        bpy.ops.mesh.primitive_monkey_add(size=0.55, location=(1.5, -1.75, 0.64), rotation=(-0.6, 0.0, 2.3))
        head = bpy.context.active_object
        bpy.ops.mesh.primitive_uv_sphere_add(radius=0.3, location=(3.55, -2.3, 0.3), segments=64, ring_count=32)
        ball = bpy.context.active_object
    head.modifiers.new("round", "SUBSURF").render_levels = 2
    for ob, colour, metal in ((head, (0.9, 0.55, 0.12, 1.0), 0.8), (ball, (0.7, 0.03, 0.03, 1.0), 0.0)):
        for polygon in ob.data.polygons:
            polygon.use_smooth = True
        material = bpy.data.materials.new(ob.name)
        shader = next(node for node in compat.use_nodes(material).nodes if node.type == "BSDF_PRINCIPLED")
        shader.inputs["Base Color"].default_value = colour
        shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = metal, 0.35
        ob.data.materials.append(material)


def light(scene: bpy.types.Scene, sun: float, sky: float) -> None:
    """Cycles with a sun and an even sky."""
    render = scene.render
    render.engine, render.use_compositing, render.use_sequencer, render.film_transparent = "CYCLES", False, False, True
    scene.timeline_markers.clear()  # they would change the camera
    render.resolution_percentage = 100
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 16, True
    scene.view_settings.view_transform = "Standard"
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    lamp.data.energy, lamp.data.angle = sun, 0.15
    lamp.rotation_euler = Vector((0.3, -0.45, -1.0)).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(lamp)
    scene.world = bpy.data.worlds.new("Sky")
    background = next(node for node in compat.use_nodes(scene.world).nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (1.0, 1.0, 1.0, 1.0), sky


def see_through_backs(material: bpy.types.Material) -> None:
    """Look into the room from outside: walls and ceiling are seen from within alone."""
    tree = material.node_tree
    end = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    front = end.inputs["Surface"].links[0].from_socket
    mix, clear = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeBsdfTransparent")
    tree.links.new(tree.nodes.new("ShaderNodeNewGeometry").outputs["Backfacing"], mix.inputs[0])
    tree.links.new(front, mix.inputs[1])
    tree.links.new(clear.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], end.inputs["Surface"])


def show_object_colours(material: bpy.types.Material) -> None:
    """The meshes' own colours instead of the photos'."""
    tree = material.node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    tree.links.new(tree.nodes.new("ShaderNodeObjectInfo").outputs["Color"], shader.inputs["Base Color"])


def whiten(picture: NDArray[np.uint8]) -> Picture:
    """Before a plain light ground."""
    return over(picture, np.full((*picture.shape[:2], 3), 214.0))


MAKERS: dict[str, Callable[[LiftResult], Picture]] = {
    "mask": mask_picture,
    "layers": layers_picture,
    "shot": shot_picture,
    "matte": matte_picture,
    "group": group_picture,
    "meshes": meshes_picture,
    "catcher": catcher_picture,
}


def main(arguments: Sequence[str]) -> int:
    """The command line; its exit code."""
    parser = argparse.ArgumentParser(description="Make the pictures of docs/passes.md.")
    parser.add_argument("what", nargs="+", choices=["camera", "all", *MAKERS], metavar="PICTURE")
    parser.add_argument("lift", type=Path, help="a finished lift of the sample")
    options = parser.parse_args(arguments)
    lift = options.lift.absolute()
    if "camera" in options.what:
        write_camera(lift)
        return 0
    for name in MAKERS if "all" in options.what else options.what:
        save(name, MAKERS[name](read_result(lift)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
