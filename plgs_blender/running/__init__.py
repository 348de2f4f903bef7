"""Lifts that this Blender follows: `lifts` is the state machine without Blender, `watch` ticks it from a timer."""
