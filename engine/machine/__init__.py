"""What compiled kernels stand on: compiled for this machine, its threads, its memory, sixteen numbers at a time."""
