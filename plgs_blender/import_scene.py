"""Show a scene's frames in Blender before a lift, to check whether poses, lenses and pictures fit."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import bpy
import numpy as np
from mathutils import Matrix, Quaternion
from numpy.typing import NDArray

from ..engine.known_scene import MadeFrames
from ..engine.posed.frames import PosedScene
from .cameras import object_matrix, overview_camera, picture_of, place_camera_path, place_frames, show_photo
from .chosen_scene import ChosenScene, as_texts
from .frame_pictures import cloud_of, has_cameras_of, photos, read_cloud, scene_of
from .inspecting.selection import objects_by_key, values_of
from .owned import FOLDER, LIFT, PLACE, OwnedDataBlocks, child_collection, overview_of, root_collection, scene_to_fill
from .splat_objects import place_points
from .timeline import mark_timeline
from .viewport import areas_that_show, frame_room

MISSING = "plgs_missing"
"""Property of an imported scene's collection: the kinds ("colour", "cloud") that an engine still has to make."""

_CLOUDS, _CLOUD, _SPARSE = "Coloured points", "cloud", "sparse_points"
"""The collection of the clouds, and their keys."""
_AHEAD = 2.0  # assumed extent of a room in front of its cameras, in metres, if there are no points
_INNER = (0.2, 99.8)  # percentiles of a cloud's coordinates that bound the room


def place_scene(
    place: ChosenScene, scene: bpy.types.Scene, made: MadeFrames | None = None, *, cloud: bool = True
) -> bpy.types.Collection:
    """Put the frames of a scene into Blender's scene: one camera per frame, with its picture and timeline marker, a
    camera that moves along them, the points of the reconstruction, and what an engine ``made`` before, which lists the
    cameras unless the folders are plain. With ``cloud``, the coloured cloud of the depth, if any, is placed too.
    Returns the collection, which a lift of the same frames uses, too. Its property MISSING lists what an engine must
    still make. An existing lift keeps everything else. Raises PlgsError before anything changes."""
    is_plain = made is None or place.is_plain
    opened = place.open_plain() if made is None or is_plain else scene_of(made)
    if made is not None and is_plain and not has_cameras_of(made, opened.frames):
        made = replace(made, cloud=None)  # it fits other poses
    scene = scene_to_fill(scene)
    root = root_collection(place.scene, None, scene)
    root[PLACE] = as_texts(place)
    owned = OwnedDataBlocks(root[LIFT], scene)
    pictures = photos(made, opened.frames)
    cameras = place_frames(owned, child_collection(root, "Cameras"), opened.frames, pictures)
    place_camera_path(owned, root, opened.frames, mark_timeline(scene, root, overview_of(root), cameras))
    if scene.camera is None:
        scene.camera = cameras[0]
    missing = [] if all(picture_of(frame, pictures) for frame in opened.frames) else ["colour"]
    if not root[FOLDER]:  # a lift has better points
        missing += _place_clouds(owned, root, opened, made, cloud)
    root[MISSING] = " ".join(missing)
    return root


def room_of(root: bpy.types.Collection, scene: bpy.types.Scene) -> tuple[Quaternion, NDArray[np.float64]]:
    """The rotation of a camera that overlooks what the frames see, and that region's corners [8, 3] in metres."""
    scene.view_layers[0].update()  # new objects have no matrix_world before
    matrices = np.array([ob.matrix_world for ob in root.all_objects if "frame" in ob])
    eyes, ahead = matrices[:, :3, 3], -matrices[:, :3, 2]  # a Blender camera looks along -z
    clouds = [values_of(ob.data, "position") for key, ob in objects_by_key(root).items() if key in (_CLOUD, _SPARSE)]
    points = [np.percentile(cloud, _INNER, axis=0) for cloud in clouds if len(cloud)] or [eyes + _AHEAD * ahead]
    xyz = np.concatenate([eyes, *points])
    corners = np.array(list(product(*np.stack([xyz.min(axis=0), xyz.max(axis=0)], axis=1))))
    overview = Matrix(object_matrix(overview_camera(corners, np.zeros_like(corners))).tolist())
    return overview.to_quaternion(), corners


def add_made(scene: bpy.types.Scene, root: bpy.types.Collection, made: MadeFrames) -> None:
    """Add the photos and the cloud that an engine made since the import. Views that the user has not moved then show
    the whole room. Raises PlgsError if the cloud's file is damaged."""
    owned = OwnedDataBlocks(root[LIFT], scene)
    cameras = {ob["frame"]: ob for key, ob in objects_by_key(root).items() if key.startswith("frame:")}
    for name, picture in photos(made).items():
        if name in cameras:
            show_photo(cameras[name], owned, picture)
    there = {"colour"} if all(ob.data.background_images for ob in cameras.values()) else set()
    there |= {"cloud"} if made.cloud is not None else set()
    root[MISSING] = " ".join(kind for kind in root.get(MISSING, "").split() if kind not in there)
    if made.cloud is not None and not root[FOLDER]:
        points = read_cloud(made.cloud)
        unmoved = areas_that_show(scene, *room_of(root, scene))
        eyes = np.array([camera.matrix_world.translation for camera in cameras.values()])
        place_points(owned, child_collection(root, _CLOUDS), _CLOUD, "Coloured cloud", points=points, viewpoints=eyes)
        for area in unmoved:
            frame_room(area, *room_of(root, scene))


def _place_clouds(
    owned: OwnedDataBlocks, root: bpy.types.Collection, opened: PosedScene, made: MadeFrames | None, cloud: bool
) -> list[str]:
    """Place the reconstruction's points and the cloud, if any. Returns what an engine must still make, as kinds."""
    eyes = np.array([frame.camera.centre for frame in opened.frames])
    if opened.points is not None and len(opened.points):
        points = np.asarray(opened.points.xyz, np.float32), opened.points.rgb
        place_points(owned, child_collection(root, _CLOUDS), _SPARSE, "Sparse points", points=points, viewpoints=eyes)
    if not cloud:
        return []
    path = cloud_of(made, opened.frames)
    if path is None:
        return ["cloud"] if any(frame.depth_path is not None for frame in opened.frames) else []
    place_points(
        owned, child_collection(root, _CLOUDS), _CLOUD, "Coloured cloud", points=read_cloud(path), viewpoints=eyes
    )
    return []
