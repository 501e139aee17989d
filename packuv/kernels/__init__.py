"""How kernels are compiled, and the SIMD lanes that they compute with."""
