"""Results that tests of the tables share."""

from __future__ import annotations

from engine.experiments.figures import Figures, SceneResult
from engine.metrics import LIFTED, MACHINE_MASKS, VOXEL_VOTE

OFFICE = SceneResult(
    scene="office",
    preset="preview",
    steps=500,
    seed=0,
    engine_version="0.1.0",
    rows={
        MACHINE_MASKS: Figures(miou=0.5, pq=0.25, miou_pl_compat=0.51, pq_pl_compat=0.26),
        VOXEL_VOTE: Figures(miou=0.75, pq=0.5, miou_pl_compat=0.76, pq_pl_compat=0.51),
        LIFTED: Figures(0.8, 0.7, 0.81, 0.71, 27.0, 28.5, 0.875, 0.0234, 161.6),
    },
)
KITCHEN = SceneResult(
    scene="kitchen",
    preset="preview",
    steps=500,
    seed=0,
    engine_version="0.1.0",
    rows={LIFTED: Figures(psnr=17.0, psnr_fitted=21.0, ssim=0.6, depth_error_m=0.05, seconds=99.5)},
)
