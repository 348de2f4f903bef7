"""The engine's tasks that the panel starts, one kind per module. `lifting` starts them from the panel's settings."""
