"""The panel's engine tasks, one kind per module. `lifting` starts them from the panel's settings."""
