"""The moving camera, how Blender renders its frames, and what the node group "PLGS Panoptic" makes of them."""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import cv2
import numpy as np
from numpy.typing import NDArray
from plgs.plgs_blender import compat
from plgs.plgs_blender.lift_scene import place_passes_anew
from plgs.plgs_blender.pass_nodes import CLASSES, INSTANCES, node_of, output_of, panoptic_node
from plgs.plgs_blender.results import LiftResult

from .sheets import Picture, before_ground, tiled

CAMERA, SHOT_SIZE, SHOT_FRAMES, SHOT_FRAME = "dolly", (960, 540), (1, 25), 9
"""The moving camera, its picture size, its first and last frame, and the frame that most pictures show."""
WAY = ("0006", "0010")
"""The camera moves from the place of one frame to that of the other. No frame was taken between them."""
SOFA = "sofa 1"


def write_camera(lift: Path) -> None:
    """Write the lift's .blend with the moving camera to LIFT/shot.blend."""
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
    """Open a .blend of the lift, and return the scene with the frames' cameras."""
    bpy.ops.wm.open_mainfile(filepath=str(lift / name))
    return next(scene for scene in bpy.data.scenes if WAY[0] in scene.objects)


def rendered(scene: bpy.types.Scene) -> NDArray[np.uint8]:
    """The scene's picture, uint8 [H, W, 4], colours not multiplied by alpha. RuntimeError if there is none."""
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


def shot_picture(result: LiftResult) -> Picture:
    """Frames of the moving camera as rendered, and below with the instances' colours over them."""
    numbers = [int(name.rpartition(".")[2]) for name in result.shots if name.startswith(f"{CAMERA}.")]
    scene = shot_scene(result)
    frames = {f"frame {number}": composited(scene, number) for number in numbers}
    return tiled(frames | {" " * (k + 1): composited(scene, n, Overlay=0.6) for k, n in enumerate(numbers)}, 4, 350)


def matte_picture(result: LiftResult) -> Picture:
    """A matte of the group, and what it cuts out."""
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
    """What else the group does with a matte."""
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
    """The compositor's scene of the moving camera, with the sofa and the rug as mattes."""
    place_passes_anew(result.folder, open_lift(result.folder))
    scene = next(each for each in bpy.data.scenes if each.name.endswith(f" {CAMERA}"))
    tree = compat.compositor_tree(scene)
    node_of(tree, INSTANCES).matte_id, node_of(tree, CLASSES).matte_id = SOFA, "rug"
    return scene


def composited(scene: bpy.types.Scene, frame: int, output: str = "Overlay", **controls: float) -> Picture:
    """An output of the group before a chequered ground. Controls that are not given are 0."""
    tree = compat.compositor_tree(scene)
    inputs = panoptic_node(tree).inputs
    for name in ("By class", "Overlay", "Recolour", "Outline", "Isolate", "Hold out"):
        inputs[name].default_value = controls.get(name.replace(" ", "_"), 0.0)
    result = next(node for node in tree.nodes if node.bl_idname == compat.COMPOSITE_OUTPUT)
    tree.links.new(output_of(tree, output), result.inputs[0])
    scene.frame_set(frame)
    return before_ground(rendered(scene))
