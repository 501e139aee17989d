"""The CUDA rasterizer: numba-cuda kernels that draw what the CPU's draw, and their gradients."""
