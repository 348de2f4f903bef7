"""A scene that cannot be lifted is refused with one line and a fix."""

from pathlib import Path
from typing import Any

from engine.errors import PlgsError
from engine.job.progress import unwatched
from engine.scene import Progress, Scene, SceneReport, open_scene, report_of, survey_scene
from engine.scene.opening import require_liftable
from tests.raises_key import raises_key


def check_scene(scene: Scene, progress: Progress = unwatched) -> tuple[str, ...]:
    """The warnings of the survey of a scene that can be lifted."""
    require_liftable(scene)
    return survey_scene(scene, progress).warnings


def describe(scene: Scene) -> SceneReport:
    return report_of(survey_scene(scene))


def refuses(told: str, place: Path, look_into_pixels: bool = False, **reading: Any) -> PlgsError:
    """Assert that opening the scene at ``place`` raises a PlgsError with ``told``, in one line and with a fix."""
    with raises_key(told) as caught:
        scene = open_scene(place, **reading)
        if look_into_pixels:
            check_scene(scene)
    assert "\n" not in str(caught.value) and caught.value.fix
    return caught.value
