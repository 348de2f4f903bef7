"""Anchors, decoders, growing and pruning."""
