"""What can be done with a scene, and why not more: for the panel."""

from __future__ import annotations

from typing import NamedTuple

from .scene_survey import Survey

_ENGINE = "set the engine up, which makes them"
_NAMES = {"depth": "depth maps", "masks": "masks"}


class Possibility(NamedTuple):
    """One thing, whether it can be had, and how or why not."""

    what: str
    is_possible: bool
    why: str


def possibilities(survey: Survey, has_engine: bool) -> tuple[Possibility, ...]:
    """Of a scene that was looked at and is not bad."""
    return (
        Possibility("Cameras", True, f"{survey.frames}, and one that moves along them"),
        _pictures(survey, has_engine),
        _cloud(survey, has_engine),
        _lift(survey),
    )


def why_not_liftable(survey: Survey) -> str | None:
    """Why a scene without anything wrong in it cannot be lifted; None when it can, or nobody knows yet."""
    if survey.is_looking or survey.error is not None:
        return None
    lift = _lift(survey)
    return None if lift.is_possible else f"No lift: {lift.why}"


def _pictures(survey: Survey, has_engine: bool) -> Possibility:
    if survey.picture_files == survey.frames:
        return Possibility("Pictures", True, "as they are")
    inside = "they lie in a video or an archive, or their lens bends"
    return Possibility("Pictures", has_engine, f"{inside}: {'the engine makes them' if has_engine else _ENGINE}")


def _cloud(survey: Survey, has_engine: bool) -> Possibility:
    points = f"{survey.sparse_points} points of the reconstruction"
    if survey.has_depth and has_engine:
        return Possibility("Coloured cloud", True, "of the depth, by the engine")
    if survey.sparse_points:
        return Possibility("Coloured cloud", True, points)
    if survey.has_depth:
        return Possibility("Coloured cloud", False, "of the depth: set the engine up, which makes it")
    return Possibility("Coloured cloud", False, "there is neither depth nor a reconstruction's points")


def _lift(survey: Survey) -> Possibility:
    lacks = [what for what, has in (("depth", survey.has_depth), ("masks", survey.has_masks)) if not has]
    if not lacks:
        return Possibility("Lift", True, "depth and masks are there")
    verb = "are" if "masks" in lacks else "is"
    why = f"there {verb} no {' and no '.join(lacks)}: give {' and '.join(_NAMES[what] for what in lacks)} below"
    return Possibility("Lift", False, why)
