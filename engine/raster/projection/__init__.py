"""3D Gaussians to the picture's plane, and their gradients back; sixteen Gaussians side by side in LLVM's vectors."""
