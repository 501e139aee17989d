"""CPU and GPU Gaussian rasterizers behind one function."""
