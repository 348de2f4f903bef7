"""How a lift is done: the three presets and all their options. Standard library only."""
