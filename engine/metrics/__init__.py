"""mIoU and PQ-scene in two modes, ``strict`` and ``pl_compat``; PSNR, SSIM and the error of depth."""

from __future__ import annotations

from .depths import DepthErrors
from .images import PictureScores, fit_colours, psnr, score_picture, ssim
from .panoptic import MODES, ClassScore, Mode, PanopticEvaluation, PanopticScores
from .report import LIFTED, MACHINE_MASKS, VOXEL_VOTE, PredictedView, Report, add_rivals
from .voxel_vote import VoxelMap, VoxelVote

__all__ = [
    "LIFTED",
    "MACHINE_MASKS",
    "MODES",
    "VOXEL_VOTE",
    "ClassScore",
    "DepthErrors",
    "Mode",
    "PanopticEvaluation",
    "PanopticScores",
    "PictureScores",
    "PredictedView",
    "Report",
    "VoxelMap",
    "VoxelVote",
    "add_rivals",
    "fit_colours",
    "psnr",
    "score_picture",
    "ssim",
]
