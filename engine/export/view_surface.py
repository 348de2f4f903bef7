"""Export the lifted scene as a surface for viewing: the room closed and coarse, its objects finer. It takes a fraction
of the time of `mesh`; Blender shows it instead of splats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..job.progress import Progress, part_of, unwatched
from ..scene import watched
from .fusion import GRAZED, Grain, Ints, SmallView, Surface, fuse, triangle_normals
from .mending import LEAST_PIECE, STEEPEST, cut_by_label, open_edges, without_crumbs, without_flakes, without_flaps
from .mesh import DRAWN, MENDED, MOST_INSTANCES, TEXTURED, mended, refuse_none, vertex_labels, views_of, write_surface
from .source import FinishedLift
from .texture import textured

WIDEST, MOST_VIEWS = 320, 60  # maximum width in pixels, and number, of the views that are fused
ROOM, OBJECTS = Grain(0.05, 15.0, 1, times=3, reaches=GRAZED), Grain(0.025, times=3)
ANY_ANGLE = -1.0  # the cosine beyond which the room is left out: its floors and walls may be seen from the side only
HOLE = 0.15  # the largest size in metres, along each axis, of a hole in an object that is closed
WINDOW = 0.5  # the largest size in metres, along each axis, of a hole in the room that is closed
_BESIDE = 0.075  # metres from an object's own surface within which the room's surface drops that object's triangles
_SAME_PLACE = 1e-6  # metres
_AROUND = 0.3  # metres within which an unlabelled vertex takes a neighbour's label
_RIM = 5  # side in pixels of the square around each pixel of an object that belongs to its surface


def export_surface(lift: FinishedLift, output: Path) -> None:
    """Write mesh.ply, the whole surface for viewing, with class_id and instance_id of each vertex, and its pictures.
    Raises PlgsError if it is empty, OSError."""
    views = views_of(lift, WIDEST, MOST_VIEWS, lift.part(0.0, DRAWN))
    surface, label = surface_to_view(views, lift.part(DRAWN, MENDED))
    refuse_none(lift, surface)
    texture = textured(surface, label, views, lift.part(MENDED, TEXTURED)) if lift.has_photos else None
    write_surface(lift, output / "mesh.ply", surface, label, texture)
    lift.progress(1, 1)


def surface_to_view(views: list[SmallView], progress: Progress = unwatched) -> tuple[Surface, Ints]:
    """Return the surface of the views, coarse except for objects, and the label of each vertex, int64 [V]."""
    fusing, labelling, fusing_objects, rest = (part_of(progress, part / 4, (part + 1) / 4, 100) for part in range(4))
    room = _labelled(fuse(views, ROOM, fusing), views, WINDOW, ANY_ANGLE, labelling)
    rim, near = np.ones((_RIM, _RIM), np.uint8), []
    for view in views:  # with only its objects' depth
        shown = cv2.dilate((view.label % MOST_INSTANCES > 0).astype(np.uint8), rim) > 0
        near.append(replace(view, depth=np.where(shown, view.depth, np.float32(0))))
    objects = _labelled(fuse(near, OBJECTS, fusing_objects), views, HOLE, STEEPEST, rest)
    coarse, coarse_label = cut_by_label(*_around(*room, ~_is_double(room, objects)))
    fine, fine_label = cut_by_label(*objects)
    fine, used = fine.of(fine.triangles[fine_label[fine.triangles[:, 0]] % MOST_INSTANCES > 0])
    fine = replace(fine, triangles=fine.triangles + len(coarse.xyz))
    both = Surface(*(np.concatenate(each) for each in zip(vars(coarse).values(), vars(fine).values(), strict=True)))
    both, label = _joined(both, np.concatenate([coarse_label, fine_label[used]]), len(coarse.xyz))
    return both, without_crumbs(both, label, label % MOST_INSTANCES == 0, LEAST_PIECE)


def _labelled(
    surface: Surface, views: list[SmallView], largest: float, steepest: float, progress: Progress
) -> tuple[Surface, Ints]:
    """Return the surface mended, with holes up to ``largest`` metres closed, and its labels [V]; ``steepest`` is that
    of `without_flaps`."""
    if not len(surface.triangles):
        return surface, np.zeros(len(surface.xyz), np.int64)
    label = vertex_labels(surface.xyz, watched(views, progress), ROOM.times)
    surface, label = without_flakes(*without_flaps(surface, label, views, steepest))
    if (label > 0).any() and (label == 0).any():
        far, at = cKDTree(surface.xyz[label > 0]).query(surface.xyz[label == 0], distance_upper_bound=_AROUND)
        label[label == 0] = np.append(label[label > 0], 0)[at]  # 0 where none is near
    return mended(surface, label, largest, lambda *_: progress(len(views), len(views)))


def _is_double(room: tuple[Surface, Ints], objects: tuple[Surface, Ints]) -> NDArray[np.bool_]:
    """Return which vertices of the surface ``room`` show an object that ``objects`` has, too, bool [V]."""
    double = room[1] % MOST_INSTANCES > 0
    is_rim, triangles = np.zeros(len(objects[0].xyz) + 1, np.bool_), objects[0].triangles
    is_rim[open_edges(triangles)] = is_rim[-1] = True  # and beyond the rim there is only the room's
    is_rim[triangles[is_rim[triangles].any(axis=1)]] = True  # which overlaps a little
    _, nearest = cKDTree(objects[0].xyz).query(room[0].xyz[double], distance_upper_bound=_BESIDE)
    double[double] = ~is_rim[nearest]
    return double


def _joined(surface: Surface, label: Ints, coarse: int) -> tuple[Surface, Ints]:
    """Join each object's rim among the first ``coarse`` vertices to its rim among the others where that is _BESIDE.
    Vertices of other labels at the same places move along. Return the surface and its labels [V]."""
    rim = np.unique(open_edges(surface.triangles))
    rim = rim[label[rim] % MOST_INSTANCES > 0]
    coarse_rim, fine_rim = rim[rim < coarse], rim[rim >= coarse]
    apart = np.column_stack([surface.xyz, np.unique(label, return_inverse=True)[1]])  # labels are a metre apart
    away, nearest = cKDTree(apart[fine_rim]).query(apart[coarse_rim], distance_upper_bound=_BESIDE)
    moved, goal = coarse_rim[np.isfinite(away)], fine_rim[nearest[np.isfinite(away)]]
    away, copy = cKDTree(surface.xyz[moved]).query(surface.xyz[:coarse], distance_upper_bound=_SAME_PLACE)
    number, moves = np.arange(len(surface.xyz)), np.flatnonzero(np.isfinite(away))
    place = number.copy()
    number[moved], place[moves] = goal, goal[copy[moves]]
    xyz, corners = surface.xyz[place], np.sort(place[surface.triangles], axis=1)[::-1]
    kept = surface.triangles[::-1][np.unique(corners, axis=0, return_index=True)[1]]  # one in a place: an object's own
    turned = (triangle_normals(surface.xyz, kept) * triangle_normals(xyz, kept)).sum(axis=1) <= 0  # or collapsed
    joined, used = replace(surface, xyz=xyz).of(number[kept[~turned]])
    return joined, label[used]


def _around(surface: Surface, label: Ints, kept: NDArray[np.bool_]) -> tuple[Surface, Ints]:
    """Return the triangles that have a corner ``kept`` [V]. Their other corners get the label of a kept one."""
    is_kept = kept[surface.triangles]
    triangles, is_kept = (each[is_kept.any(axis=1)] for each in (surface.triangles, is_kept))
    first = np.take_along_axis(triangles, is_kept.argmax(axis=1)[:, None], axis=1)
    label = label.copy()
    label[triangles[~is_kept]] = label[np.broadcast_to(first, triangles.shape)[~is_kept]]
    part, used = surface.of(triangles)
    return part, label[used]
