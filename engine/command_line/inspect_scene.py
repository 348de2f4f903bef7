"""The command ``inspect``: report what is in a scene, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from ..diagnosis import Diagnosis, diagnose, write_findings, write_mended
from ..errors import PlgsError
from ..job import EventWriter, StopSignal
from ..job.prediction import USUAL_CLASSES, USUAL_MASKS, machine_slowness, predict
from ..job.progress import StageProgress
from ..presets.preset import PRESETS
from ..scene import Scene, SceneReport, Size, counted, open_asked, report_of, splits_path, survey_scene
from ..scene_source import SceneSource

OPENED = 0.25
"""Share of the time in which a scene is opened; then all of its files are looked at."""


def inspect_scene(
    asked: SceneSource,
    events: EventWriter,
    stop: StopSignal,
    *,
    preset: str | None = None,
    findings: Path | None = None,
    fix: Path | None = None,
) -> None:
    """Decode every frame, and answer with what is there and what is wrong with it. The text also predicts what a lift
    with ``preset`` would take. ``findings`` is a folder for findings and their pictures, ``fix`` a new folder for the
    corrected scene. Raises PlgsError for the first fault for which a lift would refuse the scene, after answering with
    findings that may explain it."""
    if fix is not None and fix.exists():
        raise PlgsError("exists", "the folder for the mended scene already exists", fix, "Name a new one.")
    events.stage("inspect", 1, 2, "Looking at the scene")
    progress = StageProgress("inspect", events, stop)
    scene = opened = open_asked(asked, progress.part(0.0, OPENED))
    report, refusal = None, None
    try:
        survey = survey_scene(scene, progress.part(OPENED, 1.0))
        report, scene = report_of(survey), survey.scene
    except PlgsError as error:
        refusal = error
    stop.check()
    events.stage("diagnose", 2, 2, "Measuring what is wrong")
    progress = StageProgress("diagnose", events, stop)
    diagnosis = diagnose(scene, progress) if refusal is None else _explanation(scene, refusal)
    stop.check()
    found = diagnosis.as_json() if findings is None else write_findings(diagnosis, findings)
    lines = [] if report is None else list(_lines(report))
    lines += _finding_lines(diagnosis, findings)
    if preset is not None and report is not None:
        lines.append(_prediction(report, preset))
    harm = None
    if fix is not None and diagnosis.mending.is_needed:
        harm = write_mended(scene, diagnosis, fix)
        mended = [finding.cause for finding in diagnosis.findings if finding.is_mended]
        done = f"{', '.join(mended)}: {fix}" if harm is None else f"nothing: {harm}; no folder was written"
        lines.append(f"mended    {done}")
    elif fix is not None and refusal is None:
        lines.append("mended    nothing: no finding can be mended with certainty, and no folder was written")
    answer: dict[str, object] = {} if report is None else {**asdict(report), "left_out": counted(report.left_out)}
    # A splits.json with all frames, and its path.
    split: dict[str, object] = {"path": str(splits_path(opened.folder))}
    for part, held_out in (("train", False), ("test", True)):
        split[part] = [frame.name for frame in opened.frames if frame.held_out == held_out]
    events.answer({**answer, "diagnosis": found, "split": split}, "\n".join(lines))
    if refusal is not None and (fix is None or harm is not None or not diagnosis.mending.is_needed):
        raise refusal


def _explanation(scene: Scene, refusal: PlgsError) -> Diagnosis:
    """Return the diagnosis that explains why a scene is refused. Raises ``refusal`` itself if none does."""
    try:
        diagnosis = diagnose(scene)
    except PlgsError:
        raise refusal from None
    if not any(finding.severity == "wrong" for finding in diagnosis.findings):
        raise refusal
    return diagnosis


def _finding_lines(diagnosis: Diagnosis, folder: Path | None) -> Iterator[str]:
    views = diagnosis.agreement
    if views is not None:
        yield (
            f"views     {views.share:.0%} of what two frames see lies at one place in both, with a median error of "
            f"{views.error:.2%} ({diagnosis.looked} of {diagnosis.frames} frames compared)"
        )
    if diagnosis.untested:
        axes = " and ".join(diagnosis.untested)
        yield f"untested  drift along {axes}: frames far apart in time share too few surfaces that face {axes}"
    if not diagnosis.findings:
        yield "findings  none"
    for finding in diagnosis.findings:
        yield f"{finding.severity}: {finding.cause}: {finding.text}"
        yield f"       mend: {finding.option}"
    if folder is not None and diagnosis.findings:
        yield f"pictures  {folder}"


def _lines(report: SceneReport) -> Iterator[str]:
    yield f"scene     {report.folder}"
    yield f"format    {report.format}"
    yield f"frames    {report.train_frames} for training, {report.test_frames} held out"
    yield f"truth     {report.ground_truth_frames or 'no'} frames"
    yield f"colour    {_sizes(report.colour_sizes)}"
    if report.depth_range is None:
        yield "depth     none: a lift is not possible"
    else:
        near, middle, far = report.depth_range
        yield f"depth     {_sizes(report.depth_sizes)}, {near:.2f} to {far:.2f} m, half within {middle:.2f} m"
    if report.segments_per_frame is None:
        yield "masks     none: a lift is not possible"
    else:
        fewest, median, most = report.segments_per_frame
        yield f"masks     {_sizes(report.mask_sizes)}, {fewest} to {most} segments per frame, with a median of {median}"
    if report.sparse_points:
        yield f"points    {report.sparse_points} of the reconstruction"
    yield "cameras   within " + " x ".join(f"{side:.2f}" for side in report.extent) + " m"
    if report.classes:
        yield f"classes   {len(report.classes)}; {report.void_share:.1%} of the pixels have none"
    for entry in sorted(report.classes, key=lambda entry: -entry.share):
        yield f"  {entry.id:4d}  {entry.name:<24} {'thing' if entry.is_thing else 'stuff'} {entry.share:7.1%}"
    if report.left_out:
        yield "left out  " + ", ".join(f"{len(each.names)} without {each.lacks}" for each in report.left_out)
    for each in report.inferred:
        yield f"inferred{'?' if each.is_doubtful else ' '} {each.about}: {each}"
    for warning in report.warnings:
        yield f"warning: {warning}"


def _prediction(report: SceneReport, preset: str) -> str:
    """Return a line such as "preview about 3 min and 1.0 GB of memory"."""
    size, slowness = report.colour_sizes[0][0], machine_slowness()
    masks = USUAL_MASKS if report.segments_per_frame is None else report.segments_per_frame[1]
    counts, classes = (report.train_frames, report.test_frames), len(report.classes) or USUAL_CLASSES
    lift = predict(*counts, size, PRESETS[preset], slowness=slowness, masks_a_frame=masks, classes=classes)
    minutes = lift.seconds / 60
    time = f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
    return f"{preset:<9} about {time} and {lift.peak_bytes / 1e9:.1f} GB of memory"


def _sizes(sizes: tuple[tuple[Size, int], ...]) -> str:
    """Return a text such as "640x480", or "640x480 (30), 320x240 (2)" for several sizes."""
    if len(sizes) == 1:
        return "{}x{}".format(*sizes[0][0])
    return ", ".join(f"{width}x{height} ({count})" for (width, height), count in sizes)
