"""What compiled kernels need: compilation for this machine, threads, memory, and vectors of sixteen numbers."""
