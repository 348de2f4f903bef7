"""What engines do for the panel, one kind of task per module. `lifting` starts from the panel's settings."""
