"""sRGB and linear light undo each other, in the precision that comes in."""

from __future__ import annotations

import numpy as np
import pytest

from packuv.colour import linear_from_srgb, srgb_from_linear


@pytest.mark.parametrize(("kind", "tolerance"), [(np.float32, 1e-6), (np.float64, 1e-7)])  # 0.04045 is itself rounded
def test_there_and_back(kind, tolerance):
    value = np.linspace(0, 1, 4097, dtype=kind)
    light = linear_from_srgb(value)
    assert light.dtype == srgb_from_linear(light).dtype == kind
    assert (np.diff(light) > 0).all()
    assert np.abs(srgb_from_linear(light) - value).max() < tolerance


def test_light_beyond_white_is_cut_off():
    assert srgb_from_linear(np.array([-0.5, 1.5])) == pytest.approx([0, 1])
