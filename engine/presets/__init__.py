"""The options of a lift, and the three presets. Standard library only."""
