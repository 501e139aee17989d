"""Fit Gaussians to the pictures of many cameras: keyframes, and the frames between them (paper §4.2)."""
