"""mIoU, PQ-scene, PSNR and SSIM, in two modes: ``strict`` and ``pl_compat``."""

from __future__ import annotations

from .images import psnr, ssim
from .panoptic import MODES, ClassScore, Mode, PanopticEvaluation, PanopticScores

__all__ = ["MODES", "ClassScore", "Mode", "PanopticEvaluation", "PanopticScores", "psnr", "ssim"]
