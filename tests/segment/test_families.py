"""Every family of networks with random weights: transformers' own loading and outputs, no download."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

transformers = pytest.importorskip("transformers", reason="needs transformers (requirements/segment.txt)")

from engine.command_line.main import main  # noqa: E402
from engine.mask_networks import load_model  # noqa: E402
from engine.scene import open_scene  # noqa: E402
from engine.segment import merge_queries  # noqa: E402
from tests.raises_key import raises_key  # noqa: E402
from tests.segment.tiny_mask2former import NAMES  # noqa: E402
from tests.tiny_scene import write_tiny_scene  # noqa: E402

LABELS = {"id2label": dict(enumerate(NAMES)), "label2id": {name: number for number, name in enumerate(NAMES)}}
SWIN = {
    "image_size": 64, "embed_dim": 8, "depths": [1, 1, 1, 1], "num_heads": [1, 1, 1, 1], "window_size": 2,
    "out_features": ["stage1", "stage2", "stage3", "stage4"],
}  # fmt: skip


def save_oneformer(folder: Path) -> None:
    config = transformers.OneFormerConfig(
        backbone_config=transformers.SwinConfig(**SWIN), hidden_dim=32, conv_dim=32, mask_dim=32, num_queries=10,
        encoder_feedforward_dim=16, dim_feedforward=16, encoder_layers=1, decoder_layers=2, num_attention_heads=2,
        query_dec_layers=1, text_encoder_width=16, text_encoder_num_layers=1, text_encoder_vocab_size=300,
        is_training=False, **LABELS,
    )  # fmt: skip
    transformers.OneFormerForUniversalSegmentation(config).save_pretrained(folder)
    classes = folder / "classes.json"
    classes.write_text(json.dumps({str(i): {"name": name, "isthing": int(i > 1)} for i, name in enumerate(NAMES)}))
    transformers.OneFormerImageProcessorPil(
        size={"shortest_edge": 64, "longest_edge": 96}, repo_path=str(folder), class_info_file="classes.json"
    ).save_pretrained(folder)
    letters = "the task is panoptic".replace(" ", "")
    tokens = [*dict.fromkeys(letters), *(f"{letter}</w>" for letter in dict.fromkeys(letters))]
    vocabulary = {token: i for i, token in enumerate([*tokens, "<|startoftext|>", "<|endoftext|>"])}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer"}))


def save_eomt(folder: Path) -> None:
    config = transformers.EomtConfig(
        hidden_size=32, num_hidden_layers=3, num_attention_heads=2, image_size=64, patch_size=8, num_blocks=1,
        num_queries=10, num_upscale_blocks=1, num_register_tokens=1, **LABELS,
    )  # fmt: skip
    transformers.EomtForUniversalSegmentation(config).save_pretrained(folder)
    transformers.EomtImageProcessorPil(size={"shortest_edge": 64, "longest_edge": 64}).save_pretrained(folder)


def save_rf_detr(folder: Path) -> None:
    backbone = transformers.RfDetrDinov2Config(
        hidden_size=32, num_hidden_layers=3, num_attention_heads=2, image_size=64, patch_size=8, num_windows=2,
        out_indices=[1, 2, 3],
    )  # fmt: skip
    config = transformers.RfDetrConfig(
        backbone_config=backbone, d_model=32, num_queries=12, group_detr=1, decoder_layers=2, decoder_ffn_dim=32,
        decoder_self_attention_heads=2, decoder_cross_attention_heads=2, **LABELS,
    )  # fmt: skip
    transformers.RfDetrForInstanceSegmentation(config).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps({"size": {"width": 64, "height": 64}}))


FAMILIES: dict[str, Callable[[Path], None]] = {"oneformer": save_oneformer, "eomt": save_eomt, "rf_detr": save_rf_detr}


@pytest.fixture(scope="module", params=FAMILIES)
def model(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(5)
    folder = tmp_path_factory.mktemp(request.param)
    FAMILIES[request.param](folder)
    return folder


def test_engine_segment_makes_masks_with_each_family_of_networks(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_tiny_scene(tmp_path / "scene", frames=3, size=(64, 48), ground_truth=False, masks="none")
    assert main(["segment", str(folder), "--model", str(model)]) == 0
    assert "licence" in capsys.readouterr().err
    scene = open_scene(folder, detections=folder / "detections.json")
    assert scene.has_masks and [one.name for one in scene.classes.categories] == NAMES
    assert "licence" in json.loads((folder / "panoptic" / "made_by.json").read_text())


def test_mask_networks_see_exactly_the_whole_picture(model: Path) -> None:
    """A picture that is wide or high fills the masks: what a processor pads is cut off."""
    network = load_model(str(model), download=False)
    for shape in ((48, 96, 3), (96, 48, 3)):
        colour = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
        with torch.inference_mode():
            classes, masks = network.queries(colour)
        assert classes.shape[1] == len(NAMES) + 1 and len(masks) == len(classes)
        if classes.isfinite().all():  # not RF-DETR, which squeezes pictures into its square
            assert (masks.shape[-1] > masks.shape[-2]) == (shape[1] > shape[0])
        ids, _, detections = network.segment(colour)
        assert ids.shape == shape[:2] and all(one.pixels.shape == shape[:2] for one in detections)


@pytest.mark.parametrize(
    "settings",
    [
        {"size": {"width": 0, "height": 64}}, {"size": {"width": 64, "height": -56}}, {"image_mean": [0.5, 0.5]},
        {"image_std": None},
    ],
)  # fmt: skip
def test_unusable_preprocessor_settings_are_the_models_fault(settings: dict[str, object], tmp_path: Path) -> None:
    save_rf_detr(tmp_path)
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(settings))
    with raises_key("model-unusable"):
        load_model(str(tmp_path), download=False)


def test_a_network_that_makes_no_masks_is_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    (tmp_path / "config.json").write_text(json.dumps({"model_type": "bert", "id2label": {"0": "chair"}}))
    save_file({"a": torch.zeros(1)}, tmp_path / "model.safetensors")
    with raises_key("model-kind bert"):
        load_model(str(tmp_path), download=False)


def test_a_second_round_of_segmentation_fills_empty_pixels() -> None:
    """Three queries: a sure one on the left, an unsure one on the right, and an unsure one over the sure one."""
    scores = torch.tensor([0.9, 0.4, 0.3])
    logits = torch.full((3, 3), -torch.inf)
    logits[:, 1], logits[:, 2] = scores.log(), (1 - scores).log()
    logits[1] = torch.tensor([0.4, 0.3, 0.3]).log()
    masks = torch.zeros(3, 4, 8)
    masks[0, :, :4] = masks[1, :, 4:] = masks[2, :, :4] = 0.9
    once, found = merge_queries(logits, masks, frozenset())
    assert {*np.unique(once).tolist()} == {0, 1} and len(found) == 1
    twice, both = merge_queries(logits, masks, frozenset(), (0.5, 0.25))
    assert (twice[:, :4] == 1).all() and (twice[:, 4:] == 2).all()
    assert [(one.label, round(one.score, 2)) for one in both] == [(1, 0.9), (0, 0.4)]
