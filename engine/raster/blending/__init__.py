"""Kernels that blend Gaussians on pixels front to back, and their gradients back to front, sixteen pixels at a time."""
