"""What the masks show and the lift does not: a sink in a countertop, drawn by near views alone."""

import numpy as np
from numpy.typing import NDArray

from engine.metrics.unshown import JudgedView, Unshown, find_unshown
from engine.scene import Camera, Category, ClassTable, PanopticMask, Segment, View

TOP, SINK = 1, 2
CLASSES = ClassTable((Category(TOP, "countertop", False, (9, 9, 9)), Category(SINK, "sink", True, (9, 9, 200))))
WIDTH, HEIGHT = 60, 40


def flat_view(
    name: str, distance: float, x: float, sinks: list[tuple[float, float]], *, draws: bool = True, scale: float = 2.0
) -> JudgedView:
    """A camera above the plane z = 0, which looks down from ``distance`` metres at ``x``. Its mask draws each sink, a
    square of 0.3 m around (x, y), where it ``draws`` them; the lift shows countertop."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = x, 0.0, distance
    camera = Camera(WIDTH, HEIGHT, 50.0, 50.0, WIDTH / 2, HEIGHT / 2, pose)
    depth = np.full((HEIGHT, WIDTH), distance, np.float32)
    xyz = camera.unproject(depth)
    ids, segments = np.full((HEIGHT, WIDTH), 1, np.int32), [Segment(1, TOP, False)]
    for number, centre in enumerate(sinks, start=2):
        inside = (np.abs(xyz[..., :2] - centre) <= 0.15).all(axis=-1)
        if draws and inside.any():
            ids[inside] = number
            segments.append(Segment(number, SINK, True))
    colour = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    view = View(name, camera, colour, depth, PanopticMask(ids, tuple(segments)), mask_scale=scale)
    return JudgedView(view, np.full((HEIGHT, WIDTH), TOP, np.int32))


def showing(judged: JudgedView, centre: tuple[float, float]) -> JudgedView:
    """The same view of a lift that shows a sink at ``centre``."""
    xyz = judged.view.camera.unproject(judged.view.depth)
    inside = (np.abs(xyz[..., :2] - centre) <= 0.15).all(axis=-1)
    shown: NDArray[np.int32] = np.where(inside, SINK, judged.shown).astype(np.int32)
    return judged._replace(shown=shown)


ONE = [(0.0, 0.0)]
NEAR = [flat_view(f"near {k}", 1.0 + 0.02 * k, 0.05 * k, ONE) for k in range(4)]
FAR = [flat_view(f"far {k}", 4.0, 0.02 * k, ONE, draws=False) for k in range(12)]


def only(found: list[Unshown]) -> Unshown:
    (one,) = found
    return one


def test_near_views_outvote_many_far_ones_about_a_missing_object() -> None:
    one = only(find_unshown([*FAR, *NEAR], CLASSES))
    assert (one.name, one.whole_class, one.frame, one.views, one.near) == ("sink", True, "near 0", 4, 4)
    assert one.shown_as == "countertop" and one.resolution == 1.0
    assert np.abs(np.array(one.centre)).max() < 0.03
    assert one.pixels == 32 * 32, "0.3 m at a pixel a centimetre, to whole pixels of the judged view"


def test_a_missing_object_is_reported_beside_shown_ones_of_its_class() -> None:
    two = [(0.0, 0.0), (0.45, 0.0)]
    views = [showing(flat_view(f"{k}", 1.0 + 0.02 * k, 0.2 + 0.02 * k, two), two[0]) for k in range(4)]
    one = only(find_unshown(views, CLASSES))
    assert not one.whole_class and abs(one.centre[0] - 0.45) < 0.03
    assert find_unshown(views[:2], CLASSES) == [], "an object needs three views"


def test_objects_without_clear_evidence_are_not_reported_as_missing() -> None:
    shown = [showing(view, (0.0, 0.0)) for view in (*FAR, *NEAR)]
    denied = [flat_view(f"denied {k}", 1.0, 0.05 * k, ONE, draws=False) for k in range(5)]
    coarse = [flat_view(f"{k}", 3.0, 0.05 * k, ONE, scale=1.0) for k in range(4)]
    assert [find_unshown(views, CLASSES) for views in (shown, [*NEAR, *denied], coarse, [])] == [[]] * 4
