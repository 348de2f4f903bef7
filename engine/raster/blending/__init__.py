"""Blending of Gaussians on pixels front to back, and of their gradients back to front, sixteen pixels at a time."""
