"""Losses, presets, schedule, the trainer and its state."""
