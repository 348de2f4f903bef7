"""The cluster loss against the plain formula."""

from __future__ import annotations

import torch

from engine.model.torch_decoding import cluster_loss


def test_cluster_loss_counts_every_gaussian_of_labelled_anchors_only() -> None:
    logits = torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(2))
    target = torch.tensor([0, -1, 2, -1])
    log = torch.log_softmax(logits, dim=2)
    expected = -(log[0, :, 0].sum() + log[2, :, 2].sum()) / 4
    torch.testing.assert_close(cluster_loss(logits, target), expected)
