"""Rendering the frames: passes and previews of those asked for, figures of those held out."""

from __future__ import annotations

import json
from collections.abc import Sequence

from ..job import EventWriter, LiftFolder, write_atomically
from ..metrics.report import LIFTED, PredictedView, Report, add_rivals
from ..model.render import render_view
from ..model.rendering import PanopticRendering
from ..model.scene_labels import scene_labels
from ..model.structured import StructuredScene
from ..passes import (
    PanopticLayers,
    SheetRow,
    chosen,
    colour_picture,
    decide,
    write_contact_sheet,
    write_exr,
    write_previews,
)
from ..scene import Frame, Scene, distinct_colour
from ..train.preparation import PreparedLift
from ..train.progress import StageReporter
from .scene_files import instance_names


class FrameBaker:
    """Renders frames of a lifted scene and turns them into layers."""

    def __init__(self, scene: Scene, prepared: PreparedLift, lifted: StructuredScene) -> None:
        self.scene, self.lifted, self.labels = scene, lifted, scene_labels(lifted)
        self.names = instance_names(prepared.instances, scene.classes)
        self.colours = {instance.id: distinct_colour(instance.id) for instance in prepared.instances}
        self.class_of_instance = prepared.class_of_instance

    def render(self, frame: Frame) -> tuple[PanopticRendering, PanopticLayers]:
        """The model seen from a frame's camera at the frame's own size: never anything of its mask."""
        rendering = render_view(self.lifted, frame.camera, self.labels)
        return rendering, decide(rendering, self.scene.classes, self.class_of_instance)

    def write(self, folder: LiftFolder, frame: Frame, rendering: PanopticRendering, layers: PanopticLayers) -> None:
        """passes/<frame>.exr and the three previews."""
        write_exr(folder.passes_path / f"{frame.name}.exr", layers, rendering, self.scene.classes, self.names)
        write_previews(folder.previews_path, frame.name, layers, self.scene.classes, self.colours)


def bake_and_evaluate(
    folder: LiftFolder, baker: FrameBaker, wanted: Sequence[Frame], events: EventWriter, stages: StageReporter
) -> None:
    """Bake ``wanted``, score the held-out frames, and write contact sheet and metrics.json.

    Ground truth goes into metrics.json alone. Raises Cancelled, SceneError, OSError.
    """
    scene = baker.scene
    baked_names = {frame.name for frame in wanted}
    frames = [frame for frame in scene.frames if frame.held_out or frame.name in baked_names]
    shown = {scene.test_frames[index].name for index in chosen(len(scene.test_frames))}
    report, rows = Report(scene.classes), []
    with stages.stage("bake") as progress:
        for done, frame in enumerate(frames, start=1):
            rendering, layers = baker.render(frame)
            if frame.name in baked_names:
                baker.write(folder, frame, rendering, layers)
                events.artifact(folder.passes_path / f"{frame.name}.exr", "pass")
                events.preview(folder.previews_path / f"{frame.name}_semantic.png")
            if frame.held_out:
                report.add(LIFTED, frame, PredictedView(layers.semantic, layers.instance, colour_picture(layers)))
            if frame.name in shown:
                photo, mask = frame.read_colour(frame.size), frame.read_mask(frame.size)
                rows.append(SheetRow(frame.name, photo, mask.class_map(), layers))
            progress(done, len(frames))
        if rows:
            write_contact_sheet(folder.previews_path / "contact_sheet.png", rows, scene.classes, baker.colours)
            events.preview(folder.previews_path / "contact_sheet.png")
    with stages.stage("evaluate") as progress:
        add_rivals(report, scene, progress)
        write_atomically(folder.result_path / "metrics.json", json.dumps(report.to_json(), indent=1) + "\n")
