"""The model of a scene: anchors, decoders, growing and pruning, rendering, and voted labels."""
