"""Renders a lift's frames: writes passes and previews of the requested frames, and scores the held-out frames."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..corrections import CorrectedResult
from ..corrections.fills import OPACITY
from ..corrections.relabelling import GONE
from ..diagnosis import Finding
from ..errors import PlgsError
from ..job import EventWriter, LiftFolder, write_atomically
from ..job.progress import StageReporter
from ..job.report import read_metrics
from ..job.system import peak_bytes
from ..metrics.calibration import UNCALIBRATED, Calibration
from ..metrics.report import LIFTED, PredictedView, Report, add_input_masks
from ..model.neural_gaussians import ClipRange
from ..model.render import render_bands
from ..model.scene_labels import SceneLabels, shown_labels
from ..model.settling import gaussian_centres
from ..model.structured import GaussianLabels, LabelChannels, SceneFill, StructuredScene
from ..passes.baked_view import BakedView, ShownInstances, bake_view, joined
from ..passes.exr import NOTHING_SHOWN, ShownFrame, write_exr
from ..passes.layers import FROM_LABELS, PanopticLayers, decide
from ..passes.panorama import panorama
from ..passes.previews import MOST_ROWS, SheetRow, colour_picture, preview_paths, write_contact_sheet, write_previews
from ..scene import Camera, ClassTable, Frame, Scene, Size, View, counted, evenly_spread, size_within
from ..scene_of_lift import another, have_classes_changed, names_of_frames, opened_scene, refuse_other_pictures
from .device import be_repeatable
from .judging import judge
from .scene_files import LIFT_ANEW, corrected_instances, has_one_class_an_object, read_model

CORRECTIONS_NOTE = "plgs/corrections"
"""Attribute in the header of a view that shows corrections: their fingerprint."""
REMOVED_NOTE = "plgs/removed"
"""Attribute in the header of a view from which objects were removed: their names."""
DIGITS = 4
"""Minimum number of digits of a frame's number in the names of its files."""
_NUMBERED = re.compile(r"(?s)((?:.*[_-]|.*\D\.)?)(\d{1,9})")
"""A name that is a number or ends in one, except for a decimal such as the seconds of a timestamp."""


class FrameBaker:
    """Renders views of a lifted scene and writes their passes (the layers of an EXR file)."""

    def __init__(
        self, classes: ClassTable, lifted: StructuredScene, instances: ShownInstances, corrections: str = "",
        calibration: Calibration = UNCALIBRATED, removed: Sequence[str] = (),
    ) -> None:  # fmt: skip
        """``corrections``: the fingerprint of the corrections that ``lifted`` and ``instances`` include; ``removed``:
        the names of objects removed by these. ``calibration`` turns blended class shares into probabilities."""
        self.corrections, self.calibration, self.removed = corrections, calibration, removed
        self.classes, self.lifted, self.labels = classes, lifted, shown_labels(lifted)
        self.instances, self.colours = instances, instances.colours

    def render(self, camera: Camera, clip: ClipRange | None = None) -> BakedView:
        """Render the model from ``camera``, at its size, within the depths ``clip``. No frame's input mask is used."""
        if camera.projection == "equirectangular":
            along = (clip or ClipRange())._replace(along_rays=True)
            return panorama(camera, lambda face: self.render(face, along))
        bands = render_bands(self.lifted, camera, self.labels, clip=clip)
        view = bake_view(bands, camera, self.classes, self.instances)
        return replace(view, layers=view.layers._replace(confidence=self.calibration(view.layers.confidence)))

    @property
    def notes(self) -> dict[str, str]:
        """Return the header entries that tell of corrections, text by name; empty if there are no corrections."""
        notes = {CORRECTIONS_NOTE: self.corrections, REMOVED_NOTE: ", ".join(self.removed)}
        return {name: text for name, text in notes.items() if text}

    def layers(self, camera: Camera, clip: ClipRange | None = None, wanted: Collection[str] = ()) -> PanopticLayers:
        """Render the ``wanted`` layers (none: all but Cryptomatte) at depths in ``clip``; faster without labels."""
        layers = self.decided(camera, clip, wanted)
        return layers._replace(confidence=self.calibration(layers.confidence))

    def decided(self, camera: Camera, clip: ClipRange | None = None, wanted: Collection[str] = ()) -> PanopticLayers:
        """Render the ``wanted`` layers (none: all), with classes' blended shares as confidence, not calibrated ones."""
        scene, labels = self.lifted, self.labels
        if wanted and FROM_LABELS.isdisjoint(wanted):
            gaussians = len(scene.anchors) * scene.anchors.gaussians_per_anchor
            gaussians += 0 if scene.fill is None else len(scene.fill.means)
            scene, labels = replace(scene, channels=LabelChannels((), ())), SceneLabels(torch.empty(gaussians, 0))
        bands = render_bands(scene, camera, labels, clip=clip, want_surface=not wanted or "depth" in wanted)
        shown = self.instances
        return joined([decide(band, self.classes, shown.class_of, wanted, shown.unowned) for band in bands])

    def write(
        self, folder: LiftFolder, name: str, view: BakedView, events: EventWriter,
        *, notes: Mapping[str, str] | None = None, layers: Collection[str] = (), shown: ShownFrame = NOTHING_SHOWN,
    ) -> None:  # fmt: skip
        """Write passes/<name>.exr with ``notes`` and ``shown`` (frame number, rate) in its header and ``layers`` from
        FURTHER_LAYERS, write three preview pictures (see `baked_files`), and report all files as events."""
        passes, _, semantic, _ = baked_files(folder, name)
        write_exr(passes, view, notes={**(notes or {}), **self.notes}, layers=layers, shown=shown)
        write_previews(folder.previews_path, name, view.layers, self.classes, self.colours)
        events.artifact(passes, "pass")
        events.preview(semantic)


def read_baker(folder: LiftFolder, classes: ClassTable, corrected: CorrectedResult) -> FrameBaker:
    """Return a FrameBaker for a finished lift with its corrections. Raises PlgsError for damaged files, OSError."""
    lifted, one_class = read_model(folder), has_one_class_an_object(folder)
    path = folder.result_path / "metrics.json"
    judges: Any = read_metrics(folder).get("masks_as_judges") if path.is_file() else None
    found = judges.get("calibration") if isinstance(judges, dict) else None
    try:  # a lift of an earlier version has none
        calibration = Calibration(**found) if isinstance(found, dict) else UNCALIBRATED
    except (TypeError, ValueError) as error:
        raise PlgsError("calibration-damaged", f"the calibration cannot be used ({error})", path, LIFT_ANEW) from error
    return corrected_baker(lifted, classes, corrected, one_class=one_class, calibration=calibration)


def corrected_baker(
    lifted: StructuredScene, classes: ClassTable, corrected: CorrectedResult, *, one_class: bool,
    calibration: Calibration = UNCALIBRATED,
) -> FrameBaker:  # fmt: skip
    """Return a FrameBaker for the scene ``lifted``, on the CPU, with its corrections. ``one_class``: whether each
    object has one class."""
    scene = corrected_scene(lifted, corrected)
    shown = corrected_instances(scene, corrected, one_class=one_class)
    removed = [one.name for one in corrected.removed]
    return FrameBaker(classes, scene, shown, corrected.fingerprint, calibration, removed)


def baked_files(folder: LiftFolder, frame: str) -> tuple[Path, Path, Path, Path]:
    """Return the paths of a baked frame's files: the EXR passes, and the previews of colour, classes and instances."""
    colour, semantic, instance = preview_paths(folder.previews_path, frame)
    return folder.passes_path / f"{frame}.exr", colour, semantic, instance


def names_of_files(folder: LiftFolder) -> dict[str, str]:
    """Return file names by frame name. Numbers are zero-padded to the longest, at least DIGITS digits ("3": "0003");
    all frames keep their names if two would clash. Empty for unknown frames. Raises PlgsError for a damaged
    scene.json."""
    found = {name: _NUMBERED.fullmatch(name) for name in names_of_frames(folder)}
    digits = max([DIGITS, *(len(match[2]) for match in found.values() if match)])
    padded = {name: match[1] + match[2].zfill(digits) if match else name for name, match in found.items()}
    is_clear = len({file.casefold() for file in padded.values()}) == len(padded)
    return padded if is_clear else {name: name for name in padded}


def predicted(layers: PanopticLayers) -> PredictedView:
    """Convert a rendered view to the form that metrics take."""
    return PredictedView(
        layers.semantic, layers.instance, colour_picture(layers), layers.depth, alpha=layers.combined[..., 3]
    )


def bake_and_evaluate(
    folder: LiftFolder,
    scene: Scene,
    baker: FrameBaker,
    wanted: Sequence[Frame],
    *,
    shown: FrameBaker,
    views: Sequence[View],
    held_back: Sequence[View],
    events: EventWriter,
    stages: StageReporter,
    findings: Sequence[Finding] = (),
    scored: Size | None = None,
) -> None:
    """Compare the lift with the masks of its training ``views`` and of the ``held_back`` views, and calibrate ``baker``
    and ``shown`` by it; bake the frames ``wanted`` by ``shown``, which may have corrections; score the held-out frames
    by ``baker`` (reduced to fit ``scored`` if they are not baked); write the contact sheet and metrics.json,
    ``findings`` included. Ground truth is used for metrics.json only. Raises Cancelled, OSError; PlgsError for bad
    files of the scene."""
    baked_names = {frame.name for frame in wanted}
    frames = wanted or scene.test_frames  # wanted frames include the held-out ones, or are empty
    on_sheet = {frame.name for frame in evenly_spread(scene.test_frames, MOST_ROWS)}
    report, rows, seconds, names = Report(scene.classes), [], [], names_of_files(folder)
    with stages.stage("evaluate") as progress:
        add_input_masks(report, scene, None if wanted else scored)
        seen = partial(baker.decided, wanted=("semantic", "confidence"))
        judgement = judge(seen, scene, views, held_back, progress=progress, scratch=folder.path)
        judgement.report(events)
        baker.calibration = shown.calibration = judgement.calibration
    with stages.stage("bake", "" if wanted else "Scoring the held-out frames") as progress:
        for done, frame in enumerate(frames, start=1):
            began, is_baked = time.monotonic(), frame.name in baked_names
            size = frame.size if scored is None or is_baked else size_within(frame.size, scored)
            camera = frame.camera.resized(*size)
            view = shown.render(camera) if is_baked else None
            layers = baker.layers(camera) if view is None else view.layers
            seconds.append(time.monotonic() - began)
            if view is not None:
                shown.write(folder, names.get(frame.name, frame.name), view, events)
                if shown is not baker and (frame.held_out or frame.name in on_sheet):
                    layers = baker.layers(camera)
            if frame.held_out:
                report.add(LIFTED, frame, predicted(layers))
            if frame.name in on_sheet:
                photo, mask = frame.read_colour(size), frame.mask(size)
                rows.append(SheetRow(frame.name, photo, mask.class_map(), layers))
            del view, layers  # frees their memory before the next are made
            progress(done, len(frames))
        if rows:
            write_contact_sheet(folder.previews_path / "contact_sheet.png", rows, scene.classes, baker.colours)
            events.preview(folder.previews_path / "contact_sheet.png")
        metrics = {
            **report.to_json(), "left_out": counted(scene.left_out), "masks_as_judges": judgement.to_json(),
            "findings": [finding.as_json() for finding in findings],
        }  # fmt: skip
        write_atomically(folder.result_path / "metrics.json", json.dumps(metrics, indent=1) + "\n")
        fps = 1 / median(seconds) if seconds and median(seconds) > 0 else None
        events.metric("run", {"fps": fps, "peak_bytes": peak_bytes()})


def score_corrected(
    folder: LiftFolder, corrected: CorrectedResult, progress: Callable[[int, int], object]
) -> dict[str, object]:
    """Return a finished lift's metrics with its corrections, as in metrics.json. Raises PlgsError if its scene has
    changed or is gone, OSError."""
    be_repeatable()
    scene, metrics = opened_scene(folder), read_metrics(folder)
    names = metrics.get("test_frames")
    if isinstance(names, list):  # the lift left out held-out frames that cannot be read
        scene = replace(scene, frames=tuple(frame for frame in scene.frames if frame.name in names))
        if trained := [frame.name for frame in scene.train_frames]:
            raise another(f"{trained[0]} is not held out", scene)
    if have_classes_changed(folder, scene):
        raise another("its classes differ", scene)
    refuse_other_pictures(folder, replace(scene, frames=scene.test_frames))
    baker, report = read_baker(folder, scene.classes, corrected), Report(scene.classes)
    for done, frame in enumerate(scene.test_frames, start=1):
        report.add(LIFTED, frame, predicted(baker.render(frame.camera).layers))
        progress(done, len(scene.test_frames))
    add_input_masks(report, scene)
    return {**report.to_json(), "left_out": metrics.get("left_out", []), "findings": metrics.get("findings", [])}


KEPT = 6
"""How many labels are kept per Gaussian, to correct them, if its labels come from the decoders."""
CHUNK = 16384
"""Anchors that are decoded at once."""


@torch.no_grad()
def corrected_scene(scene: StructuredScene, corrected: CorrectedResult) -> StructuredScene:
    """Return the scene with the classes and objects of ``corrected``, or the same scene if no edit changes labels. Each
    Gaussian keeps only its likeliest labels, as after voting, and each object has one class."""
    if not corrected.changes_labels:
        return scene
    channels = scene.channels
    codes = np.array([*(-one for one in channels.class_ids), *channels.shown_ids], np.int32)
    voted = voted_labels(scene, corrected)
    means, k = gaussian_centres(scene.anchors), voted.label.shape[1]
    before = codes[voted.label.numpy().astype(np.int64)]
    after = np.stack([corrected.relabelling.of(means, before[:, column]) for column in range(k)], axis=1)
    share, fill = voted.share, None
    if corrected.relabelling.fills:
        fill, of_fill = _fill_of_scene(after, share.numpy(), corrected)
        after = np.concatenate([_without_gone(after), of_fill])
        share = torch.cat([share, torch.nn.functional.one_hot(torch.zeros(len(of_fill), dtype=torch.int64), k).float()])
    kinds, made = ({one.id: one.class_id for one in known} for known in (corrected.instances, corrected.made))
    # An object without any point keeps its slot and the class that the engine decided on.
    own = channels.class_of_shown or {one: made.get(one, channels.class_ids[0]) for one in channels.shown_ids}
    shown = sorted({*np.unique(after[after > 0]).tolist(), *(one for one in kinds if one in own)})
    of_shown = [kinds.get(one, own.get(one, 0)) for one in shown]
    class_ids = tuple(sorted({*channels.class_ids, *of_shown, *(-after[after < 0]).tolist()} - {0}))
    changed = LabelChannels(class_ids, tuple(shown), tuple(of_shown))
    index_of = {code: index for index, code in enumerate([*(-one for one in class_ids), *shown])}
    known = np.array(sorted(index_of), np.int32)
    label = np.array([index_of[code] for code in known.tolist()], np.int16)[np.searchsorted(known, after)]
    return replace(scene, channels=changed, voted=GaussianLabels(torch.from_numpy(label), share), fill=fill)


def voted_labels(scene: StructuredScene, corrected: CorrectedResult) -> GaussianLabels:
    """Return the labels of all Gaussians, as the views voted or, if ``scene`` has no votes, from the decoders."""
    if scene.voted is not None:
        return scene.voted
    labels, shares = zip(*_likeliest_of_chunks(scene, corrected), strict=True)
    return GaussianLabels(torch.cat(labels), torch.cat(shares))


OWNED = 0.3
"""A Gaussian of whose labels a larger share than this belongs to removed objects is removed as well."""


def _fill_of_scene(
    after: NDArray[np.int32], share: NDArray[np.float32], corrected: CorrectedResult
) -> tuple[SceneFill, NDArray[np.int32]]:
    """Return the Gaussians that replace removed objects, and their labels int32 [P, K], of which only the first counts.
    ``after`` and ``share`` [G, K] are the corrected labels of the scene's own Gaussians and their shares."""
    parts, labels = [], []
    for first, fill in corrected.relabelling.fills:
        label = corrected.relabelling.of(fill.xyz, fill.label, first)
        stays = label != GONE
        opaque = np.full(len(label), OPACITY, np.float32)
        columns = (fill.xyz, fill.scale, fill.turn, opaque, fill.rgb, fill.guessed)
        parts.append([column[stays] for column in columns])
        labels.append(label[stays])
    gone = np.where(after == GONE, share, 0.0).sum(axis=1) > OWNED * np.maximum(share.sum(axis=1), 1e-9)
    drawn = (torch.from_numpy(np.concatenate(each)) for each in zip(*parts, strict=True))
    label = np.concatenate(labels)
    return SceneFill(torch.from_numpy(gone), *drawn), np.repeat(label[:, None], after.shape[1], axis=1)


def _without_gone(after: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return labels of G Gaussians, [G, K], likeliest first, with removed objects replaced by the next label."""
    first = np.take_along_axis(after, (after != GONE).argmax(axis=1)[:, None], axis=1)
    other = after[after != GONE][:1] if (after != GONE).any() else np.zeros(1, np.int32)
    return np.where(after != GONE, after, np.where(first != GONE, first, other))


def _likeliest_of_chunks(
    scene: StructuredScene, corrected: CorrectedResult
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield the likeliest labels of each Gaussian by the decoders, and their shares, for CHUNK anchors at a time. If
    classes and objects are decided per pixel, an object can show only where a thing does, so objects get at most the
    share of the things. Labels that depend on the viewpoint are evaluated from the middle of the scene."""
    anchors, decoders, channels = scene.anchors, scene.decoders, scene.channels
    centre, things = anchors.position.mean(dim=0), corrected.classes.thing_ids
    is_thing = torch.tensor([one in things for one in channels.class_ids])
    for rows in torch.arange(len(anchors)).split(CHUNK):
        feature, position = anchors.feature[rows], anchors.position[rows]
        outputs = decoders.label_logits(feature, decoders.view_input(feature, position, centre))
        classes, slots = (logits.flatten(0, 1).softmax(dim=1) for logits in outputs)
        instances = slots[:, list(channels.instance_slots)]
        owned = instances.sum(dim=1, keepdim=True)
        if channels.class_of_slot:
            alone = classes * (1 - owned)
        else:
            instances = instances * (classes * is_thing).sum(dim=1, keepdim=True)
            alone = torch.where(is_thing, classes * (1 - owned), classes)
        every = torch.cat([alone, instances], dim=1)
        share, label = every.topk(min(KEPT, every.shape[1]), dim=1)
        yield label.to(torch.int16), share
