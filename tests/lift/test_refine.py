"""A draft is gone on from, by the command that the docs name: the same bits, names and corrections as without it."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from engine.command_line.main import main
from engine.corrections import correct, making, read_corrected
from engine.job import LiftFolder, LiftRequest, read_manifest
from engine.lift import preparation
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as, warnings_in

WRITTEN_BY_STEPS = ("model.safetensors", "instances.json", "semantic_points.npz", "gaussians.ply", "metrics.json")


@pytest.fixture(scope="module")
def lifts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LiftFolder, LiftFolder]]:
    """A draft, with a corrected name, and a preview of the same scene."""
    root = tmp_path_factory.mktemp("refine")
    scene = write_tiny_scene(root / "scene", frames=8)
    draft = replace(TINY, name="draft", trained=0.3, judged=2, scored=(32, 32), vote_size=(32, 32))
    with presets_as(draft=draft, preview=TINY, standard=replace(TINY, name="standard", voxel_size=0.25)):
        first = lift_into(root / "draft", LiftRequest(scene=scene, preset="draft"))
        one = read_corrected(first.path).instances[0]
        correct(first.path, lambda state, free: making.rename(state, one.id, "throne"))
        yield first, lift_into(root / "preview", LiftRequest(scene=scene))


def files(folder: LiftFolder) -> dict[str, bytes]:
    return {name: (folder.result_path / name).read_bytes() for name in WRITTEN_BY_STEPS}


def test_a_draft_lift_bakes_nothing_and_trains_fewer_steps(lifts: tuple[LiftFolder, LiftFolder]) -> None:
    draft, preview = lifts
    assert not draft.passes_path.exists() and any(preview.passes_path.glob("*.exr"))
    assert ["Baking" in one.events_path.read_text() for one in lifts] == [False, True]
    assert [len(one.training_path.read_text().splitlines()) for one in lifts] == [1 + 4, 1 + 12]
    assert files(draft).keys() == files(preview).keys() and files(draft) != files(preview)


def test_a_refined_draft_equals_a_preview_and_keeps_corrections(
    lifts: tuple[LiftFolder, LiftFolder], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draft, preview = lifts
    (draft.path / "lift.blend").touch()
    with monkeypatch.context() as without:
        without.delattr(preparation, "warm_start")  # what it fits is there
        assert main(["lift", str(draft.path), "--refine"]) == 0
    assert "lift.blend shows the earlier result" in capsys.readouterr().err
    assert files(draft) == files(preview) and warnings_in(draft.events_path) == warnings_in(preview.events_path)
    assert LiftFolder.open(draft.path).request == replace(preview.request, scene=draft.request.scene)
    assert "throne" in [one.name for one in read_corrected(draft.path).instances]
    assert {path.name for path in draft.passes_path.glob("*")} == {path.name for path in preview.passes_path.glob("*")}
    before = draft.manifest_path.read_bytes()
    assert main(["lift", str(draft.path), "--refine"]) == 0, "given twice, it ends the same way"
    assert draft.manifest_path.read_bytes() == before
    # Another size of voxels gives other points, so training begins anew, and says so. Names are kept.
    names = {one.id: one.name for one in read_corrected(draft.path).instances}
    assert main(["lift", str(draft.path), "--refine", "standard"]) == 0
    assert any("voxel_size" in line and "from the first step" in line for line in warnings_in(draft.events_path))
    assert {one.id: one.name for one in read_corrected(draft.path).instances} == names
    assert read_manifest(draft.result_path).settings["name"] == "standard"


def test_a_refinement_must_be_finer(lifts: tuple[LiftFolder, LiftFolder], capsys: pytest.CaptureFixture[str]) -> None:
    before = files(lifts[1])
    asked = replace(lifts[1].request, preset="paper")
    (lifts[1].path / "request.json").write_text(asked.to_json(lifts[1].path))
    assert main(["lift", str(lifts[1].path), "--refine", "preview"]) == 2
    assert "--refine" not in capsys.readouterr().out and files(lifts[1]) == before
