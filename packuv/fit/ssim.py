"""What SSIM is about, on the CPU and on a GPU: Wang et al. 2004 with the numbers of 3D Gaussian Splatting."""

from __future__ import annotations

import numpy as np

RADIUS = 5
"""Of the window, pixels"""
_weights = np.exp(-((np.arange(2 * RADIUS + 1) - RADIUS) ** 2) / (2 * 1.5**2))
WINDOW = (_weights / _weights.sum()).astype(np.float32)
"""float32 [11]: weights along either axis, a Gaussian of sigma 1.5"""
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
"""Which keep quotients from growing where means or variances are nearly 0"""
