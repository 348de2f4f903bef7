"""Two implementations of the parts of a training step that have CPU kernels: these kernels, or torch on any device.

The rest of a step is torch in both. On a device, tensors stay there: only the losses are copied back, and one matrix
[instances, slots] for the linear assignment."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch.nn import functional

from ..model.gaussians import decode
from ..model.neural_gaussians import NeuralGaussians
from ..raster.rendering import Backend
from .label_losses import ThingSegments
from .optimiser import BETA_1, BETA_2, EPSILON, Moments, move_rows
from .similarity import C1, C2, REACH, WINDOW_WEIGHTS, PhotoMoments, compare
from .targets import ViewTargets


class Arithmetic(NamedTuple):
    """One implementation: functions that ``decode`` anchors, ``compare`` pictures and ``move_rows`` by Adam, the
    rasteriser's ``backend``, and ``place``, which moves a view's targets to a device."""

    decode: Callable[..., NeuralGaussians]
    backend: Backend
    compare: Callable[..., torch.Tensor]
    move_rows: Callable[..., None]
    place: Callable[[ViewTargets, torch.device], ViewTargets]


def compare_in_torch(
    image: torch.Tensor,  # [H, W, 3], 0 to 1
    photo: PhotoMoments | torch.Tensor,  # uint8 [H, W, 3]
    l1_weight: float,
    ssim_weight: float,
) -> torch.Tensor:
    """Return the loss that `similarity.compare` returns, for a photo without moments, which take memory."""
    assert isinstance(photo, torch.Tensor)  # as `place_in_torch` makes it
    y = photo.float() / 255.0
    planes = torch.cat([image, image * image, image * y, y, y * y], dim=2).permute(2, 0, 1)[:, None]
    window = torch.from_numpy(WINDOW_WEIGHTS.reshape(-1)).to(planes.device, non_blocking=True)
    across = functional.conv2d(planes, window.view(1, 1, 1, -1), padding=(0, REACH))  # zeros around the picture
    blurred = functional.conv2d(across, window.view(1, 1, -1, 1), padding=(REACH, 0))[:, 0].permute(1, 2, 0)
    mean, square, product, y_mean, y_square = blurred.split(3, dim=2)
    luminance = 2 * mean * y_mean + float(C1)
    structure = 2 * (product - mean * y_mean) + float(C2)
    variances = (square - mean * mean) + (y_square - y_mean * y_mean)
    ssim = luminance * structure / ((mean * mean + y_mean * y_mean + float(C1)) * (variances + float(C2)))
    return l1_weight * (image - y).abs().mean() + ssim_weight * ssim.mean()


@torch.no_grad()
def move_rows_in_torch(parameter: torch.Tensor, moments: Moments, rows: torch.Tensor, count: int, rate: float) -> None:
    """Do one Adam step for these ``rows`` of one parameter, as ``move_rows`` does, but in torch, on any device."""
    if parameter.grad is None:
        return
    step, root = rate / (1 - BETA_1 ** (count + 1)), math.sqrt(1 - BETA_2 ** (count + 1))
    value, mean, square, slope = (each.index_select(0, rows) for each in (parameter, *moments, parameter.grad))
    mean.mul_(BETA_1).add_(slope, alpha=1 - BETA_1)
    square.mul_(BETA_2).addcmul_(slope, slope, value=1 - BETA_2)
    value.addcdiv_(mean, (square.sqrt() / root).add_(EPSILON), value=-step)
    for whole, part in ((parameter, value), (moments[0], mean), (moments[1], square)):
        whole.index_copy_(0, rows, part)
    parameter.grad = None


def place_in_torch(target: ViewTargets, device: torch.device) -> ViewTargets:
    """Return a view's targets on ``device``, in types so small (uint8, int16) that those of all views can stay."""
    assert isinstance(target.photo, PhotoMoments)  # they were made on the CPU
    photo = torch.from_numpy(np.rint(target.photo.values * 255.0).astype(np.uint8)).to(device)
    row = torch.as_tensor(target.things.row).to(torch.int16).to(device)
    names = ("projected", "matched", "depth", "border", "gain", "pseudo", "pseudo_slot")
    moved = {name: each.to(device) for name in names if (each := getattr(target, name)) is not None}
    return replace(target, photo=photo, things=ThingSegments(row, target.things.pixels), **moved)


KERNELS = Arithmetic(decode, "numba", compare, move_rows, lambda target, device: target)
IN_TORCH = Arithmetic(partial(decode, in_torch=True), "gsplat", compare_in_torch, move_rows_in_torch, place_in_torch)
