"""Curves give the values that their documents tabulate."""

from __future__ import annotations

import numpy as np
import pytest

from packuv.colour import srgb_from_linear
from packuv.footage.transfer import BT709, BT2020, CAMERA_PRIMARIES, Transfer, bt709_from, light_from_signal

HALF_A_CODE = 0.5 / 1023
"""Documents round code values to whole ones of 10 bits"""
SIGNAL = np.linspace(-0.07, 1.09, 4001)


def signal(code: float) -> float:
    """Of a 10-bit code value in limited range."""
    return (code - 64) / 876


def encoded(transfer: Transfer, light: float) -> float:
    """The signal of a light, by search."""
    return float(np.interp(light, light_from_signal(transfer, SIGNAL), SIGNAL))


@pytest.mark.parametrize(
    ("transfer", "light", "expected"),
    [
        (Transfer.SLOG3, 0.0, signal(95)),
        (Transfer.SLOG3, 0.18, signal(420)),
        (Transfer.SLOG3, 0.90, signal(598)),
        (Transfer.VLOG, 0.0, signal(128)),
        (Transfer.VLOG, 0.18, signal(433)),
        (Transfer.VLOG, 0.90, signal(602)),
        (Transfer.CLOG3, 0.0, signal(128)),
        (Transfer.CLOG3, 0.18, signal(351)),
        (Transfer.CLOG3, 0.90, signal(577)),
        (Transfer.LOGC3, 0.18, 400 / 1023),
        (Transfer.LOGC3, 0.0, 0.0928),
        (Transfer.LOGC4, 0.0, 95 / 1023),
        (Transfer.LOGC4, 0.18, 0.2784),
        (Transfer.LOG3G10, 0.18, 1 / 3),
        (Transfer.LOG3G10, -0.01, 0.0),
        (Transfer.HLG, 1.0, 0.75),
        (Transfer.HLG, 0.18, 0.378),
        (Transfer.PQ, 1.0, 0.5807),
        (Transfer.PQ, 100 / 203, 0.5081),
        (Transfer.SDR, 0.5, 0.7354),
    ],
)
def test_published_values(transfer: Transfer, light: float, expected: float) -> None:
    assert encoded(transfer, light) == pytest.approx(expected, abs=2 * HALF_A_CODE)


@pytest.mark.parametrize("transfer", sorted(CAMERA_PRIMARIES))
def test_a_grey_card_lands_where_srgb_has_it(transfer: Transfer) -> None:
    grey = 255 * srgb_from_linear(light_from_signal(transfer, np.array(encoded(transfer, 0.18))))
    assert grey == pytest.approx(117.6, abs=0.1)


@pytest.mark.parametrize("transfer", [*Transfer])
def test_more_signal_is_never_less_light(transfer: Transfer) -> None:
    steps = np.diff(light_from_signal(transfer, SIGNAL))
    assert (steps >= 0).all()
    assert (steps[(SIGNAL[1:] > 0.15) & (SIGNAL[1:] < 1)] > 0).all()


@pytest.mark.parametrize("primaries", [BT709, BT2020, *CAMERA_PRIMARIES.values()])
def test_white_stays_white(primaries: tuple[tuple[float, float], ...]) -> None:
    assert np.allclose(bt709_from(primaries) @ np.ones(3), 1, rtol=0, atol=1e-12)  # type: ignore[arg-type]


def test_bt2020_to_bt709_is_that_of_itu_r_bt_2407() -> None:
    published = [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
    assert np.allclose(bt709_from(BT2020), published, rtol=0, atol=6e-5)
