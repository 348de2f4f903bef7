"""Export the meshes that are shown with Blender's own exporters, in seconds, as nothing is computed again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ..engine.errors import PlgsError
from .compat import use_nodes
from .inspecting.looks import COLOUR, leaving_out
from .inspecting.selection import objects_by_key
from .materials import add_node, image_of
from .reuse import extracted

SUFFIXES = {"gltf": (".glb", ".gltf"), "usd": (".usdz", ".usdc", ".usda", ".usd")}
"""The endings of each form's files; the first is a single file with its pictures in it."""
_FIX = "Choose a place that you may write to, on a disk with space."


def why_not(form: str) -> str | None:
    """Return what this Blender lacks to export a form, None if it lacks nothing."""
    if form == "usd" and not bpy.app.build_options.usd:
        return "This Blender was built without OpenUSD. Use OpenUSD, Finer, or Blender's glTF"
    if form == "gltf" and "io_scene_gltf2" not in bpy.context.preferences.addons:
        return "Switch on glTF 2.0 format in Preferences > Add-ons"
    return None


def shown_meshes(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """The meshes of a lift's surface that its lists show; an extracted object takes the place of its own mesh."""
    is_left_out = leaving_out(root.plgs)
    own = [ob for key, ob in objects_by_key(root).items() if key.startswith("mesh:") and len(ob.data.polygons)]
    ids = [np.array([[ob["instance_id"]], [ob["class_id"]]], np.int32) for ob in own]
    shown = [ob for ob, (instance, kind) in zip(own, ids, strict=True) if not is_left_out(instance, kind)[0]]
    return [*shown, *extracted(root)]


def export_shown(root: bpy.types.Collection, scene: bpy.types.Scene, form: str, path: Path) -> int:
    """Write the meshes that are shown as "gltf" or "usd", named, with their pictures or colours, and return their
    number. The scene is unchanged afterwards. Raises PlgsError, for example if no mesh is shown."""
    meshes = shown_meshes(root)
    if not meshes:
        raise PlgsError("no-meshes", "shows no meshes", root.name, "Make them first: press Surface.")
    lacking = why_not(form)
    if lacking is not None:
        raise PlgsError("no-exporter", "this Blender cannot write such a file", path, lacking + ".")
    path = path if path.suffix.lower() in SUFFIXES[form] else Path(f"{path}{SUFFIXES[form][0]}")
    with _gathered(meshes, scene) as collection, _with_plain_materials(meshes):
        write: Callable[..., object] = partial(bpy.ops.wm.usd_export, export_animation=False)
        if form == "gltf":
            kind = "GLB" if path.suffix.lower() == ".glb" else "GLTF_SEPARATE"
            write = partial(bpy.ops.export_scene.gltf, export_format=kind, export_animations=False, export_extras=True)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write(filepath=str(path), collection=collection.name)
        except (RuntimeError, OSError) as error:
            raise PlgsError("unwritable", f"cannot be written ({str(error).strip()})", path, _FIX) from error
    if not path.is_file():
        raise PlgsError("unwritable", "was not written", path, _FIX)
    return len(meshes)


@contextmanager
def _gathered(meshes: Sequence[bpy.types.Object], scene: bpy.types.Scene) -> Iterator[bpy.types.Collection]:
    """Yield a temporary collection with only these objects, all visible, for a ``with`` block."""
    collection = bpy.data.collections.new("PLGS export")
    scene.collection.children.link(collection)
    layer = scene.view_layers[0]
    hidden = [ob for ob in meshes if layer.objects.get(ob.name) == ob and ob.hide_get(view_layer=layer)]
    off = [ob for ob in meshes if ob.hide_viewport]
    try:
        for ob in meshes:
            collection.objects.link(ob)
            ob.hide_viewport = False
        layer.update()
        for ob in hidden:
            ob.hide_set(False, view_layer=layer)
        yield collection
    finally:
        for ob in hidden:
            ob.hide_set(True, view_layer=layer)
        for ob in off:
            ob.hide_viewport = True
        bpy.data.collections.remove(collection)


@contextmanager
def _with_plain_materials(meshes: Sequence[bpy.types.Object]) -> Iterator[None]:
    """Give meshes simple matt materials with their pictures or colours, for exporters, in a ``with`` block."""
    before = [(ob, ob.material_slots[0].link, ob.data.materials[0]) for ob in meshes if ob.material_slots]
    made: dict[str, bpy.types.Material] = {}
    try:
        for ob, _, own in before:
            if own.name not in made:
                made[own.name] = _plain(ob.name, image_of(own))
            ob.data.materials[0], ob.material_slots[0].link = made[own.name], "DATA"
        yield
    finally:
        for ob, link, own in before:
            ob.data.materials[0], ob.material_slots[0].link = own, link
        bpy.data.batch_remove(made.values())


def _plain(name: str, image: bpy.types.Image | None) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    tree = use_nodes(material)
    shader = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
    shader.inputs["Roughness"].default_value = 1.0
    colour = add_node(tree, "ShaderNodeTexImage" if image else "ShaderNodeVertexColor", -2, 0)
    if image is not None:
        colour.image = image
    else:
        colour.layer_name = COLOUR
    tree.links.new(colour.outputs["Color"], shader.inputs["Base Color"])
    return material
