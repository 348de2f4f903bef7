"""Point clouds that Blender draws and renders as splats by itself, from 5.3 on.

Their attribute `radiance:base` has the constant spherical harmonic of each channel (sRGB = 0.5 + HARMONIC * it) and the
opacity. `scale` has standard deviations in metres, `rotation` a quaternion wxyz.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .open_room import open_room
from .owned import OwnedDataBlocks

HARMONIC = 0.28209479177387814
_KIND, _BASE = "GAUSSIAN_SPLAT", "radiance:base"
_FIELDS = {"FLOAT_VECTOR": "vector", "QUATERNION": "value", "FLOAT4": "vector", "INT": "value",
           "BYTE_COLOR": "color_srgb"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Splats:
    """``xyz`` float32 [N, 3] m; ``deviations`` float32 [N, 3] m along axes that are turned by ``turns`` float32 [N, 4],
    quaternions wxyz; ``opacity`` float32 [N]; ``rgb`` uint8 [N, 3] sRGB; ``normal`` float32 [N, 3]: a splat is left out
    where it points away from the camera; ``ids`` int32 [N] by the names of more attributes."""

    xyz: NDArray[np.float32]
    deviations: NDArray[np.float32]
    turns: NDArray[np.float32]
    opacity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    normal: NDArray[np.float32]
    ids: Mapping[str, NDArray[np.int32]]


def are_known() -> bool:
    """Whether this Blender has such clouds."""
    kind = bpy.types.PointCloud.bl_rna.properties.get("type")
    return kind is not None and _KIND in kind.enum_items


def place_splats(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, key: str, name: str, splats: Splats
) -> bpy.types.Object:
    """Our object `key` with these splats, in the colours of their attribute Col: `dye` them after it changed."""
    cloud: Any = owned.data(key, lambda: bpy.data.pointclouds.new(name))
    cloud.resize(len(splats.xyz))
    cloud.type = _KIND
    rgba = np.ones((2, len(splats.xyz), 4), np.float32)
    rgba[0, :, :3], rgba[1, :, 3] = splats.rgb / np.float32(255), splats.opacity
    columns = {
        "position": ("FLOAT_VECTOR", splats.xyz),
        "scale": ("FLOAT_VECTOR", splats.deviations),
        "rotation": ("QUATERNION", splats.turns),
        "normal": ("FLOAT_VECTOR", splats.normal),
        "Col": ("BYTE_COLOR", rgba[0]),
        _BASE: ("FLOAT4", rgba[1]),
        **{each: ("INT", numbers) for each, numbers in splats.ids.items()},
    }
    for old in {layer.name for layer in cloud.attributes} - columns.keys():  # such as what was hidden
        cloud.attributes.remove(cloud.attributes[old])
    for attribute, (kind, values) in columns.items():
        layer = cloud.attributes.get(attribute) or cloud.attributes.new(attribute, kind, "POINT")
        layer.data.foreach_set(_FIELDS[kind], np.ascontiguousarray(values).ravel())
    dye(cloud)
    ob = owned.object(key, name, cloud, parent)
    open_room(owned, [ob])
    ob["points"] = len(splats.xyz)
    return ob


def dye(cloud: bpy.types.PointCloud) -> None:
    """Give splats the colours of their attribute Col. Other clouds and meshes stay as they are."""
    base = cloud.attributes.get(_BASE)
    if base is None:
        return
    values, colours = np.empty((2, len(base.data), 4), np.float32)
    base.data.foreach_get("vector", values.ravel())
    cloud.attributes["Col"].data.foreach_get("color_srgb", colours.ravel())
    values[:, :3] = (colours[:, :3] - 0.5) / HARMONIC
    base.data.foreach_set("vector", values.ravel())
    cloud.update_tag()
