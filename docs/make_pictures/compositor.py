"""What the node group "PLGS Panoptic" makes of the moving camera's frames."""

from __future__ import annotations

import bpy
from plgs.plgs_blender import compat
from plgs.plgs_blender.pass_nodes import CLASSES, INSTANCES, node_of, output_of, panoptic_node
from plgs.plgs_blender.results import LiftResult

from .sheets import Picture, before_ground, tiled
from .shot import CAMERA, SHOT_FRAME, open_lift, rendered

SOFA = "sofa 1"


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
