"""Encodings: drawn like colours, classified pixel by pixel, and stored with the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.model.baking import bake
from engine.model.gaussians import decode
from engine.model.render import render_bands, render_view
from engine.model.structured import NO_OBJECT, StructuredScene, from_tensors, to_tensors
from engine.raster import rasterize
from research.baselines.encodings import EncodedDecoders, EncodedShape
from tests.model.some_scene import CAMERA, SHAPE, some_scene

SLOTS = (4, NO_OBJECT, 9, 6, 11)
ENCODED = EncodedShape(**vars(SHAPE), encoding=6)


def encoded_scene(class_of_slot: tuple[int, ...] = ()) -> StructuredScene:
    scene = some_scene(SLOTS, class_of_slot=class_of_slot)
    return replace(scene, decoders=EncodedDecoders(ENCODED, 3))


def test_the_classifier_labels_a_pixel_by_its_blend() -> None:
    scene = encoded_scene()
    assert isinstance(scene.decoders, EncodedDecoders)
    drawn = decode(scene.anchors, scene.decoders, CAMERA)
    assert drawn.labels.shape[1] == len(scene.channels.class_ids) + ENCODED.encoding
    pose, intrinsics = torch.from_numpy(CAMERA.camera_to_world).float(), torch.from_numpy(CAMERA.K).float()
    shapes = (drawn.means, drawn.scales, drawn.quats, drawn.opacities, drawn.colours)
    rendering = rasterize(*shapes, drawn.labels, pose, intrinsics, CAMERA.width, CAMERA.height, backend="reference")
    assert rendering.labels is not None
    covered = rendering.alpha.detach().numpy() > 0.05
    blend = (rendering.labels[..., 3:] / rendering.alpha[..., None])[torch.from_numpy(covered)]
    wanted = scene.decoders.classifier(blend).softmax(dim=1).detach().numpy()
    shown = render_view(scene, CAMERA)
    found = shown.instance_coverage[covered] / shown.alpha[covered][:, None]
    np.testing.assert_allclose(found, wanted[:, [0, 2, 3, 4]], atol=2e-3)  # without "no object"
    np.testing.assert_allclose(shown.class_coverage.sum(axis=2), shown.alpha, atol=1e-5)


def test_bands_and_baked_gaussians_are_classified_too() -> None:
    scene = encoded_scene(class_of_slot=(2, 0, 5, 7, 7))
    whole = render_view(scene, CAMERA)
    bands = list(render_bands(scene, CAMERA, most_bytes=1))
    assert len(bands) > 1
    for name in ("class_coverage", "instance_coverage"):
        put_together = np.concatenate([getattr(band, name) for band in bands])
        np.testing.assert_allclose(put_together, getattr(whole, name), atol=1e-5)
    gaussians, _ = bake(scene, np.zeros(3), frozenset(scene.channels.class_ids))
    assert len(set(gaussians.instance_id.tolist()) & {4, 9, 6, 11}) > 1


def test_a_model_with_a_classifier_comes_back() -> None:
    scene = encoded_scene()
    tensors, facts = to_tensors(scene)
    again = from_tensors(tensors, facts)
    assert isinstance(again.decoders, EncodedDecoders) and again.decoders.shape == ENCODED
    for name, tensor in scene.decoders.state_dict().items():
        assert torch.equal(tensor, again.decoders.state_dict()[name])
    with pytest.raises(ValueError, match="classifier"):
        from_tensors({key: value for key, value in tensors.items() if "classifier" not in key}, facts)
    with pytest.raises(ValueError, match="encoding"):
        from_tensors(tensors, {**facts, "decoders": {**facts["decoders"], "encoding": 10_000}})  # type: ignore[dict-item]


def test_models_without_an_encoding_are_as_before() -> None:
    _, facts = to_tensors(some_scene(SLOTS))
    assert "encoding" not in facts["decoders"]  # type: ignore[operator]
