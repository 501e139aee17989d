"""PackUV: Gaussians in a multi-scale UV atlas, fitted from many cameras, coded as lossless video."""
