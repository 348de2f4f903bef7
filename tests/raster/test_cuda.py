"""The back end gsplat against the float64 reference: with a stand-in, and on a GPU if there is one."""

from dataclasses import replace
from importlib import metadata

import pytest
import torch

from engine.raster import cuda
from tests.raster import scenes
from tests.raster.gsplat_in_torch import use_a_stand_in
from tests.raster.reference import rasterize

SCENES = {
    name: scene
    for name, scene in scenes.hard_scenes().items()
    if name in ("mixed", "many labels", "one pixel", "across the near plane", "partly saturated", "faint")
}
"""Without those that need more than float32 in the projection."""

_MISSING = cuda.what_is_missing() if torch.cuda.is_available() else "there is no CUDA device"
needs_gpu = pytest.mark.skipif(_MISSING is not None, reason=str(_MISSING))


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    use_a_stand_in(monkeypatch)


def assert_as_the_reference(scene: scenes.Scene, device: str = "cpu") -> None:
    """Float32 may get two thousandths of a group's gradients wrong. On a GPU gsplat computes with fast approximations:
    there no group may be wrong by more than a thousandth of its norm."""
    steady = scenes.steady_pixels(scene)
    there = replace(scene, tensors=tuple(tensor.to(device) for tensor in scene.tensors))
    ours, our_gradients = scenes.render(there, "gsplat", steady)
    theirs, their_gradients = scenes.render(scene, "reference", steady)
    drawn = ours.visible.cpu() & theirs.visible
    assert not (theirs.visible & ~ours.visible.cpu()).any()  # gsplat's boxes are larger
    torch.testing.assert_close(ours.means2d.cpu()[drawn], theirs.means2d.float()[drawn], rtol=1e-5, atol=1e-3)
    for layer in scenes.LAYERS:
        got, expected = getattr(ours, layer).cpu()[steady], getattr(theirs, layer)[steady]
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-4, msg=lambda text, layer=layer: f"{layer}: {text}")
    for group in scenes.GROUPS:
        got, expected = our_gradients[group].cpu().double(), their_gradients[group].double()
        if device == "cpu":
            assert scenes.missed_elements(got, expected) <= 2e-3 * got.numel(), group
        else:
            assert (got - expected).norm() <= 1e-3 * expected.norm(), group


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("name", SCENES)
def test_drawing_with_gsplat_matches_the_reference(name: str) -> None:
    assert_as_the_reference(SCENES[name])


@needs_gpu
@pytest.mark.parametrize("name", SCENES)
def test_drawing_on_a_gpu_matches_the_reference(name: str) -> None:
    scene = SCENES[name]
    assert_as_the_reference(scene.changed(3, scene.tensors[3].clamp(max=0.98)), "cuda")


@needs_gpu
def test_a_gpu_draws_one_gaussian_and_empty_views() -> None:
    assert cuda.what_fails("cuda") is None
    scene = scenes.random_scene(8, 20, 600, 24, 17)
    behind = scene.changed(0, scene.tensors[0] - torch.from_numpy(scene.pose[:3, 2] * 50.0).float())
    nothing = replace(scene, tensors=tuple(tensor[:0] for tensor in scene.tensors))
    for each in (behind, nothing):
        assert_as_the_reference(each, "cuda")


def assert_rows_as_in_the_whole(device: str) -> None:
    """Many Gaussians lie beside a band by more than the margin in which a band of its own would clamp them. The first
    one is small and in row 37."""
    scene = scenes.random_scene(5, 400, 40, 60, 64)
    scene.tensors[0][0] = torch.from_numpy(scene.pose[:3, 3] + 2.0 * scene.pose[:3, 2])
    scene.tensors[1][0], scene.tensors[3][0] = 1e-3, 0.9
    tensors = [tensor.to(device) for tensor in scene.tensors]
    where = (scene.pose, scene.intrinsics, 60, 64)
    whole = rasterize(*tensors, *where, backend="gsplat")
    for first, end in ((0, 16), (16, 40), (40, 64)):
        band = rasterize(*tensors, *where, rows=(first, end), backend="gsplat")
        for layer in scenes.LAYERS:
            torch.testing.assert_close(getattr(band, layer), getattr(whole, layer)[first:end], atol=1e-6, rtol=0)
        assert not (band.visible & ~whole.visible).any() and bool(band.visible[0]) == (first <= 37 < end)
        reference = rasterize(*scene.tensors, *where, rows=(first, end), backend="reference")
        assert not (reference.visible & ~band.visible.cpu()).any()
        expected = whole.means2d[band.visible] - torch.tensor([0.0, first], device=device)
        torch.testing.assert_close(band.means2d[band.visible], expected)


@pytest.mark.usefixtures("stand_in")
def test_drawing_some_rows_matches_the_whole_picture() -> None:
    assert_rows_as_in_the_whole("cpu")


@needs_gpu
def test_drawing_some_rows_on_a_gpu_matches_the_whole_picture() -> None:
    assert_rows_as_in_the_whole("cuda")


def test_empty_views_are_drawn_without_calling_gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    """gsplat divides by the number of Gaussians: 0 would end the process."""
    use_a_stand_in(monkeypatch)
    monkeypatch.setattr("gsplat.rasterization", None)
    scene = scenes.random_scene(8, 20, 3, 24, 17)
    assert_as_the_reference(replace(scene, tensors=tuple(tensor[:0] for tensor in scene.tensors)))


def test_a_failure_of_gsplat_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def rasterization(**arguments: object) -> None:
        raise RuntimeError("Error building extension 'gsplat_cuda': [1/30]\nnvcc: not found")

    use_a_stand_in(monkeypatch)
    assert cuda.what_fails("cpu") is None
    monkeypatch.setattr("gsplat.rasterization", rasterization)
    assert cuda.what_fails("cpu") == "RuntimeError: Error building extension 'gsplat_cuda': [1/30]"


@pytest.mark.usefixtures("stand_in")
def test_gsplat_draws_without_labels_and_without_gradients() -> None:
    scene = scenes.random_scene(7, 100, 4, 30, 20)
    where = (scene.pose, scene.intrinsics, 30, 20)
    bare = rasterize(*scene.tensors[:5], None, *where, backend="gsplat")
    full = rasterize(*scene.tensors, *where, backend="gsplat")
    assert bare.labels is None and torch.equal(bare.image, full.image) and not bare.means2d.requires_grad


@pytest.mark.parametrize(
    ("installed", "said"),
    [("1.4.0", "too old"), ("1.5.3+pt24cu124", None), ("1.6.0", None), ("1.7.0", "too new"), (None, "not installed")],
)
def test_an_unfit_gsplat_is_refused(installed: str | None, said: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if installed is None:
            raise metadata.PackageNotFoundError(name)
        return installed

    monkeypatch.setattr(metadata, "version", version)
    missing = cuda.what_is_missing()
    if said is None:
        assert missing is None
    else:
        assert missing is not None and said in missing and "gsplat>=1.5,<1.7" in missing


def test_gsplat_refuses_tensors_on_the_cpu() -> None:
    scene = scenes.random_scene(10, 5, 2, 8, 8)
    with pytest.raises(ValueError, match="on the device cuda, these are torch.float32 on cpu"):
        rasterize(*scene.tensors, scene.pose, scene.intrinsics, 8, 8, backend="gsplat")


@pytest.mark.usefixtures("stand_in")
def test_drawing_labels_with_gsplat_changes_no_other_output() -> None:
    scenes.assert_labels_affect_nothing_else("gsplat")
