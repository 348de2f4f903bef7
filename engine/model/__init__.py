"""Anchors, decoders, growth and pruning."""
