"""The exported meshes, alone and as shadow catchers."""

from __future__ import annotations

import bpy
import cv2
import numpy as np
from mathutils import Vector
from plgs.engine.passes.exr import read_exr
from plgs.engine.passes.previews import colour_picture
from plgs.plgs_blender import compat
from plgs.plgs_blender.inspecting.lookup import surfaces_of
from plgs.plgs_blender.lift_collection import root_of_placed
from plgs.plgs_blender.lift_scene import placing_meshes_anew
from plgs.plgs_blender.materials import LIT, value_node
from plgs.plgs_blender.results import LiftResult, result_of

from .blender import CAMERA, SHOT_FRAME, open_lift, rendered
from .sheets import Picture, over, tiled

CATCHER_SIZE = (640, 360)
ROOM = np.s_[55:375, 130:490]
"""The room's part of the picture of the overview camera, 600x375 pixels."""
LIGHT_GROUND = np.full(3, 214.0)


def meshes_picture(result: LiftResult) -> Picture:
    """The meshes from above, in the photos' colours, and in those of the objects and classes."""
    scene = open_lift(result.folder)
    meshes = only_meshes(result, scene)
    light(scene, sun=2.2, sky=0.75)
    scene.camera = bpy.data.objects["Overview"]
    scene.render.resolution_x, scene.render.resolution_y = 600, 375
    material = meshes[0].material_slots[0].material
    photos = rendered(scene)
    show_object_colours(material)
    tiles = {"Col, from the photos": photos, "objects and classes": rendered(scene)}
    return tiled({name: over(tile[ROOM], LIGHT_GROUND) for name, tile in tiles.items()}, 2, 480)


def catcher_picture(result: LiftResult) -> Picture:
    """Two new things before the baked picture. The meshes take their shadows and hide what is behind."""
    scene = open_lift(result.folder, "shot.blend")
    for ob in only_meshes(result, scene):
        ob.is_shadow_catcher = True
    add_things(scene)
    light(scene, sun=3.0, sky=0.9)
    scene.cycles.samples, scene.cycles.max_bounces = 64, 1  # with few, shaded walls get dark specks
    scene.render.resolution_x, scene.render.resolution_y = CATCHER_SIZE
    scene.frame_set(SHOT_FRAME)
    baked = colour_picture(read_exr(result.shots[f"{CAMERA}.{SHOT_FRAME:04d}"]))
    return over(rendered(scene), np.asarray(cv2.resize(baked, CATCHER_SIZE, interpolation=cv2.INTER_AREA), np.uint8))


def only_meshes(result: LiftResult, scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The lift's exported meshes, with everything else hidden. SystemExit if there are none."""
    result_of(placing_meshes_anew(result.folder, scene))
    meshes = [ob for ob in surfaces_of(root_of_placed(result.folder, scene)) if "class_id" in ob]  # no splats
    if not meshes:
        raise SystemExit("the lift has no meshes: export them first, see docs/passes.md")
    for ob in scene.objects:
        ob.hide_render = ob not in meshes
    value_node(meshes[0].material_slots[0].material, LIT).outputs[0].default_value = 1.0
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


def show_object_colours(material: bpy.types.Material) -> None:
    """Show the objects' colours instead of the photos'."""
    tree = material.node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    tree.links.new(tree.nodes.new("ShaderNodeObjectInfo").outputs["Color"], shader.inputs["Base Color"])
