"""Mask2Former itself, with random weights: transformers' own loading, no download."""

import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from engine.command_line.main import SEGMENT_MODEL, main
from tests.commands import exit_code
from tests.tiny_scene import write_tiny_scene

pytest.importorskip("transformers", reason="needs transformers (requirements/segment.txt)")

from engine.known_networks import KNOWN
from engine.mask_networks import load_model  # noqa: E402
from engine.networks import loading, model_folder  # noqa: E402
from tests.raises_key import raises_key, worded
from tests.segment.tiny_mask2former import NAMES, save_tiny_mask2former  # noqa: E402


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_mask2former(tmp_path_factory.mktemp("mask2former"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene", frames=3, size=(64, 48), ground_truth=False, masks="none")


def test_a_mask_network_is_loaded_from_a_folder(model: Path) -> None:
    network = load_model(str(model), download=False)
    assert [label.name for label in network.labels] == NAMES
    assert [label.is_thing for label in network.labels] == [False, False, True, True]
    colour = np.random.default_rng(0).integers(0, 255, (48, 80, 3), np.uint8)
    ids, found, detections = network.segment(colour)
    assert ids.shape == (48, 80) and {*np.unique(ids).tolist()} - {0} == {one.id for one in found} != set()
    assert all(one.score >= 0.1 and one.pixels.shape == ids.shape for one in detections)
    again, *_ = network.segment(colour)
    np.testing.assert_array_equal(ids, again)


def test_masks_of_large_pictures_are_smaller_with_the_same_aspect(model: Path) -> None:
    ids, *_ = load_model(str(model), download=False).segment(np.zeros((1000, 2000, 3), np.uint8))
    assert ids.shape == (640, 1280)


def test_no_network_is_downloaded_without_consent() -> None:
    with raises_key("not-downloaded nobody/no-such-model --download"):
        load_model("nobody/no-such-model", download=False)


def test_a_missing_network_is_told_before_any_frame_is_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("engine.command_line.commands._scene_of", lambda _: pytest.fail("the scene was opened"))
    for more, told in ([], "not-downloaded"), (["--download"], "hub-silent"):
        monkeypatch.setattr("huggingface_hub.HfApi.model_info", raise_timeout)
        assert main(["segment", str(tmp_path), "--frames", "auto", "--model", "nobody/no-such-model", *more]) == 2
        assert worded(f"{told} nobody/no-such-model").search(capsys.readouterr().err)


def raise_timeout(*_: object, **__: object) -> None:
    raise TimeoutError


def test_an_unreachable_hugging_face_hub_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def model_info(_hub: object, name: str, *, revision: str | None, timeout: float) -> None:
        raise TimeoutError(f"{name} at {revision} after {timeout} s")

    monkeypatch.setattr("huggingface_hub.HfApi.model_info", model_info)
    with raises_key("hub-silent nobody/no-such-model") as silent:
        load_model("nobody/no-such-model", download=True)
    assert "does not answer" in str(silent.value)


def test_the_default_network_is_pinned_to_one_revision(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def model_info(_hub: object, name: str, *, revision: str | None, timeout: float) -> None:
        asked.append((name, revision))
        raise TimeoutError

    monkeypatch.setattr("huggingface_hub.HfApi.model_info", model_info)
    with raises_key("hub-silent"):
        load_model(SEGMENT_MODEL, download=True)
    assert asked == [(SEGMENT_MODEL, KNOWN[SEGMENT_MODEL].revision)]


@pytest.mark.parametrize(("name", "told"), [("nowhere", "no-model"), ("tests", "no-model")])
def test_a_missing_network_gives_a_one_line_error(name: str, told: str) -> None:
    with raises_key(told):
        load_model(name, download=False)


def with_weights(folder: Path, change: Callable[[dict[str, torch.Tensor]], object]) -> None:
    weights = load_file(folder / "model.safetensors")
    change(weights)
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


def with_config(folder: Path, **changes: object) -> None:
    content = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(content | changes))


def with_index(folder: Path, file: object) -> None:
    """Of weights that lie in ``file``, which is a pickle for all that is known of it."""
    names = [*load_file(folder / "model.safetensors")]
    (folder / "model.safetensors").rename(folder / "part.safetensors")
    shutil.copy(folder / "part.safetensors", folder / "w.bin")
    shutil.copy(folder / "part.safetensors", folder.parent / "outside.safetensors")
    content = {"metadata": {}, "weight_map": dict.fromkeys(names, file)}
    (folder / "model.safetensors.index.json").write_text(json.dumps(content))


BROKEN: dict[str, tuple[str, Callable[[Path], object]]] = {
    "no weights": ("model-broken missing", partial(with_weights, change=dict.clear)),
    "one weight too few": ("model-broken missing class_predictor.bias",
                           partial(with_weights, change=lambda weights: weights.pop("class_predictor.bias"))),
    "one weight too many": ("model-broken unexpected",
                            partial(with_weights, change=lambda weights: weights.update(other=torch.ones(3)))),
    "a weight of another shape": ("model-broken|model-unusable", partial(
        with_weights, change=lambda weights: weights.update({"class_predictor.bias": torch.ones(3)}))),
    "not a number": ("model-broken infinite class_predictor.bias", partial(
        with_weights, change=lambda weights: weights["class_predictor.bias"].fill_(float("nan")))),
    "a list of classes": ("no-id2label", partial(with_config, id2label=NAMES)),
    "classes without numbers": ("bad-id2label", partial(with_config, id2label={"a": "chair"})),
    "no classes": ("no-id2label", partial(with_config, id2label=None)),
    "weights elsewhere": ("model-outside", partial(with_config, transformers_weights="../outside.safetensors")),
    "zeros": ("model-unusable", lambda folder: (folder / "model.safetensors").write_bytes(b"\0" * 40)),
    "pickled weights alone": (
        "no-model", lambda folder: (folder / "model.safetensors").rename(folder / "pytorch_model.bin")),
    "weights in a pickle": ("model-outside", partial(with_config, transformers_weights="w.bin")),
    **{f"an index of {file!r}": ("model-outside", partial(with_index, file=file))
       for file in ("w.bin", "../outside.safetensors", "/tmp/outside.safetensors", "a\\b.safetensors", 3, None)},
}  # fmt: skip


@pytest.mark.parametrize(("told", "spoil"), BROKEN.values(), ids=BROKEN)
def test_a_network_with_broken_files_is_refused(
    told: str, spoil: Callable[[Path], object], model: Path, folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(model, tmp_path / "broken")
    spoil(tmp_path / "broken")
    with raises_key(told):
        load_model(str(tmp_path / "broken"), download=False)
    assert exit_code(main, "segment", folder, "--model", tmp_path / "broken") == 2
    assert not (folder / "panoptic").exists()


@pytest.mark.parametrize(
    ("settings", "is_vast"),
    [
        ({"stage_out_channels": [128, 512, 1024, 2048], "stage_numb_of_layers": [6, 6, 6, 6]}, False),
        ({"label2id": {"backstage pass": 1203, "layers": 1204}, "max_depth": 10_000}, False),
        ({"num_hidden_layers": 1001}, True),
        ({"encoder_layers": 1001}, True),
        ({"num_stages": 1001}, True),
        ({"depths": [2, 2, 1001, 2]}, True),
        ({"stage_num_blocks": [1, 1001]}, True),
        ({"num_labels": 2**20 + 1}, True),
    ],
)  # fmt: skip
@pytest.mark.parametrize("inside", [False, True])
def test_network_settings_that_mean_endless_work_are_refused(
    settings: dict[str, object], is_vast: bool, inside: bool, tmp_path: Path
) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"backbone_config": settings} if inside else settings))
    (tmp_path / "model.safetensors").touch()
    with raises_key("model-vast config.json") if is_vast else nullcontext():
        model_folder(str(tmp_path), download=False)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.OutOfMemoryError("CUDA out of memory."),
        RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: not enough memory: you tried to allocate 9"),
        RuntimeError("unable to mmap 9 bytes from file <w>: Cannot allocate memory (12)"),
    ],
    ids=repr,
)
@pytest.mark.parametrize("runs", [False, True])
def test_lack_of_memory_is_not_reported_as_a_bad_network(error: Exception, runs: bool) -> None:
    with pytest.raises(type(error)) as raised, loading("tiny", runs=runs):
        raise error
    assert raised.value is error


def test_an_internal_error_is_not_reported_as_a_bad_network(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = load_model(str(model), download=False)
    picture = np.zeros((48, 80, 3), np.uint8)
    with raises_key("model-unusable"):  # by torch's own line
        replace(network, queries=lambda colour: torch.nn.Linear(3, 2)(torch.zeros(5))).segment(picture)
    monkeypatch.setattr("engine.mask_networks._resized", None)
    with pytest.raises(TypeError, match="not callable"):
        network.segment(picture)


def test_network_weights_split_into_several_files_are_read(model: Path, tmp_path: Path) -> None:
    shutil.copytree(model, tmp_path / "parts")
    with_index(tmp_path / "parts", "part.safetensors")
    assert load_model(str(tmp_path / "parts"), download=False).labels


@pytest.mark.parametrize("revision", ["", "@" + 40 * "a"])
def test_a_network_with_garbled_weights_is_refused(
    revision: str, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the hub's cache has them: a link in a snapshot to a file that is called by its digest."""
    import huggingface_hub

    cached = tmp_path / "models--owner--tiny"
    snapshot = cached / "snapshots" / (40 * "a")
    shutil.copytree(model, snapshot)
    (cached / "refs").mkdir()
    (cached / "refs" / "main").write_text(40 * "a")
    weights = snapshot / "model.safetensors"
    blob = cached / "blobs" / sha256(weights.read_bytes()).hexdigest()
    blob.parent.mkdir()
    weights.rename(blob)
    weights.symlink_to(blob)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    assert load_model(f"owner/tiny{revision}", download=False).labels
    content = bytearray(blob.read_bytes())
    content[-3] ^= 1
    blob.write_bytes(content)
    with raises_key("model-broken"):
        load_model(f"owner/tiny{revision}", download=False)
    renamed = blob.with_name(sha256(content).hexdigest())  # other weights, of the same revision
    blob.rename(renamed)
    weights.unlink()
    weights.symlink_to(renamed)
    with raises_key("model-broken plgs.json"):
        load_model(f"owner/tiny{revision}", download=False)
    (cached / "refs" / "main").write_text(40 * "b")  # a later revision is not taken for the first
    with raises_key("model-broken plgs.json"):
        load_model(f"owner/tiny{revision}", download=False)
    with raises_key("not-downloaded"):
        load_model("owner/tiny@" + 40 * "b", download=False)
