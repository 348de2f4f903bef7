"""Lifts that this Blender follows: `lifts` is the state machine without Blender, `poll_timer` polls it from Blender."""
