"""The lifted scene as files: the semantic points, the instances, the anchors, the Gaussians, the model."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save

from ..corrections import CorrectedResult
from ..errors import PlgsError
from ..instances.records import SceneObject
from ..instances.segments import mask_extents, outline_of
from ..job import EventWriter, LiftFolder, read_manifest, write_atomically
from ..metrics.calibration import Samples, calibrate
from ..model.baking import bake
from ..model.structured import StructuredScene, from_tensors, to_tensors
from ..model.tensor_file import read_tensors
from ..passes.baked_view import ShownInstances
from ..passes.ply import write_splats
from ..result_files import (
    ANCHORS,
    INSTANCES,
    SEMANTIC_POINTS,
    Instance,
    MatchedSegment,
    SemanticPoints,
    write_arrays,
    write_instances,
)
from ..scene import ClassTable, Scene, View, distinct_colour
from .judging import evenly
from .preparation import PreparedLift

MODEL = "model.safetensors"
LIFT_ANEW = "Lift the scene again, into another folder."


def write_scene_files(
    folder: LiftFolder,
    scene: Scene,
    views: Sequence[View],
    held_back: Sequence[View],
    prepared: PreparedLift,
    lifted: StructuredScene,
    events: EventWriter,
    names: Mapping[int, str],
) -> None:
    """Write every part of the result that needs no rendering. ``views`` are those it was lifted from, and those that
    were ``held_back`` judge its points; ``names`` are those of the instances. Raises OSError if the disk is full.
    """
    cloud = prepared.cloud
    likely = calibrate(Samples(cloud.xyz, cloud.class_id, cloud.confidence), evenly(views), held_back)
    viewpoint = np.mean([frame.camera.centre for frame in scene.train_frames], axis=0)
    points = SemanticPoints(cloud.xyz, cloud.rgb, cloud.class_id, prepared.instance_of_point, likely(cloud.confidence))
    instances = listed_instances(views, prepared, scene.classes, names)
    sure = shown_by_depth(cloud.xyz, chain(views, held_back))
    write_lifted(folder, scene.classes, viewpoint, points, instances, lifted, events, cloud.xyz[sure])


def shown_by_depth(xyz: NDArray[np.float32], views: Iterable[View]) -> NDArray[np.bool_]:
    """Which of the points [N, 3] the depth of at least one view shows, bool [N]. The others are where a sensor's far
    noise was averaged, beyond walls or in rays around the room."""
    found = np.zeros(len(xyz), np.bool_)
    for view in views:
        left = np.flatnonzero(~found)
        found[left[view.seen_of(xyz[left])[0]]] = True
    return found


def write_lifted(
    folder: LiftFolder,
    classes: ClassTable,
    viewpoint: NDArray[np.float64],
    points: SemanticPoints,
    instances: Sequence[Instance],
    lifted: StructuredScene,
    events: EventWriter,
    seen: NDArray[np.float32] | None = None,
) -> None:
    """Write the same for instances that are listed already. ``viewpoint`` float64 [3] metres: the point from which the
    Gaussians' colours are seen (see ``bake``). Gaussians far from the points ``seen`` [P, 3] (by default all of
    ``points``) are left out of the splats. Raises OSError."""
    result = folder.result_path
    gaussians, anchors = bake(lifted, viewpoint, classes.thing_ids)
    write_arrays(result / SEMANTIC_POINTS, points)
    write_instances(result / INSTANCES, classes, instances)
    write_arrays(result / ANCHORS, anchors)
    write_splats(result / "gaussians.ply", gaussians.without_floaters(points.xyz if seen is None else seen))
    write_model(folder, lifted)
    for name in (SEMANTIC_POINTS, INSTANCES, ANCHORS, "gaussians.ply", MODEL):
        events.artifact(result / name, name.partition(".")[0])


def write_model(folder: LiftFolder, lifted: StructuredScene) -> None:
    """Write model.safetensors: the tensors and, under "plgs" in its header, the facts that make them a scene (JSON)."""
    tensors, facts = to_tensors(lifted)
    contiguous: dict[str, torch.Tensor] = {name: tensor.contiguous() for name, tensor in tensors.items()}
    content = save(contiguous, metadata={"plgs": json.dumps(facts, sort_keys=True)})
    write_atomically(folder.result_path / MODEL, content)


def read_model(folder: LiftFolder) -> StructuredScene:
    """Read what `write_model` wrote, bit for bit. Raises PlgsError if the file is damaged or of an unknown format."""
    path = folder.result_path / MODEL
    try:
        tensors, notes = read_tensors(path)
        return from_tensors(tensors, json.loads(notes["plgs"]))
    except (OSError, KeyError, TypeError, ValueError, AttributeError, RecursionError, MemoryError) as error:
        raise PlgsError(f"the model cannot be read ({error})", path, LIFT_ANEW) from error


def shown_instances(prepared: PreparedLift, names: Mapping[int, str]) -> ShownInstances:
    """The instances of a running lift."""
    return ShownInstances(_with_numbers(names, prepared.scene), prepared.class_of_instance)


def _with_numbers(names: Mapping[int, str], lifted: StructuredScene) -> dict[int, str]:
    """The names, with numbers for slots whose meaning is decided only by the linear assignment or by clusters."""
    return {**names, **{one: f"object {one}" for one in lifted.channels.shown_ids if one not in names}}


def read_shown_instances(folder: LiftFolder, lifted: StructuredScene, corrected: CorrectedResult) -> ShownInstances:
    """The instances of a finished lift, whose model is ``lifted``. Raises PlgsError if the manifest cannot be read, and
    OSError."""
    settings = read_manifest(folder.result_path).settings
    if "one_class_an_object" not in settings:
        raise PlgsError("does not say whether an object has one class", folder.manifest_path, LIFT_ANEW)
    names, class_of = {one.id: one.name for one in corrected.instances}, corrected.class_of
    one_class = settings["one_class_an_object"] and settings.get("objects") != "none"
    if corrected.changes_labels:
        one_class, class_of = True, lifted.channels.class_of_shown | class_of
    return ShownInstances(_with_numbers(names, lifted), class_of if one_class else None)


def instance_names(instances: Sequence[SceneObject], classes: ClassTable) -> dict[int, str]:
    """The names "chair 1", "chair 2", ... in ascending order of id."""
    names: dict[int, str] = {}
    count: dict[int, int] = {}
    for instance in sorted(instances, key=lambda instance: instance.id):
        count[instance.class_id] = count.get(instance.class_id, 0) + 1
        names[instance.id] = f"{classes[instance.class_id].name} {count[instance.class_id]}"
    return names


def listed_instances(
    views: Sequence[View], prepared: PreparedLift, classes: ClassTable, names: Mapping[int, str]
) -> list[Instance]:
    """The matched objects as instances.json lists them, with the masks that they were made from."""
    masks = {view.name: view.mask for view in views}
    extents = {name: mask_extents(mask) for name, mask in masks.items()}
    points = np.bincount(prepared.instance_of_point, minlength=max(names, default=0) + 1)
    listed = []
    for instance in prepared.instances:
        x, y, z = instance.box.centre.tolist()
        length, width, height = instance.box.size.tolist()
        segments = tuple(
            MatchedSegment(
                mask.frame,
                mask.segment.id,
                mask.segment.class_id,
                mask.segment.score,
                mask.cost,
                mask.agreement,
                mask.pixels,
                *extents[mask.frame][mask.segment.id],
                outline_of(masks[mask.frame], mask.segment.id),
            )
            for mask in instance.masks
        )
        listed.append(
            Instance(
                id=instance.id,
                name=names[instance.id],
                class_id=instance.class_id,
                class_name=classes[instance.class_id].name,
                colour=distinct_colour(instance.id),
                centre=(x, y, z),
                size=(length, width, height),
                yaw=instance.box.yaw,
                rotation=instance.box.rotation,
                views=instance.views,
                score=instance.score,
                points=int(points[instance.id]),
                segments=segments,
            )
        )
    return listed
