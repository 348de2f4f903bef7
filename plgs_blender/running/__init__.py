"""What engines do for the panel, a kind of task in each module. `lifting` starts from what the panel says."""
