"""How a lift is done: the three presets and all their options. It uses only the standard library."""
