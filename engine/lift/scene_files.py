"""Writes and reads the files of a lifted scene: semantic points, instances, anchors, Gaussians and the model."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from scipy.spatial import cKDTree

from .. import result_files
from ..corrections import CorrectedResult
from ..errors import PlgsError
from ..instances.records import SceneObject
from ..instances.segments import mask_extents, outline_of
from ..job import EventWriter, LiftFolder, read_manifest, write_atomically
from ..job.progress import part_of
from ..metrics.calibration import Samples, calibrate
from ..model.baking import bake
from ..model.checking import read_tensors
from ..model.structured import StructuredScene, from_tensors, to_tensors
from ..passes.baked_view import ShownInstances
from ..passes.ply import write_splats
from ..result_files import ANCHORS, INSTANCES, SEMANTIC_POINTS
from ..scene import ClassTable, Progress, Scene, View, distinct_colour, made_ahead, watched
from ..scene.view import NEAR
from ..semantics.point_cloud import SemanticPointCloud
from .judging import evenly
from .preparation import PreparedLift

MODEL = "model.safetensors"
FILLED = 0.3
"""Metres from measured depth within which filled holes count as seen. This keeps dark screens, but not planes that were
extended far beyond anything measured, which stand in rays around the room."""
MOST_JUDGES = 100
"""The most training views that judge the points."""
LIFT_ANEW = "Lift the scene again, into another folder."


def write_scene_files(
    folder: LiftFolder,
    scene: Scene,
    *,
    views: Sequence[View],
    held_back: Sequence[View],
    prepared: PreparedLift,
    seen: NDArray[np.bool_],
    lifted: StructuredScene,
    events: EventWriter,
    names: Mapping[int, str],
    progress: Progress,
) -> None:
    """Write the parts of the result that need no rendering. ``views`` were trained on; masks of views ``held_back``
    calibrate the points' confidence. Only points with ``seen`` bool [N] are written; Gaussians and anchors far from all
    points go only into the model. ``names`` are the objects', by id. Raises OSError if the disk is full."""
    cloud, owner, result = prepared.cloud, prepared.instance_of_point, folder.result_path
    viewpoint = np.mean([frame.camera.centre for frame in scene.train_frames], axis=0)
    judging = watched(evenly(views, MOST_JUDGES), part_of(progress, 0.0, 0.4, 100))
    makers = (
        partial(calibrate, Samples(cloud.xyz, cloud.class_id, cloud.confidence), judging, held_back),
        partial(listed_instances, views, prepared, owner[seen], scene.classes, names),
        partial(bake, lifted, viewpoint, scene.classes.thing_ids),
    )
    likely, instances, (gaussians, anchors) = _all_of(part_of(progress, 0.4, 0.6, 100), *makers)
    points = result_files.SemanticPoints(
        cloud.xyz[seen], cloud.rgb[seen], cloud.class_id[seen], owner[seen], likely(cloud.confidence[seen])
    )
    near = is_within(max(FILLED, 2 * lifted.voxel_size), anchors.xyz, points.xyz)
    anchors = result_files.Anchors(**{name: values[near] for name, values in vars(anchors).items()})
    _all_of(
        part_of(progress, 0.6, 1.0, 100),
        partial(result_files.write_arrays, result / SEMANTIC_POINTS, points),
        partial(result_files.write_instances, result / INSTANCES, scene.classes, instances),
        partial(result_files.write_arrays, result / ANCHORS, anchors),
        lambda: write_splats(result / "gaussians.ply", gaussians.without_floaters(points.xyz)),
        partial(write_model, folder, lifted),
    )
    for name in (SEMANTIC_POINTS, INSTANCES, ANCHORS, "gaussians.ply", MODEL):
        events.artifact(result / name, name.partition(".")[0])


def _all_of(progress: Progress, *makers: Callable[[], Any]) -> list[Any]:
    """Call functions, two at a time, and return what they return. Calls ``progress`` after each."""
    made: list[Any] = []
    for each in made_ahead(makers, lambda make: make()):
        made.append(each)
        progress(len(made), len(makers))
    return made


def is_near_measured(
    cloud: SemanticPointCloud, owner: NDArray[np.int32], measured: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which points to write, bool [N]: those near a point where ``measured`` bool [N], and all points of an
    object that has no such point. Other points lie on planes that hole filling extended far beyond what was measured.
    ``owner`` int32 [N]: each point's object, 0 = none."""
    near = is_within(max(FILLED, 2 * cloud.spacing), cloud.xyz, cloud.xyz[measured])
    return near | np.isin(owner, np.setdiff1d(owner, [0, *np.unique(owner[near])]))


def is_within(reach: float, xyz: NDArray[np.floating], others: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which points ``xyz`` [N, 3] have one of ``others`` [M, 3] within ``reach`` metres, bool [N]."""
    distance, _ = cKDTree(others).query(xyz, distance_upper_bound=reach, workers=-1)
    return np.isfinite(distance)


def shown_by_depth(cloud: SemanticPointCloud, views: Sequence[View], progress: Progress) -> NDArray[np.bool_]:
    """Return which points of the cloud a view's measured depth confirms, bool [N]; others come from hole filling."""
    left = np.arange(len(cloud))
    for view in watched(views, progress):
        left = np.delete(left, view.seen_of(cloud.xyz[left], max(NEAR, cloud.spacing))[0])
        if not len(left):
            break
    progress(1, 1)
    return ~np.isin(np.arange(len(cloud)), left)


def write_model(folder: LiftFolder, lifted: StructuredScene) -> None:
    """Write model.safetensors: the tensors of ``lifted`` and, in the header's "plgs", the facts of `to_tensors`."""
    tensors, facts = to_tensors(lifted)
    contiguous: dict[str, torch.Tensor] = {name: tensor.contiguous() for name, tensor in tensors.items()}
    content = save(contiguous, metadata={"plgs": json.dumps(facts, sort_keys=True)})
    write_atomically(folder.result_path / MODEL, content)


def read_model(folder: LiftFolder) -> StructuredScene:
    """Read the model of a lift, bit for bit as it was written. Raises PlgsError if it is damaged or of unknown form."""
    path = folder.result_path / MODEL
    try:
        tensors, notes = read_tensors(path)
        return from_tensors(tensors, json.loads(notes["plgs"]))
    except (OSError, KeyError, TypeError, ValueError, AttributeError, RecursionError, MemoryError) as error:
        raise PlgsError("model-unreadable", f"the model cannot be read ({error})", path, LIFT_ANEW) from error


def shown_instances(prepared: PreparedLift, names: Mapping[int, str]) -> ShownInstances:
    """Return the names and classes with which a lift that is still running shows its instances."""
    return ShownInstances(_with_numbers(names, prepared.scene), prepared.class_of_instance)


def _with_numbers(names: Mapping[int, str], lifted: StructuredScene) -> dict[int, str]:
    """Return ``names`` by id, with "object 3" and the like for shown ids without a name (slots learnt by training)."""
    return {**names, **{one: f"object {one}" for one in lifted.channels.shown_ids if one not in names}}


def has_one_class_an_object(folder: LiftFolder) -> bool:
    """Whether each object of a finished lift has one class. Raises PlgsError for a bad manifest."""
    settings = read_manifest(folder.result_path).settings
    if "one_class_an_object" not in settings:
        raise PlgsError("kind-missing", "does not say if each object has one class", folder.manifest_path, LIFT_ANEW)
    return bool(settings["one_class_an_object"] and settings.get("objects") != "none")


def corrected_instances(lifted: StructuredScene, corrected: CorrectedResult, *, one_class: bool) -> ShownInstances:
    """Return objects' names and classes as a corrected lift shows them; ``one_class``: whether each has only one."""
    names, class_of = {one.id: one.name for one in corrected.instances}, corrected.class_of
    if corrected.changes_labels:
        one_class, class_of = True, lifted.channels.class_of_shown | class_of
    return ShownInstances(_with_numbers(names, lifted), class_of if one_class else None, corrected.left_unowned)


def instance_names(instances: Sequence[SceneObject], classes: ClassTable) -> dict[int, str]:
    """Return names by id: "chair 1", "chair 2", ... numbered within each class in ascending order of id."""
    names: dict[int, str] = {}
    count: dict[int, int] = {}
    for instance in sorted(instances, key=lambda instance: instance.id):
        count[instance.class_id] = count.get(instance.class_id, 0) + 1
        names[instance.id] = f"{classes[instance.class_id].name} {count[instance.class_id]}"
    return names


def listed_instances(
    views: Sequence[View],
    prepared: PreparedLift,
    instance_of_point: NDArray[np.int32],
    classes: ClassTable,
    names: Mapping[int, str],
) -> list[result_files.Instance]:
    """Return the objects as instances.json lists them, each with its masks and its number of points.
    ``instance_of_point`` int32 [N], 0 = none. Reads each view once."""
    used = {mask.key for instance in prepared.instances for mask in instance.masks}
    extents = {
        (view.name, one): (*extent, outline_of(view.mask, one, extent[1]))
        for view in views
        for one, extent in mask_extents(view.mask).items()
        if (view.name, one) in used
    }
    points = np.bincount(instance_of_point, minlength=max(names, default=0) + 1)
    listed = []
    for instance in prepared.instances:
        x, y, z = instance.box.centre.tolist()
        length, width, height = instance.box.size.tolist()
        segments = tuple(
            result_files.MatchedSegment(
                mask.frame, mask.segment.id, mask.segment.class_id, mask.segment.score,
                mask.cost, mask.agreement, mask.pixels, *extents[mask.key],
            )
            for mask in instance.masks
        )  # fmt: skip
        listed.append(
            result_files.Instance(
                id=instance.id, name=names[instance.id], class_id=instance.class_id,
                class_name=classes[instance.class_id].name, colour=distinct_colour(instance.id), centre=(x, y, z),
                size=(length, width, height), yaw=instance.box.yaw, rotation=instance.box.rotation,
                views=instance.views, score=instance.score, points=int(points[instance.id]), segments=segments,
            )  # fmt: skip
        )
    return listed
