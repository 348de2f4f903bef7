"""Scenes that are larger than a machine: cut into blocks, each lifted by itself, and joined into one result."""
