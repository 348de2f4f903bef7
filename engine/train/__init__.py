"""Training of the structured Gaussians: losses, targets, optimiser, schedule, and the trainer with its state."""
