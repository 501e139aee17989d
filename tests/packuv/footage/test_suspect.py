"""Log footage that nobody called so is suspected; finished pictures are not."""

from __future__ import annotations

import numpy as np
import pytest

from packuv.colour import srgb_from_linear
from packuv.footage.suspect import looks_like_log
from packuv.footage.transfer import CAMERA_PRIMARIES, Transfer, bt709_from, light_from_signal


def studio() -> np.ndarray:
    """Linear light of a stage with grey walls, clothes in colour, a white shirt, dark hair."""
    rng = np.random.default_rng(0)
    light = np.empty((120, 160, 3))
    light[:] = np.linspace(0.12, 0.4, 160)[None, :, None]
    light[40:100, 60:75] = (0.35, 0.08, 0.07)
    light[40:70, 85:100] = 0.85
    light[30:40, 60:75] = 0.02
    return light * rng.normal(1, 0.03, light.shape)


@pytest.mark.parametrize("transfer", sorted(CAMERA_PRIMARIES))
@pytest.mark.parametrize("stops", [-1, 0, 1])
def test_log_is_suspected(transfer: Transfer, stops: int) -> None:
    signal = np.linspace(-0.07, 1.09, 20_001)
    light = 2.0**stops * studio() @ np.linalg.inv(bt709_from(CAMERA_PRIMARIES[transfer])).T
    recorded = np.interp(light, light_from_signal(transfer, signal), signal)
    assert looks_like_log(np.rint(255 * recorded.clip(0, 1)).astype(np.uint8))


@pytest.mark.parametrize("gain", [0.8, 1.0, 1.5])
def test_finished_pictures_are_not(gain: float) -> None:
    assert not looks_like_log(np.rint(255 * srgb_from_linear(gain * studio())).astype(np.uint8))
