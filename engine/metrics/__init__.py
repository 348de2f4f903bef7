"""Metrics: mIoU and PQ-scene in two modes (``strict``, ``pl_compat``), PSNR, SSIM, depth error, and calibration."""
