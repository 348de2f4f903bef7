"""mIoU, PQ-scene, PSNR and SSIM, in two modes: ``strict`` and ``pl_compat``."""

from __future__ import annotations

from .images import psnr, ssim
from .panoptic import MODES, ClassScore, Mode, PanopticEvaluation, PanopticScores
from .report import LIFTED, MACHINE_MASKS, VOXEL_VOTE, PredictedView, Report, add_rivals
from .voxel_vote import VoxelMap, VoxelVote

__all__ = [
    "LIFTED",
    "MACHINE_MASKS",
    "MODES",
    "VOXEL_VOTE",
    "ClassScore",
    "Mode",
    "PanopticEvaluation",
    "PanopticScores",
    "PredictedView",
    "Report",
    "VoxelMap",
    "VoxelVote",
    "add_rivals",
    "psnr",
    "ssim",
]
