"""What code values mean: published curves from a video's signal to light, and primaries to those of BT.709.

Light is relative: 1 is the white that sRGB shows at most. Scene light is exposed so that a grey card of 18 % lands at
0.18, as every camera's document defines its curve; PQ, whose light is that of a display, so that its reference white is
1. Lights above 1 are cut off when the picture becomes sRGB: nothing below is bent to make room for them.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

import numpy as np

from packuv.colour import linear_from_srgb


class Transfer(StrEnum):
    """How a camera turned light into signal."""

    SDR = "sdr"
    """A finished picture, shown as it is: BT.709, BT.601, sRGB"""
    HLG = "hlg"
    PQ = "pq"
    SLOG3 = "slog3"
    VLOG = "vlog"
    CLOG3 = "clog3"
    LOGC3 = "logc3"
    LOGC4 = "logc4"
    LOG3G10 = "log3g10"
    LINEAR = "linear"
    """Light itself"""


CODE_CURVES = frozenset({Transfer.SLOG3, Transfer.VLOG, Transfer.CLOG3})
"""Curves that their documents state for the code value as recorded over 1023, black of video being 64, not for a signal
from 0 (black of video) to 1: S-Log3 puts 18 % grey at code 420, which is a signal of 0.406"""

Primaries = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""CIE xy of red, green and blue"""

BT709: Primaries = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060))
BT2020: Primaries = ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046))
P3: Primaries = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))
D65 = (0.3127, 0.3290)
"""White of all primaries here, so that nothing need be adapted"""

CAMERA_PRIMARIES: dict[Transfer, Primaries] = {
    Transfer.SLOG3: ((0.766, 0.275), (0.225, 0.800), (0.089, -0.087)),  # S-Gamut3.Cine
    Transfer.VLOG: ((0.730, 0.280), (0.165, 0.840), (0.100, -0.030)),  # V-Gamut
    Transfer.CLOG3: ((0.740, 0.270), (0.170, 1.140), (0.080, -0.100)),  # Cinema Gamut
    Transfer.LOGC3: ((0.6840, 0.3130), (0.2210, 0.8480), (0.0861, -0.1020)),  # ARRI Wide Gamut 3
    Transfer.LOGC4: ((0.7347, 0.2653), (0.1424, 0.8576), (0.0991, -0.0308)),  # ARRI Wide Gamut 4
    Transfer.LOG3G10: ((0.780308, 0.304253), (0.121595, 1.493994), (0.095612, -0.084589)),  # REDWideGamutRGB
}
"""Each log curve with the primaries that its camera records beside it, whatever the stream is tagged with"""


def light_from_signal(transfer: Transfer, signal: np.ndarray) -> np.ndarray:
    """Relative light, float64, of a signal: 0 is black of video, 1 its white; footroom and headroom lie beyond."""
    value = np.asarray(signal, dtype=np.float64)
    if transfer in CODE_CURVES:
        value = (64 + 876 * value) / 1023
    light: np.ndarray = _CURVES[transfer](value)
    return light


def bt709_from(primaries: Primaries) -> np.ndarray:
    """float64 [3, 3]: linear RGB of BT.709 from linear RGB of other primaries with the same white."""
    found: np.ndarray = np.linalg.solve(_xyz_from(BT709), _xyz_from(primaries))
    return found


def _xyz_from(primaries: Primaries) -> np.ndarray:
    """float64 [3, 3]: CIE XYZ from linear RGB, white having Y = 1 (SMPTE RP 177)."""
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in primaries]).T
    x, y = D65
    scale = np.linalg.solve(columns, [x / y, 1, (1 - x - y) / y])
    xyz: np.ndarray = columns * scale
    return xyz


def _sdr(signal: np.ndarray) -> np.ndarray:
    return linear_from_srgb(np.clip(signal, 0, 1))


def _hlg(signal: np.ndarray) -> np.ndarray:
    """ITU-R BT.2100-2, table 5, scene light; white at 75 % signal and a grey card at 38 % as in ITU-R BT.2408-7."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073

    def scene(value: np.ndarray) -> np.ndarray:
        value = np.clip(value, 0, None)
        return np.where(value <= 0.5, value**2 / 3, (np.exp((value - c) / a) + b) / 12)

    light: np.ndarray = scene(signal) / scene(np.array(0.75))
    return light


def _pq(signal: np.ndarray) -> np.ndarray:
    """SMPTE ST 2084, display light; its white is 203 cd/m2 as in ITU-R BT.2408-7."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    root = np.clip(signal, 0, 1) ** (1 / m2)
    light: np.ndarray = 10000 / 203 * (np.clip(root - c1, 0, None) / (c2 - c3 * root)) ** (1 / m1)
    return light


def _slog3(code: np.ndarray) -> np.ndarray:
    """Sony, Technical Summary for S-Gamut3.Cine/S-Log3 and S-Gamut3/S-Log3 (2014), appendix."""
    value, cut = 1023 * code, 171.2102946929
    return np.where(value >= cut, 10 ** ((value - 420) / 261.5) * 0.19 - 0.01, (value - 95) * 0.01125 / (cut - 95))


def _vlog(code: np.ndarray) -> np.ndarray:
    """Panasonic, V-Log/V-Gamut Reference Manual, rev. 1.0 (2014)."""
    return np.where(code < 0.181, (code - 0.125) / 5.6, 10 ** ((code - 0.598206) / 0.241514) - 0.00873)


def _clog3(code: np.ndarray) -> np.ndarray:
    """Canon, Canon Log Gamma Curves, version 1.2 (2020); its light counts 90 % reflectance as 1."""
    span, slope = 0.36726845, 14.98325
    low = -(10 ** ((0.12783901 - code) / span) - 1) / slope
    middle, high = (code - 0.12512219) / 1.9754798, (10 ** ((code - 0.12240537) / span) - 1) / slope
    return 0.9 * np.where(code < 0.097465473, low, np.where(code <= 0.15277891, middle, high))


def _logc3(signal: np.ndarray) -> np.ndarray:
    """ARRI, ALEXA Log C Curve: Usage in VFX (2017), scene light at EI 800; other indices differ in the shadows."""
    a, b, c, d, e, f, cut = 5.555556, 0.052272, 0.247190, 0.385537, 5.367655, 0.092809, 0.010591
    return np.where(signal > e * cut + f, (10 ** ((signal - d) / c) - b) / a, (signal - f) / e)


def _logc4(signal: np.ndarray) -> np.ndarray:
    """ARRI, LogC4 Logarithmic Color Space Specification (2023), section 4.1.2."""
    a, b, c = (2**18 - 16) / 117.45, (1023 - 95) / 1023, 95 / 1023
    s = 7 * np.log(2) * 2 ** (7 - 14 * c / b) / (a * b)
    t = (2 ** (14 * (-c / b) + 6) - 64) / a
    return np.where(signal < 0, signal * s + t, (2 ** (14 * (signal - c) / b + 6) - 64) / a)


def _log3g10(signal: np.ndarray) -> np.ndarray:
    """RED, White Paper on REDWideGamutRGB and Log3G10, 915-0187 rev. C (2018)."""
    a, b, c, g = 0.224282, 155.975327, 0.01, 15.1927
    return np.where(signal < 0, signal / g, (10 ** (signal / a) - 1) / b) - c


_CURVES: dict[Transfer, Callable[[np.ndarray], np.ndarray]] = {
    Transfer.SDR: _sdr,
    Transfer.HLG: _hlg,
    Transfer.PQ: _pq,
    Transfer.SLOG3: _slog3,
    Transfer.VLOG: _vlog,
    Transfer.CLOG3: _clog3,
    Transfer.LOGC3: _logc3,
    Transfer.LOGC4: _logc4,
    Transfer.LOG3G10: _log3g10,
    Transfer.LINEAR: np.array,
}
