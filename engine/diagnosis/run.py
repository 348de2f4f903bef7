"""Run the diagnosis from end to end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..job.progress import Progress, unwatched
from ..posed.matrices import shortest_rotation
from ..scene import Scene, Size
from .findings import Diagnosis, Finding, Mending
from .labels import label_findings, table_findings
from .numbers import NUMBER_CAUSES, are_numbers_off, lens_findings, number_findings
from .poses import measure_order, order_findings, pose_findings, repeat_findings
from .registration import SHIFT, picture_findings
from .reprojection import FEW, Assumption, examine
from .trials import Agreement, agreement, find_cause
from .up import measure_tilt, tilt_finding

_Z = np.array([0.0, 0.0, 1.0])


def diagnose(scene: Scene, progress: Progress = unwatched) -> Diagnosis:
    """Find what is wrong with a scene. At most 120 of its frames are examined. Raises PlgsError for bad files."""
    examined = examine(scene)
    if examined is None:
        order = measure_order(scene, Assumption())
        findings = [*order_findings(scene, order), *repeat_findings(scene, progress)]
        return _diagnosis(scene, findings, Mending(dropped=_dropped(findings)), 0, None)
    as_it_is = agreement(examined.views, examined.pairs, Assumption())
    findings, assumed, shift = number_findings(examined, lens_is_doubtful=bool(scene.assumed_lens))
    tilt = measure_tilt(examined.views, assumed)
    if tilt is not None:
        findings.append(tilt_finding(examined, tilt, assumed))
    order = measure_order(scene, assumed)
    findings += [*order_findings(scene, order), *repeat_findings(scene, progress)]
    untested: tuple[str, ...] = ()
    if order is None or not order.is_shuffled:
        found, untested = pose_findings(examined, assumed)
        findings += found
        pictures = picture_findings(examined, assumed)
        if pictures:  # depth's edges fit pictures of other frames only by chance
            findings, shift = [each for each in findings if each.cause != SHIFT], (0.0, 0.0)
        findings += pictures
    findings += label_findings(examined, assumed)
    findings += table_findings(examined, assumed, _Z if tilt is None else tilt.axis)
    turn = None if tilt is None else shortest_rotation(tilt.axis, _Z)
    is_sure = all(finding.is_mended for finding in findings if finding.cause in NUMBER_CAUSES)
    if not is_sure:  # whatever was measured after a doubtful cause is just as doubtful
        findings = [replace(finding, is_mended=False) for finding in findings]
    mending = Mending(assumed, shift, turn, _dropped(findings)) if is_sure else Mending()
    return replace(_diagnosis(scene, findings, mending, len(examined.looks), as_it_is), untested=untested)


def diagnose_quickly(scene: Scene, masks_within: Size | None = None) -> Diagnosis:
    """Check a scene for a second or two before a lift: order, axes, units, lens, up, pictures of other frames,
    contradicting masks, and the class table. What seems wrong in these few frames is measured again by `diagnose`.
    Masks are read scaled down to fit into the size ``masks_within`` (None: at their own). Raises PlgsError, OSError."""
    examined, order = examine(scene, FEW, masks_within), measure_order(scene, Assumption())
    findings = [*order_findings(scene, order), *repeat_findings(scene)]
    if examined is None:
        return Diagnosis(tuple(findings), Mending(), len(scene.frames), 0, None)
    as_it_is = agreement(examined.views, examined.pairs, Assumption())
    cause = find_cause(examined.views, examined.pairs, lens_is_doubtful=bool(scene.assumed_lens))
    assumed = Assumption()
    if cause or are_numbers_off(examined) or measure_tilt(examined.views, assumed) is not None:
        return diagnose(scene)
    measured = [*label_findings(examined, assumed), *table_findings(examined, assumed, _Z)]
    if order is None or not order.is_shuffled:
        measured += picture_findings(examined, assumed)
    if any(finding.severity == "wrong" for finding in measured):
        return diagnose(scene)
    return Diagnosis((*findings, *measured), Mending(), len(scene.frames), len(examined.looks), as_it_is)


def _dropped(findings: list[Finding]) -> frozenset[str]:
    return frozenset(name for finding in findings if finding.is_mended for name in finding.frames)


def _diagnosis(
    scene: Scene, findings: list[Finding], mending: Mending, looked: int, agreeing: Agreement | None
) -> Diagnosis:
    found = [*lens_findings(scene, findings), *findings]
    worst_first = sorted(found, key=lambda finding: finding.severity != "wrong")  # stable: otherwise as they were found
    return Diagnosis(tuple(worst_first), mending, len(scene.frames), looked, agreeing)
