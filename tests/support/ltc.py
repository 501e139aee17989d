"""A sound track with linear timecode, written bit by bit as SMPTE ST 12-1 says."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

SAMPLES = 48_000
SYNC = [0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 1]


def word(label: str) -> list[int]:
    """The 80 bits of HH:MM:SS:FF, or HH:MM:SS;FF."""
    bits = [0] * 64
    digits = [int(digit) for digit in label if digit.isdigit()]
    for value, first, width in zip(digits, (56, 48, 40, 32, 24, 16, 8, 0), (2, 4, 3, 4, 3, 4, 2, 4), strict=True):
        for bit in range(width):
            bits[first + bit] = value >> bit & 1
    bits[10] = int(";" in label)
    return bits + SYNC


def wave(labels: list[str], rate: Fraction, *, lead_s: float = 0.0, samples: int = SAMPLES) -> np.ndarray:
    """float32 [n]: these labels one after another, each as long as a frame; `lead_s` of the frame before is cut off,
    so that the first whole one begins so much later."""
    bits = np.array([bit for label in labels for bit in word(label)])
    halves = np.stack([np.ones(len(bits), np.int64), bits], axis=1).ravel()  # whether the wave turns before each half
    level = 1.0 - 2.0 * (np.cumsum(halves) % 2)
    times = np.arange(int((len(labels) / rate + Fraction(lead_s)) * samples)) / samples - lead_s
    place = np.floor(times * float(rate) * 160).astype(np.int64)
    return np.where(place >= 0, level[np.clip(place, 0, len(level) - 1)], 0.0).astype(np.float32)
