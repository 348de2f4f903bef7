"""The compositor nodes of a passes scene, and their group "PLGS Panoptic": a matte by class or instance, and its
effects.

Nodes are found by their tag, so users may move, rename and link them. The group lays the ids' colours over the picture,
shifts the hue inside the matte, outlines it, and cuts out what is outside or inside of it, in this order. All controls
are inputs of the group, so they can be linked and animated."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from . import compat
from .owned import KEY, tag

NAME = "PLGS Panoptic"
MARK = "panoptic group"
LINE_PIXELS = 2
"""Width of the outline in pixels."""
_OUTLINE, _RECOLOUR, _GUESSED = (1.0, 0.6, 0.05, 1.0), (0.05, 0.25, 0.9, 1.0), (0.9, 0.05, 0.7, 1.0)


CONTROLS = {
    "By class": "0: the instances' matte, 1: the classes' matte",
    "Overlay": "Opacity of the instances' or classes' colours over the picture",
    "Recolour": "How much the matte takes the hue of the colour below; it keeps its light and shade",
    "Outline": "Opacity of the line around the matte",
    "Isolate": "How far everything outside the matte becomes transparent",
    "Hold out": "How far the inside of the matte becomes transparent",
    "Clean plate": "How far the picture linked to Plate (the room without an object) replaces the picture",
    "Difference": "How far the difference between picture and plate replaces the picture",
    "Guessed": "Opacity of the colour below where no photo ever saw what is shown, as objects were removed",
}
"""Factors of the group, 0 to 1, initially 0, with descriptions."""
PICTURES = ("Image", "Instance colours", "Class colours", "Plate")
MATTES = ("Instance matte", "Class matte", "Instance", "Guessed matte")
COLOURS = {"Outline colour": _OUTLINE, "Recolour to": _RECOLOUR, "Guessed colour": _GUESSED}


def panoptic_group() -> bpy.types.NodeTree:
    """Return the file's group, made if missing. A group that is linked or lacks an input is left alone."""
    wanted = {*PICTURES, *MATTES, *COLOURS, *CONTROLS}
    for group in bpy.data.node_groups:
        if group.get(KEY) == MARK and group.library is None:
            if wanted <= {item.name for item in group.interface.items_tree}:
                return group
    group = bpy.data.node_groups.new(NAME, "CompositorNodeTree")
    group[KEY] = MARK
    _declare(group)
    _Wiring(group).build()
    return group


def _declare(group: bpy.types.NodeTree) -> None:
    face = group.interface
    for name in ("Image", "Matte", "Outline"):
        kind = "NodeSocketColor" if name == "Image" else "NodeSocketFloat"
        face.new_socket(name, in_out="OUTPUT", socket_type=kind)
    for name in PICTURES:
        face.new_socket(name, in_out="INPUT", socket_type="NodeSocketColor")
    for name in MATTES:
        socket = face.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
        socket.hide_value = True
    for name, description in CONTROLS.items():
        socket = face.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
        socket.subtype, socket.min_value, socket.max_value = "FACTOR", 0.0, 1.0
        socket.default_value, socket.description = 0.0, description
    for name, colour in COLOURS.items():
        face.new_socket(name, in_out="INPUT", socket_type="NodeSocketColor").default_value = colour


class _Wiring:
    def __init__(self, group: bpy.types.NodeTree) -> None:
        self._group, self._column = group, 0
        self._in = group.nodes.new("NodeGroupInput").outputs
        self._out = group.nodes.new("NodeGroupOutput").inputs

    def build(self) -> None:
        given = self._in
        instances = given["Instance matte"]
        to_class = self._product(self._math("SUBTRACT", given["Class matte"], instances), given["By class"])
        matte = self._math("ADD", instances, to_class)
        grown = self._place(compat.new_dilation(self._group, LINE_PIXELS))
        self._group.links.new(matte, grown.inputs[0])
        line = self._product(self._math("SUBTRACT", grown.outputs[0], matte), given["Outline"])
        colours = self._mixed(given["By class"], given["Instance colours"], given["Class colours"])
        is_shown = self._larger(self._math("GREATER_THAN", given["Instance"], 0.5), given["By class"])
        image = self._mixed(given["Clean plate"], given["Image"], given["Plate"])
        image = self._mixed(given["Difference"], image, given["Plate"], "DIFFERENCE")
        image = self._mixed(self._product(given["Guessed"], given["Guessed matte"]), image, given["Guessed colour"])
        image = self._mixed(self._product(given["Overlay"], is_shown), image, colours)
        image = self._mixed(self._product(given["Recolour"], matte), image, given["Recolour to"], "COLOR")
        image = self._mixed(line, image, given["Outline colour"])
        around = self._without(self._larger(matte, line))
        kept = self._without(self._product(given["Isolate"], around))
        kept = self._product(kept, self._without(self._product(given["Hold out"], matte)))
        cut = self._place(compat.new_alpha_factor(self._group))
        self._group.links.new(image, cut.inputs["Image"])
        self._group.links.new(kept, cut.inputs["Alpha"])
        for name, socket in (("Image", cut.outputs[0]), ("Matte", matte), ("Outline", line)):
            self._group.links.new(socket, self._out[name])

    def _without(self, what: Any) -> Any:
        return self._math("SUBTRACT", 1.0, what)

    def _product(self, one: Any, other: Any) -> Any:
        return self._math("MULTIPLY", one, other)

    def _larger(self, one: Any, other: Any) -> Any:
        return self._math("MAXIMUM", one, other)

    def _math(self, operation: str, one: Any, other: Any) -> Any:
        node = self._place(compat.new_node(self._group, "ShaderNodeMath", "CompositorNodeMath"))
        node.operation = operation
        for socket, value in zip(node.inputs, (one, other), strict=False):  # maths nodes have a third input
            if isinstance(value, float):
                socket.default_value = value
            else:
                self._group.links.new(value, socket)
        return node.outputs[0]

    def _mixed(self, factor: Any, first: Any, second: Any, blend: str = "MIX") -> Any:
        node, *sockets, result = compat.new_colour_mix(self._group)
        self._place(node).blend_type = blend
        for value, socket in zip((factor, first, second), sockets, strict=True):
            self._group.links.new(value, socket)
        return result

    def _place(self, node: bpy.types.Node) -> bpy.types.Node:
        """Arrange a node in rows of six, in the order of creation."""
        self._column += 1
        node.location = (200 * (self._column % 6), -220 * (self._column // 6))
        return node


LAYER = "PLGS"
PASSES, CRYPTO_INSTANCES, CRYPTO_CLASSES, PANOPTIC = "passes", "CryptoInstance", "CryptoClass", "panoptic"
_STRENGTH = 0.55  # opacity of the instances' colours over the picture
_LOWER = 240.0  # units by which the nodes are lowered, so that the backdrop stays visible


_OUTPUTS = {
    "Instance colours": ("Instance colours", "Image"),
    "Class colours": ("Class colours", "Image"),
    "Instance matte": (CRYPTO_INSTANCES, "Matte"),
    "Class matte": (CRYPTO_CLASSES, "Matte"),
    "Overlay": (PANOPTIC, "Image"),
    "Matte": (PANOPTIC, "Matte"),
    "Outline": (PANOPTIC, "Outline"),
}
"""Node and socket of outputs that are not layers."""


def node_of(tree: bpy.types.NodeTree, key: str) -> bpy.types.Node:
    """Return our node `key`. Raises KeyError if the user removed it."""
    for node in tree.nodes:
        if node.get(KEY) == key:
            return node
    raise KeyError(f"the compositor of the passes has no node {key!r} any more")


def has_nodes(tree: bpy.types.NodeTree | None) -> bool:
    """Whether our nodes were built before and none of those that we update is missing."""
    keys = {node.get(KEY) for node in tree.nodes} if tree is not None else set()
    filled = {f"{what} {part}" for what in ("Instance", "Class") for part in ("palette", "scale")}
    return {PASSES, CRYPTO_INSTANCES, CRYPTO_CLASSES, *filled} <= keys


def output_of(tree: bpy.types.NodeTree, name: str) -> Any:
    """An output socket to link from: a layer, such as "Depth", or one of `_OUTPUTS`. Raises KeyError for other ones."""
    key, output = _OUTPUTS.get(name, (PASSES, name))
    for socket in node_of(tree, key).outputs:
        if socket.enabled and output == socket.name:
            return socket
    raise KeyError(f"the passes have no output {name!r}")


def use_image(tree: bpy.types.NodeTree, image: bpy.types.Image) -> None:
    """Make the passes node and both Cryptomatte nodes read an EXR's image."""
    _ = image.size[:]  # Blender must read a file before a node can name one of its layers
    for node in reading_nodes(tree):
        node.image = image
    node_of(tree, PASSES).layer = LAYER
    for key in (CRYPTO_INSTANCES, CRYPTO_CLASSES):
        node_of(tree, key).layer_name = key
    _link_guessed(tree)


def _link_guessed(tree: bpy.types.NodeTree) -> None:
    """Link the passes' layer Guessed to our group, if both have it. Only lifts with removed objects have this layer."""
    group = next((node for node in tree.nodes if node.get(KEY) == PANOPTIC), None)
    guessed = node_of(tree, PASSES).outputs.get("Guessed")
    if group is not None and guessed is not None and "Guessed matte" in group.inputs:
        tree.links.new(guessed, group.inputs["Guessed matte"])


def reading_nodes(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """Yield the nodes that read the EXR of the current view."""
    return (node_of(tree, key) for key in (PASSES, CRYPTO_INSTANCES, CRYPTO_CLASSES))


class _NodeBuilder:
    """Adds tagged nodes, arranged in columns of 220 units."""

    def __init__(self, tree: bpy.types.NodeTree, lift: str) -> None:
        self.tree, self._lift = tree, lift

    def add(self, key: str, label: str, column: float, row: float, *kinds: str) -> bpy.types.Node:
        return self.dress(compat.new_node(self.tree, *kinds), key, label, column, row)

    def dress(self, node: bpy.types.Node, key: str, label: str, column: float, row: float) -> bpy.types.Node:
        node.location, node.label, node.name = (220 * column, row - _LOWER), label, key
        tag(node, self._lift, key)
        return node

    def link(self, output: Any, target: Any) -> None:
        self.tree.links.new(output, target)


def build(tree: bpy.types.NodeTree, lift: str, image: bpy.types.Image) -> None:
    """Build all nodes and links, which read `image`. The output shows the instances' colours over the picture."""
    make = _NodeBuilder(tree, lift)
    make.add(PASSES, "PLGS passes", 0, 200, "CompositorNodeImage")
    for key, label, row in ((CRYPTO_INSTANCES, "Matte of instances", -320), (CRYPTO_CLASSES, "Matte of classes", -720)):
        make.add(key, label, 0, row, "CompositorNodeCryptomatteV2").source = "IMAGE"
    use_image(tree, image)
    _colour_code(make, "Instance", "Instance", -60)
    _colour_code(make, "Class", "Semantic", -420)
    depth = make.add("depth", "Depth (near: black)", 1.5, 80, "CompositorNodeNormalize")
    make.link(output_of(tree, "Depth"), depth.inputs[0])
    _show_panoptic(make)


def _colour_code(make: _NodeBuilder, what: str, layer: str, row: float) -> None:
    """Add nodes that turn the ids of a ``layer`` into colours: they are indices into a palette one pixel high."""
    palette = make.add(f"{what} palette", f"{what} palette", 1.5, row - 170, "CompositorNodeImage")
    scale = make.add(f"{what} scale", "Id to place", 1.5, row, "ShaderNodeMath", "CompositorNodeMath")
    scale.operation = "MULTIPLY_ADD"
    place = make.add(f"{what} place", "Place", 2.4, row, "ShaderNodeCombineXYZ", "CompositorNodeCombineXYZ")
    place.inputs[1].default_value, place.inputs[2].default_value = compat.IN_A_PIXEL, 1.0
    look_up = compat.new_palette_lookup(make.tree)
    make.dress(look_up, f"{what} colours", f"{what} colours", 3.2, row)
    make.link(output_of(make.tree, layer), scale.inputs[0])
    make.link(scale.outputs[0], place.inputs[0])
    make.link(palette.outputs[0], look_up.inputs["Image"])
    make.link(place.outputs[0], look_up.inputs["UV"])


def _show_panoptic(make: _NodeBuilder) -> None:
    """Link the inputs of the group PLGS Panoptic, and its picture to the render result and the viewer."""
    node = make.add(PANOPTIC, NAME, 4.1, 200, "CompositorNodeGroup")
    node.node_tree, node.width = panoptic_group(), 200.0
    for name in ("Instance colours", "Class colours", "Instance matte", "Class matte", "Instance"):
        make.link(output_of(make.tree, name), node.inputs[name])
    make.link(output_of(make.tree, "Combined"), node.inputs["Image"])
    _link_guessed(make.tree)
    node.inputs["Overlay"].default_value = _STRENGTH
    image = node.outputs["Image"]
    make.link(image, make.add("result", "", 5.3, 200, compat.COMPOSITE_OUTPUT).inputs[0])
    make.link(image, make.add("viewer", "", 5.3, 40, "CompositorNodeViewer").inputs[0])
