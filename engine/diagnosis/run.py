"""The diagnosis from end to end."""

from __future__ import annotations

import numpy as np

from ..scene import Scene
from .appearance import (
    blur_findings,
    blur_findings_on_surfaces,
    clipped_findings,
    exposure_findings,
)
from .contradictions import label_findings
from .course import order_findings, order_of, pose_findings, repeat_findings
from .examined import Examined, examine
from .finding import Diagnosis, Finding, Mending
from .numbers import number_findings
from .photos import load_photos
from .pictures import level_surfaces
from .reprojection import Assumption, Floats
from .trials import agreement
from .up import UpAxis, measure_up

_TILTED, _CERTAIN = 5.0, 5.0
"""Degrees, and standard errors: floors are level to a degree, and so are scanners' worlds."""
_NAMED_WITHIN = 8.0
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def diagnose(scene: Scene) -> Diagnosis:
    """Measure what is wrong with a scene. Of many frames 120 are looked at. Raises SceneError for bad files."""
    examined = examine(scene)
    if examined is None:
        return _without_depth(scene)
    as_it_is = agreement(examined.views, examined.pairs, Assumption())
    findings, assumed, shift = number_findings(examined)
    up = measure_up(examined.views, assumed)
    tilted = up if up is not None and _is_tilted(up) else None
    if tilted is not None:
        findings.append(_of_up(examined, tilted, assumed))
    order = order_of(scene, assumed)
    findings += order_findings(scene, order)
    findings += repeat_findings(scene)
    if order is None or not order.is_shuffled:
        findings += pose_findings(examined, assumed)
        findings += blur_findings_on_surfaces(examined, assumed)
    findings += clipped_findings(examined.photos)
    findings += exposure_findings(examined, assumed)
    findings += label_findings(examined, assumed)
    mending = Mending(
        assumed=assumed,
        depth_shift=shift,
        turn=None if tilted is None else turn_to_z(tilted.axis),
        dropped=frozenset(name for finding in findings if finding.is_mended for name in finding.frames),
    )
    return _sorted(Diagnosis(tuple(findings), mending, len(scene.frames), len(examined.looks), as_it_is))


def _without_depth(scene: Scene) -> Diagnosis:
    photos = load_photos(scene.frames)
    order = order_of(scene, Assumption())
    findings = [*order_findings(scene, order), *repeat_findings(scene)]
    if order is None or not order.is_shuffled:
        findings += blur_findings(photos)
    findings += clipped_findings(photos)
    dropped = frozenset(name for finding in findings if finding.is_mended for name in finding.frames)
    return _sorted(Diagnosis(tuple(findings), Mending(dropped=dropped), len(scene.frames), len(photos), None))


def _sorted(diagnosis: Diagnosis) -> Diagnosis:
    ordered = sorted(diagnosis.findings, key=lambda finding: finding.severity != "wrong")
    return Diagnosis(tuple(ordered), diagnosis.mending, diagnosis.frames, diagnosis.looked, diagnosis.agreement)


def _is_tilted(up: UpAxis) -> bool:
    return up.tilt > max(_TILTED, _CERTAIN * up.deviation)


def _of_up(examined: Examined, up: UpAxis, assumed: Assumption) -> Finding:
    turn = np.eye(3) if examined.scene.turn is None else examined.scene.turn
    written = turn.T @ up.axis  # in the poses' own world, of which --up speaks
    axis = max(_AXES, key=lambda name: abs(float(written @ _AXES[name])))
    cosine = float(written @ _AXES[axis])
    name = axis if cosine > 0.0 else f"-{axis}"
    is_named = np.degrees(np.arccos(min(abs(cosine), 1.0))) < _NAMED_WITHIN
    option = f"read it with --up {name}, or " if is_named and name in ("z", "y", "-y") else ""
    best = max(range(len(examined.looks)), key=lambda row: len(examined.looks[row].points))
    normals = _normals_of(examined, best, assumed)
    return Finding(
        cause="up direction",
        severity="wrong",
        text=f"up is {up.tilt:.0f} degrees from z: {up.level:.0%} of the surfaces are level about the axis "
        f"{up.axis[0]:.2f}, {up.axis[1]:.2f}, {up.axis[2]:.2f} and {up.walls:.0%} upright"
        + (f"; that is the poses' axis {name}" if is_named else ""),
        option=f"{option}--fix OUT turns it upright",
        figures={
            "degrees": up.tilt,
            "level": up.level,
            "walls": up.walls,
            "within_degrees": up.deviation,
            "axis": name,
        },
        is_mended=True,
        picture=level_surfaces(examined.looks[best], normals @ up.axis, "green: level, blue: upright"),
    )


def _normals_of(examined: Examined, row: int, assumed: Assumption) -> Floats:
    """The normals of a look's points in the world, float64 [N, 3]; 0 where there is none."""
    lens, poses = examined.views.lens_of(assumed), examined.views.poses_of(assumed)
    world, known = examined.views.world_points(assumed, lens, poses)
    local = (world[row][known[row]] - poses[row, :3, 3]) @ poses[row, :3, :3]
    surface = examined.views.surface_at(row, local, assumed, lens[row])
    return np.where(np.isfinite(surface.distance)[:, None], surface.normal @ poses[row, :3, :3].T, 0.5)


def turn_to_z(axis: Floats) -> Floats:
    """The shortest rotation, float64 [3, 3], that takes the unit vector ``axis`` [3] to z."""
    z = np.array([0.0, 0.0, 1.0])
    cosine = float(axis @ z)
    if cosine < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    x, y, w = np.cross(axis, z).tolist()
    cross = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
