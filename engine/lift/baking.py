"""Rendering the frames: passes and previews of those asked for, figures of those held out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

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
    preview_paths,
    write_contact_sheet,
    write_exr,
    write_previews,
)
from ..scene import Frame, Scene
from ..train.progress import StageReporter
from .scene_files import ShownInstances


class FrameBaker:
    """Renders frames of a lifted scene and turns them into layers."""

    def __init__(self, scene: Scene, lifted: StructuredScene, instances: ShownInstances) -> None:
        self.scene, self.lifted, self.labels = scene, lifted, scene_labels(lifted)
        self.instances, self.colours = instances, instances.colours

    def render(self, frame: Frame) -> tuple[PanopticRendering, PanopticLayers]:
        """The model seen from a frame's camera at the frame's own size: never anything of its mask."""
        rendering = render_view(self.lifted, frame.camera, self.labels)
        return rendering, decide(rendering, self.scene.classes, self.instances.class_of)

    def write(
        self,
        folder: LiftFolder,
        frame: Frame,
        rendering: PanopticRendering,
        layers: PanopticLayers,
        events: EventWriter,
    ) -> None:
        """passes/<frame>.exr and the three previews (`baked_files`), and tell of them."""
        passes, _, semantic, _ = baked_files(folder, frame.name)
        write_exr(passes, layers, rendering, self.scene.classes, self.instances.names)
        write_previews(folder.previews_path, frame.name, layers, self.scene.classes, self.colours)
        events.artifact(passes, "pass")
        events.preview(semantic)


def baked_files(folder: LiftFolder, frame: str) -> tuple[Path, Path, Path, Path]:
    """The files of a baked frame: passes, and previews of colour, classes and instances."""
    colour, semantic, instance = preview_paths(folder.previews_path, frame)
    return folder.passes_path / f"{frame}.exr", colour, semantic, instance


def predicted(layers: PanopticLayers) -> PredictedView:
    """A lifted view as the report scores it."""
    return PredictedView(
        layers.semantic, layers.instance, colour_picture(layers), layers.depth, alpha=layers.combined[..., 3]
    )


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
                baker.write(folder, frame, rendering, layers, events)
            if frame.held_out:
                report.add(LIFTED, frame, predicted(layers))
            if frame.name in shown:
                photo, mask = frame.read_colour(frame.size), frame.mask(frame.size)
                rows.append(SheetRow(frame.name, photo, mask.class_map(), layers))
            progress(done, len(frames))
        if rows:
            write_contact_sheet(folder.previews_path / "contact_sheet.png", rows, scene.classes, baker.colours)
            events.preview(folder.previews_path / "contact_sheet.png")
    with stages.stage("evaluate") as progress:
        add_rivals(report, scene, progress)
        write_atomically(folder.result_path / "metrics.json", json.dumps(report.to_json(), indent=1) + "\n")
