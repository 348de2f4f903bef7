"""The lifted scene as files: the semantic points, the instances, the anchors, the Gaussians, the model."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from ..instances import Evidence, GlobalInstance, MaskExtent, mask_extents
from ..job import EventWriter, JobError, LiftFolder, read_manifest, write_atomically
from ..model.baking import bake
from ..model.structured import StructuredScene, from_tensors, to_tensors
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
        with safe_open(path, "pt") as file:
            facts = json.loads(file.metadata()["plgs"])
            return from_tensors({name: file.get_tensor(name) for name in file.keys()}, facts)  # noqa: SIM118
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        fix = "Lift the scene anew, into another folder."
        raise JobError(f"the model cannot be read ({error})", path, fix) from error


def shown_instances(prepared: PreparedLift, names: Mapping[int, str]) -> ShownInstances:
    """Of a lift that is going on. Slots that only the linear assignment gives a meaning have numbers for names."""
    free = {one: f"object {one}" for one in prepared.scene.channels.shown_ids if one not in names}
    return ShownInstances({**names, **free}, prepared.class_of_instance)


def read_shown_instances(folder: LiftFolder) -> ShownInstances:
    """Of a finished lift. Raises JobError when its manifest cannot be read, OSError."""
    listed = json.loads((folder.result_path / "instances.json").read_text(encoding="utf-8"))["instances"]
    settings = read_manifest(folder.result_path).settings
    if "one_class_an_object" not in settings:
        what, fix = "does not tell whether an object has one class", "Lift the scene anew, into another folder."
        raise JobError(what, folder.manifest_path, fix)
    one_class = settings["one_class_an_object"] and settings.get("objects") != "none"
    class_of = {one["id"]: one["class_id"] for one in listed} if one_class else None
    return ShownInstances({one["id"]: one["name"] for one in listed}, class_of)


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
                segments=tuple(
                    segment_link(item, extents[item.frame][item.segment_id]) for item in instance.evidence
                ),
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
