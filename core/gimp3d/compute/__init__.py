"""How the work is done on a CPU: compiled kernels, SIMD vectors, threads."""
