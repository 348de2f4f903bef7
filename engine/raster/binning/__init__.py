"""Which Gaussians each tile of the picture draws, front to back."""
