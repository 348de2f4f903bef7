"""Gaussians to pixels, tile by tile, and gradients back: plain kernels; in ``vector`` their fast twins."""
