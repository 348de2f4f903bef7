"""How long the engine's parts take on this machine, and how much memory they need."""
