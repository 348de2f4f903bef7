"""The lifted scene as files: the semantic points, the instances, the anchors, the Gaussians, the model."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from safetensors.torch import save

from ..instances import Evidence, GlobalInstance, MaskExtent, mask_extents
from ..job import EventWriter, JobError, LiftFolder, read_manifest, write_atomically
from ..job.json_file import read_object
from ..model.baking import bake
from ..model.structured import StructuredScene, from_tensors, to_tensors
from ..model.tensor_file import read_tensors
from ..passes import (
    InstanceRecord,
    SegmentLink,
    ShownInstances,
    write_anchors,
    write_instances,
    write_ply,
    write_semantic_points,
)
from ..scene import ClassTable, Scene, View, distinct_colour
from ..scene.classes import LARGEST_ID
from .preparation import PreparedLift


def write_scene_files(
    folder: LiftFolder,
    scene: Scene,
    views: Sequence[View],
    prepared: PreparedLift,
    lifted: StructuredScene,
    events: EventWriter,
    names: Mapping[int, str],
) -> None:
    """Write everything of the result that needs no rendering; ``views`` are those it was lifted from, ``names`` the
    instances'. Raises OSError when the disk is full.
    """
    result = folder.result_path
    cloud = prepared.cloud
    viewpoint = np.mean([frame.camera.centre for frame in scene.train_frames], axis=0)
    gaussians, anchors = bake(lifted, viewpoint, scene.classes.thing_ids)
    write_semantic_points(
        result / "semantic_points.npz",
        xyz=cloud.xyz,
        rgb=cloud.rgb,
        class_id=cloud.class_id,
        instance_id=prepared.instance_of_point,
        confidence=cloud.confidence,
    )
    records = instance_records(views, prepared, scene.classes, names)
    write_instances(result / "instances.json", scene.classes, records)
    write_anchors(result / "anchors.npz", **vars(anchors))
    write_ply(result / "gaussians.ply", gaussians)
    write_model(folder, lifted)
    for name in ("semantic_points.npz", "instances.json", "anchors.npz", "gaussians.ply", "model.safetensors"):
        events.artifact(result / name, name.partition(".")[0])


def write_model(folder: LiftFolder, lifted: StructuredScene) -> None:
    """model.safetensors: the tensors, and in its header under "plgs" what makes a scene of them again (JSON)."""
    tensors, facts = to_tensors(lifted)
    contiguous: dict[str, torch.Tensor] = {name: tensor.contiguous() for name, tensor in tensors.items()}
    content = save(contiguous, metadata={"plgs": json.dumps(facts, sort_keys=True)})
    write_atomically(folder.result_path / "model.safetensors", content)


def read_model(folder: LiftFolder) -> StructuredScene:
    """What `write_model` wrote, bit for bit. Raises JobError for a file that is damaged, or of a format that this
    version does not know."""
    path = folder.result_path / "model.safetensors"
    try:
        tensors, notes = read_tensors(path)
        return from_tensors(tensors, json.loads(notes["plgs"]))
    except (OSError, KeyError, TypeError, ValueError, AttributeError, RecursionError, MemoryError) as error:
        fix = "Lift the scene anew, into another folder."
        raise JobError(f"the model cannot be read ({error})", path, fix) from error


def shown_instances(prepared: PreparedLift, names: Mapping[int, str]) -> ShownInstances:
    """Of a lift that is going on."""
    return ShownInstances(_with_numbers(names, prepared.scene), prepared.class_of_instance)


def _with_numbers(names: Mapping[int, str], lifted: StructuredScene) -> dict[int, str]:
    """Slots that only the linear assignment, or clusters, give a meaning have numbers for names."""
    return {**names, **{one: f"object {one}" for one in lifted.channels.shown_ids if one not in names}}


def read_shown_instances(folder: LiftFolder, lifted: StructuredScene) -> ShownInstances:
    """Of a finished lift, whose model is ``lifted``. Raises JobError when its manifest cannot be read, OSError."""
    path, fix = folder.result_path / "instances.json", "Lift the scene anew, into another folder."
    listed = read_instances(folder)
    settings = read_manifest(folder.result_path).settings
    if "one_class_an_object" not in settings:
        raise JobError("does not tell whether an object has one class", folder.manifest_path, fix)
    try:
        class_of = {_id(one["id"]): _id(one["class_id"]) for one in listed}
        names = {_id(one["id"]): str(one["name"]) for one in listed}
    except (KeyError, TypeError, ValueError) as error:
        raise JobError(f"cannot be read ({error!r})", path, fix) from error
    one_class = settings["one_class_an_object"] and settings.get("objects") != "none"
    return ShownInstances(_with_numbers(names, lifted), class_of if one_class else None)


def read_instances(folder: LiftFolder) -> list[dict[str, Any]]:
    """The objects that instances.json lists, as they stand there. Raises JobError."""
    path, fix = folder.result_path / "instances.json", "Lift the scene anew, into another folder."
    listed: Any = read_object(path, fix).get("instances")
    if not isinstance(listed, list) or not all(isinstance(one, dict) for one in listed):
        raise JobError("lists no instances", path, fix)
    records: list[dict[str, Any]] = listed
    return records


def _id(value: object) -> int:
    if type(value) is not int or not 1 <= value <= LARGEST_ID:
        raise ValueError(f"{value!r} is no id")
    return value


def instance_names(instances: Sequence[GlobalInstance], classes: ClassTable) -> dict[int, str]:
    """ "chair 1", "chair 2", ... in ascending order of id."""
    names: dict[int, str] = {}
    count: dict[int, int] = {}
    for instance in sorted(instances, key=lambda instance: instance.id):
        count[instance.class_id] = count.get(instance.class_id, 0) + 1
        names[instance.id] = f"{classes[instance.class_id].name} {count[instance.class_id]}"
    return names


def instance_records(
    views: Sequence[View], prepared: PreparedLift, classes: ClassTable, names: Mapping[int, str]
) -> list[InstanceRecord]:
    """The matched objects as instances.json lists them, with the masks that made them."""
    extents = {view.name: mask_extents(view.mask) for view in views}
    points = np.bincount(prepared.instance_of_point, minlength=max(names, default=0) + 1)
    records = []
    for instance in prepared.instances:
        x, y, z = instance.box.centre.tolist()
        length, width, height = instance.box.size.tolist()
        records.append(
            InstanceRecord(
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
                segments=tuple(segment_link(item, extents[item.frame][item.segment_id]) for item in instance.evidence),
            )
        )
    return records


def segment_link(item: Evidence, extent: MaskExtent) -> SegmentLink:
    """What the result tells of one mask of an instance."""
    return SegmentLink(
        frame=item.frame,
        segment_id=item.segment_id,
        class_id=item.class_id,
        score=item.score,
        cost=item.cost,
        agreement=item.agreement,
        pixels=item.pixels,
        share=extent.share,
        rectangle=extent.rectangle,
    )
