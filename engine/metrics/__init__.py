"""mIoU and PQ-scene in two modes, ``strict`` and ``pl_compat``; PSNR, SSIM and the depth error."""
