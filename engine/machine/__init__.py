"""The basis of the compiled kernels: compilation for this machine, threads, memory, and vectors of sixteen numbers."""
