"""Selection of rows of a tensor without repetitions: the backward pass is then a plain copy.

PyTorch's own indexing must expect repeated rows and adds them up one by one, which takes longer than the decoders.
"""

from __future__ import annotations

from typing import Any

import torch


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = tensor.shape
        return tensor.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        (rows,) = ctx.saved_tensors
        (gradient,) = gradients
        return gradient.new_zeros(ctx.shape).index_copy_(0, rows, gradient), None


def take_rows(tensor: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """``tensor[rows]`` for int64 ``rows`` [N] without repetitions (not checked: a repeated row would lose gradient)."""
    taken: torch.Tensor = _TakeRows.apply(tensor, rows)
    return taken
