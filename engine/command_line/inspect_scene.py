"""``inspect``: what is in a scene, and what is wrong with it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from ..diagnosis import Diagnosis, diagnose, write_findings, write_mended
from ..diagnosis.written import as_json as diagnosis_as_json
from ..job import ExitCode
from ..job.effort import chosen_effort
from ..job.prediction import USUAL_CLASSES, USUAL_MASKS, machine_slowness, predict
from ..scene import AskedScene, Scene, SceneError, SceneReport, Size, describe, open_asked


def inspect_scene(
    asked: AskedScene,
    *,
    as_json: bool = False,
    preset: str | None = None,
    findings: Path | None = None,
    fix: Path | None = None,
) -> ExitCode:
    """Decode every frame and print what is there and what is wrong with it, for people or as one line of JSON. For
    people also what a lift with ``preset`` would take.

    ``findings`` is a folder for the findings and their pictures, ``fix`` a new one for the mended scene. Raises
    SceneError for the first thing that a lift would refuse, after the findings that may explain it.
    """
    if fix is not None and fix.exists():
        raise SceneError("the folder for the mended scene exists", fix, "Name one that does not.")
    scene = open_asked(asked)
    try:
        report = describe(scene)
    except SceneError as error:
        diagnosis = _explanation(scene, error)
        _tell(None, diagnosis, as_json, findings)
        if fix is None or not diagnosis.mending.is_needed:
            raise
        return _mend(scene, diagnosis, fix, as_json)
    diagnosis = diagnose(scene)
    _tell(report, diagnosis, as_json, findings)
    if preset is not None and not as_json:
        print(_prediction(report, preset))
    return ExitCode.FINISHED if fix is None else _mend(scene, diagnosis, fix, as_json)


def _explanation(scene: Scene, refusal: SceneError) -> Diagnosis:
    """What explains that a scene is refused. Raises the refusal where nothing does."""
    try:
        diagnosis = diagnose(scene)
    except SceneError:
        raise refusal from None
    if not any(finding.severity == "wrong" for finding in diagnosis.findings):
        raise refusal
    return diagnosis


def _tell(report: SceneReport | None, diagnosis: Diagnosis, as_json: bool, folder: Path | None) -> None:
    if folder is not None:
        write_findings(diagnosis, folder)
    if as_json:
        told = {} if report is None else asdict(report)
        print(json.dumps({**told, "diagnosis": diagnosis_as_json(diagnosis)}, default=str))
        return
    if report is not None:
        print(*_lines(report), sep="\n")
    print(*_finding_lines(diagnosis, folder), sep="\n")


def _mend(scene: Scene, diagnosis: Diagnosis, fix: Path, as_json: bool) -> ExitCode:
    if not diagnosis.mending.is_needed:
        if not as_json:
            print("mended    nothing: no finding can be mended without a doubt, and no folder is written")
        return ExitCode.FINISHED
    write_mended(scene, diagnosis, fix)
    if not as_json:
        mended = [finding.cause for finding in diagnosis.findings if finding.is_mended]
        print(f"mended    {', '.join(mended)}: {fix}")
    return ExitCode.FINISHED


def _finding_lines(diagnosis: Diagnosis, folder: Path | None) -> Iterator[str]:
    views = diagnosis.agreement
    if views is not None:
        yield (
            f"views     {views.share:.0%} of what two frames see lies where both have it, with a median error of "
            f"{views.error:.2%} ({diagnosis.looked} of {diagnosis.frames} frames compared)"
        )
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
        yield f"masks     {_sizes(report.mask_sizes)}, {fewest} to {most} segments a frame, {median} in the middle"
    if report.sparse_points:
        yield f"points    {report.sparse_points} of the reconstruction"
    yield "cameras   within " + " x ".join(f"{side:.2f}" for side in report.extent) + " m"
    if report.classes:
        yield f"classes   {len(report.classes)}, {report.void_share:.1%} of the pixels without"
    for entry in sorted(report.classes, key=lambda entry: -entry.share):
        yield f"  {entry.id:4d}  {entry.name:<24} {'thing' if entry.is_thing else 'stuff'} {entry.share:7.1%}"
    for warning in report.warnings:
        yield f"warning: {warning}"


def _prediction(report: SceneReport, preset: str) -> str:
    """Such as "preview   about 3 min and 1.0 GB of memory"."""
    size, effort, slowness = report.colour_sizes[0][0], chosen_effort(preset), machine_slowness()
    masks = USUAL_MASKS if report.segments_per_frame is None else report.segments_per_frame[1]
    counts, classes = (report.train_frames, report.test_frames), len(report.classes) or USUAL_CLASSES
    lift = predict(*counts, size, effort, slowness=slowness, masks_a_frame=masks, classes=classes)
    minutes = lift.seconds / 60
    time = f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
    return f"{preset:<9} about {time} and {lift.peak_bytes / 1e9:.1f} GB of memory"


def _sizes(sizes: tuple[tuple[Size, int], ...]) -> str:
    """Such as "640x480", or "640x480 (30), 320x240 (2)"."""
    if len(sizes) == 1:
        return "{}x{}".format(*sizes[0][0])
    return ", ".join(f"{width}x{height} ({count})" for (width, height), count in sizes)
