"""The options of a lift, and the four presets. Standard library only."""
