"""Entropies against ones that are known."""

from __future__ import annotations

import numpy as np
import pytest

from bench.entropy import channel_bits, entropy
from packuv.scene.stream import channel_names
from tests.support.small_scene import small_segments

ROWS = 50_000


def test_context_tells_what_depends_on_it_and_no_more():
    rng = np.random.default_rng(0)
    context, noise = rng.integers(0, 4, ROWS), rng.integers(0, 8, ROWS)
    none = np.zeros(ROWS, int)
    assert entropy((context * 8 + noise).astype(np.uint8), none) == pytest.approx(5, abs=1e-3)
    assert entropy((context * 8 + noise).astype(np.uint8), context) == pytest.approx(3, abs=1e-3)
    # Counted plainly, 256 values in 17 contexts of 3,000 draws would seem to be 0.06 bits less.
    assert entropy(rng.integers(0, 256, ROWS).astype(np.uint8), rng.integers(0, 17, ROWS)) == pytest.approx(8, abs=5e-3)


def test_every_channel_of_a_key_and_of_a_change_is_told():
    segment = small_segments()[0]
    found = channel_bits(segment)
    assert list(found) == ["key", "change"]
    assert all(tuple(part) == channel_names(0) for part in found.values())
    assert set(found["change"]["opacity"]) - set(found["key"]["opacity"]) == {"given_last"}
    steps = np.diff(segment.xyz[:, :, 0].astype(int), axis=0)
    assert found["change"]["x_hi"]["entropy"] < 1 < found["change"]["x_lo"]["entropy"] < np.log2(np.ptp(steps) * 2)
