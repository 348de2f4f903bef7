"""Gaussians on pixels: blended front to back, and their gradients back to front. Sixteen pixels side by side."""
