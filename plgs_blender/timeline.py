"""The lift's markers on the timeline: each is bound to one of our cameras, so scrubbing walks through the frames.

At every frame change, Blender activates the camera of the marker there. So that a user's camera stays active, our
markers are on the timeline only while one of our cameras is active; otherwise their frames are kept in a property of
these cameras ("waiting markers")."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

import bpy

from .owned import LIFT, key_of, lifts_in, originals, text_of

_FIRST_FRAME = "plgs_first_frame"
"""Property of a lift's collection: the timeline frame of its first marker; 0 if frames keep their numbers."""
_LAST_NUMBER = re.compile(r"\d+(?=\D*$)")
_LARGEST = 1_000_000  # the timeline ends shortly after this frame
_ASIDE = "plgs_markers_aside"  # property of a lift's collection, present while its markers wait
_PLACE = "plgs_place"  # property of a camera whose marker waits: its timeline frame


def mark_timeline(
    scene: bpy.types.Scene,
    root: bpy.types.Collection,
    overview: bpy.types.Object | None,
    cameras: Sequence[bpy.types.Object],
) -> list[int]:
    """Bind a marker to each frame's camera, at the number in the frame's name, and a last one to the overview, if any.
    The markers replace this lift's earlier ones, and come after the scene's range if the scene has a user's camera.
    Returns the markers' frames."""
    markers, ours = scene.timeline_markers, _originals(scene, root[LIFT])
    for marker in [m for m in markers if m.camera in ours]:
        markers.remove(marker)
    if type(root.get(_FIRST_FRAME)) is not int:
        theirs = scene.camera is not None and key_of(scene.camera, root[LIFT]) is None
        is_theirs = theirs or any(marker.camera is not None for marker in markers)
        root[_FIRST_FRAME] = scene.frame_end + 1 if is_theirs else 0
    # The last numbers in the frames' names, if these rise and fit the timeline; else 0, 1, 2 and so on.
    names = [text_of(camera, "frame") for camera in cameras]
    numbers = [int(found[0]) for name in names if (found := _LAST_NUMBER.search(name)) is not None]
    rises = len(numbers) == len(names) and all(one < other for one, other in pairwise(numbers))
    if not rises or max(numbers, default=0) >= _LARGEST:
        numbers = [*range(len(names))]
    first: int = root[_FIRST_FRAME]
    places = [first + number - numbers[0] for number in numbers] if first else numbers
    for place, camera in zip(places, cameras, strict=True):
        camera[_PLACE] = place
    if overview is not None:
        overview[_PLACE] = places[-1] + 1 if places else first
    root[_ASIDE] = True
    follow_camera(scene)
    return places


def places_of(root: bpy.types.Collection, scene: bpy.types.Scene) -> dict[bpy.types.Object, int]:
    """Return the timeline frames of the lift's cameras, also if its markers are not on the timeline now."""
    own = _originals(scene, root[LIFT])
    ours = {m.camera: m.frame for m in scene.timeline_markers if m.camera in own}
    if not root.get(_ASIDE):
        return ours
    return {ob: ob[_PLACE] for ob in _waiting(scene, root[LIFT])} | ours


@bpy.app.handlers.persistent
def follow_camera(scene: bpy.types.Scene, *_arguments: object) -> None:
    """Put lifts' markers on the timeline if the scene's camera is a lift's, else remove them. Safe at any time."""
    camera, roots = scene.camera, {root[LIFT]: root for root in lifts_in(scene) if root.library is None}
    if not roots or scene.library is not None:
        return
    seen = [marker for marker in scene.timeline_markers if marker.camera is not None]
    bound = [marker for marker in seen if any(key_of(marker.camera, lift) is not None for lift in roots)]
    if bound:  # a user's copy of our camera is not ours, nor is its marker
        ours = set().union(*(_originals(scene, lift) for lift in roots))
        bound = [marker for marker in bound if marker.camera in ours]
    likely = (
        [] if camera is None or _PLACE not in camera else [lift for lift in roots if key_of(camera, lift) is not None]
    )
    waits = any(camera in _waiting(scene, lift) for lift in likely)
    is_ours = waits or any(marker.camera == camera for marker in bound)
    if camera is None or is_ours:
        for root in roots.values():
            if root.get(_ASIDE):
                _bring_back(scene, root)
        return
    for marker in bound:
        roots[text_of(marker.camera, LIFT)][_ASIDE] = True
        marker.camera[_PLACE] = marker.frame
        scene.timeline_markers.remove(marker)


def _waiting(scene: bpy.types.Scene, lift: str) -> list[bpy.types.Object]:
    """Return the lift's cameras that remember their markers' frames, as the markers are not on the timeline now."""
    return [ob for ob in _originals(scene, lift) if _PLACE in ob]


def is_of_lift(camera: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether a lift or an import of the scene placed a camera; false for a user's copy of one."""
    return any(camera in _originals(scene, root[LIFT]) for root in lifts_in(scene))


def _originals(scene: bpy.types.Scene, lift: str) -> set[bpy.types.Object]:
    """Return the lift's own objects in a scene, without the user's copies of them."""
    return set(originals(scene.objects, lift).values())


def _bring_back(scene: bpy.types.Scene, root: bpy.types.Collection) -> None:
    active = scene.camera
    del root[_ASIDE]
    for camera in sorted(_waiting(scene, root[LIFT]), key=lambda ob: int(ob[_PLACE])):
        name = text_of(camera, "frame") or camera.name
        scene.timeline_markers.new(name, frame=camera.pop(_PLACE)).camera = camera
    scene.camera = active or scene.camera  # a new marker's camera may have become the scene's


# A script may change the frame before Blender reports its change of the camera.
HANDLERS = (("depsgraph_update_post", follow_camera), ("frame_change_pre", follow_camera))
