"""How the light of a room changes over time, the same for all cameras, and each camera's own exposure.

A camera's brightness over that of its reference (`packuv.footage.ratios`) is light of the instant times its own
exposure. What most fitted cameras have in common is light; what else a camera has is its own, if all parts of its
picture have it and it is well above the rest's. Where cameras do not confirm one another, light is steady.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from packuv.bounds import MOST_FRAMES, MOST_LIGHT, shown
from packuv.files import open_npz, save_npz
from packuv.footage.ratios import Ratios, measure_ratios
from packuv.footage.reader import FrameReader
from packuv.progress import Progress, no_progress

STEPS = 100_000
"""Logarithms are kept in steps of 1 / STEPS, as scene files hold them"""
ROUNDS = 10
"""Levels and light in turn; cameras that start late settle within these"""
FOLDS = 6
"""Groups of cameras that are left out one after another"""
JUDGED = 4000
"""Instants, spread over the recording, by which light is judged, at most"""
FINEST = 0.001
"""Deviation between cameras below which none is doubted"""


@dataclass(frozen=True)
class LightOptions:
    """How light of the instant and the cameras' own exposures are measured, and when they count."""

    enabled: bool = True
    """Off, light and exposures are taken for steady"""
    width: int = 160
    """Pictures are compared at most this wide, pixels: thousands of steady pixels are as exact as millions"""
    samples: int = 15
    """Instants, spread over the recording, that show what stands still"""
    least_light: float = 0.002
    """Deviation over time, as a share, below which light is steady: a quarter of a grey level"""
    most_left: float = 0.9
    """Of the deviation of cameras left out, what light from the others may leave; more, and it explains nothing"""
    least_exposure: float = 0.01
    """Deviation over time, as a share, below which a camera has no exposure of its own: soft shadows reach 0.6 %"""
    exposure_sigmas: float = 3.0
    """It must be this many times as large as what the parts of the picture differ by"""

    def __post_init__(self) -> None:
        if self.width < 16 or self.samples < 1:
            raise ValueError(
                "light needs pictures 16 px wide, and a sample, but "
                f"light.width is {self.width}, light.samples {self.samples}"
            )
        if min(self.least_light, self.least_exposure, self.exposure_sigmas) < 0:
            raise ValueError("least_light, least_exposure and exposure_sigmas must not be negative")
        if not 0 < self.most_left <= 1:
            raise ValueError(f"most_left must lie in (0, 1], but is {self.most_left}")


@dataclass(frozen=True)
class Light:
    """Natural logarithms of factors on linear light, each with mean 0 over the instants."""

    light: np.ndarray
    """float32 [T, 3]: of the instant, r g b; all 0 where it is steady"""
    exposures: Mapping[str, np.ndarray] = field(default_factory=dict)
    """float32 [T, 3] of each camera that has an exposure of its own"""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """How they were measured, for a receipt"""

    def __post_init__(self) -> None:
        for name, values in {"light": self.light, **self.exposures}.items():
            if values.shape != (len(self.light), 3):
                raise ValueError(f"{name} must be [{len(self.light)}, 3] as the light is, but is {values.shape}")

    @property
    def steady(self) -> bool:
        """Whether nothing changes, so that pictures need no light."""
        return not self.exposures and not self.light.any()

    def of(self, cameras: Sequence[str], instants: int) -> np.ndarray | None:
        """Light times exposure, float32 [instants, C, 3], as `Views` takes it; None where nothing changes.

        Instants after those that were measured are taken for steady: do not look at them.
        """
        if self.steady:
            return None
        both = np.zeros((instants, len(cameras), 3), np.float32)
        count = min(instants, len(self.light))
        for column, name in enumerate(cameras):
            own = self.exposures.get(name)
            both[:count, column] = self.light[:count] + (0 if own is None else own[:count])
        return both

    def save(self, path: Path) -> None:
        """As npz."""
        own = np.array(list(self.exposures.values()), np.float32).reshape(-1, *self.light.shape)
        save_npz(path, {"light": self.light, "cameras": np.array(list(self.exposures), str), "exposures": own})

    @classmethod
    def load(cls, path: Path) -> Light:
        """Inverse of `save`, but for the facts."""
        with open_npz(path) as arrays:
            names = arrays["cameras"].tolist()
            return cls(arrays["light"], dict(zip(names, arrays["exposures"], strict=True)))


def measure_light(
    reader: FrameReader,
    frames: Mapping[str, np.ndarray],
    fitted: Sequence[str],
    options: LightOptions,
    *,
    workers: int = 2,
    kept: Path | None = None,
    progress: Progress = no_progress,
) -> Light:
    """Of cameras with the frame numbers `frames`, int [T], -1 where there is none; light from the fitted ones alone.

    Pictures pass once, camera by camera, `workers` of them at a time. What is measured goes to the folder `kept`, if
    given, from which the same measurement goes on after a kill.
    """
    told, lock = dict.fromkeys(frames, 0.0), Lock()
    total = sum(int((numbers >= 0).sum()) for numbers in frames.values())

    def hear(name: str, done: float, _total: float, note: str = "") -> None:
        with lock:
            told[name] = done
            progress(sum(told.values()), total)

    def measure(name: str) -> Ratios:
        return measure_ratios(
            lambda instant: reader.read(name, int(frames[name][instant])),
            frames[name],
            width=options.width,
            samples=options.samples,
            kept=None if kept is None else kept / name,
            progress=partial(hear, name),
        )

    with ThreadPoolExecutor(workers) as pool:
        ratios = dict(zip(frames, pool.map(measure, frames), strict=True))
    return light_of(ratios, fitted, options)


def light_of(ratios: Mapping[str, Ratios], fitted: Sequence[str], options: LightOptions) -> Light:
    """Tell light of the instant from the cameras' own exposures."""
    own = np.stack([ratios[name].whole for name in fitted], axis=1)  # [T, F, 3]
    light = common(own)
    spread = float(_deviation(light, axis=0).max(initial=0))
    left = _left_by_others(own)
    if spread < options.least_light or not left <= options.most_left:
        light = np.zeros_like(light)
    exposures = {
        name: exposure
        for name, ratio in ratios.items()
        if (exposure := _own_exposure(ratio, light, options)) is not None
    }
    others = [k for k, name in enumerate(fitted) if name not in exposures]
    if light.any() and len(others) >= max(2, len(fitted) // 2):  # without those that pulled at it
        light = common(own[:, others])
        exposures = {name: _without(ratios[name].whole, light) for name in exposures}
    facts = {
        "spread": spread,
        "left": left if np.isfinite(left) else None,
        "steady": not light.any(),
        "exposures": {name: float(_deviation(values, axis=0).max()) for name, values in exposures.items()},
        "unknown": [name for name, ratio in ratios.items() if np.isnan(ratio.whole).all()],
    }
    return Light(_rounded(light), {name: _rounded(values) for name, values in exposures.items()}, facts)


def common(own: np.ndarray) -> np.ndarray:
    """What cameras have in common over time, float64 [T, 3] of mean 0; `own` is [T, C, 3], NaN where unknown.

    A camera's ratios hold up to a factor of its own, so levels and light are found in turn; cameras that disagree
    with most at an instant have no say there. Instants that no camera knows get what lies between their neighbours.
    """
    known = np.isfinite(own)
    own = own[:, known.any(axis=(0, 2))]
    if not own.shape[1]:
        return np.zeros((len(own), 3))
    light = np.zeros((len(own), 1, 3), own.dtype)
    for _ in range(ROUNDS):
        before, levels = light, _centre(own - light, axis=0)
        light = _filled(_centre(own - levels, axis=1)[:, 0])[:, None]
        if np.abs(light - before).max(initial=0) < 1 / STEPS:
            break
    flat = light[:, 0]
    return np.asarray(flat - flat.mean(axis=0))


def _centre(values: np.ndarray, axis: int) -> np.ndarray:
    """Tukey's estimate along an axis, which is kept, of [T, C, 3], NaN where unknown; NaN where nothing is known."""
    known = np.isfinite(values)
    centre = _median(values, axis)
    for _ in range(5):
        error = np.where(known, np.abs(values - centre), np.nan)
        scale = 1.4826 * np.nan_to_num(_median(error.reshape(-1, 1, 3), 0))[0, 0]  # [3]
        near = np.nan_to_num(error) / (4.7 * np.maximum(scale, FINEST))
        weights = np.where(known, np.maximum(0, 1 - near**2) ** 2, 0)
        total = weights.sum(axis=axis, keepdims=True)
        mean = (weights * np.nan_to_num(values)).sum(axis=axis, keepdims=True)
        centre = np.divide(mean, total, out=centre, where=total > 0)
    return centre


def _median(values: np.ndarray, axis: int) -> np.ndarray:
    """Along an axis, which is kept, of what is known; NaN where nothing is. (NumPy's own warns there.)"""
    ordered = np.sort(values, axis=axis)  # NaN last
    count = np.isfinite(values).sum(axis=axis, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis)
    return np.asarray((low + high) / 2)


def _filled(values: np.ndarray) -> np.ndarray:
    """[T, 3] with what lies between known neighbours where unknown, the nearest one beyond the ends; 0 of none."""
    filled, at = np.zeros_like(values), np.arange(len(values))
    for c in range(3):
        known = np.isfinite(values[:, c])
        if known.any():
            filled[:, c] = np.interp(at, at[known], values[known, c])
    return filled


def _left_by_others(own: np.ndarray) -> float:
    """Deviation of a camera over time that light from others leaves, as a share of all of it; NaN of one camera.

    A few cameras at a time are left out; of the shares of all cameras and channels, the median counts.
    """
    own = own[:: 1 + len(own) // JUDGED, np.isfinite(own).any(axis=(0, 2))]
    count = own.shape[1]
    if count < 2:
        return float("nan")
    shares = []
    for fold in range(min(count, FOLDS)):
        out = np.arange(count) % FOLDS == fold
        light = common(own[:, ~out])
        before, after = _deviation(own[:, out], axis=0), _deviation(own[:, out] - light[:, None], axis=0)  # [F, 3]
        shares += (after[before > 0] / before[before > 0]).tolist()
    return float(np.median(shares)) if shares else float("nan")


def _deviation(values: np.ndarray, axis: int) -> np.ndarray:
    """Root mean square about the mean of what is known; NaN where nothing is. (NumPy's own warns there.)"""
    known = np.isfinite(values)
    count = np.maximum(known.sum(axis=axis, keepdims=True), 1)
    mean = np.where(known, values, 0).sum(axis=axis, keepdims=True) / count
    square = np.where(known, (values - mean) ** 2, 0).sum(axis=axis, keepdims=True) / count
    return np.asarray(np.where(known.any(axis=axis), np.sqrt(square).squeeze(axis), np.nan))


def _own_exposure(ratio: Ratios, light: np.ndarray, options: LightOptions) -> np.ndarray | None:
    """Float64 [T, 3] of mean 0, or None where a camera has none that is sure."""
    rest = ratio.whole - light
    if np.isnan(rest).all():
        return None
    size = float(np.nanmax(_deviation(rest, axis=0)))
    apart = _deviation(ratio.parts - ratio.whole[:, None], axis=0)  # [PARTS, 3]
    apart = apart[np.isfinite(apart).all(axis=1)]
    if len(apart) < 2 or size < max(options.least_exposure, options.exposure_sigmas * _root_mean_square(apart)):
        return None
    return _without(ratio.whole, light)


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def _without(whole: np.ndarray, light: np.ndarray) -> np.ndarray:
    """A camera's own exposure, with mean 0."""
    rest = _filled(whole - light)
    return np.asarray(rest - rest.mean(axis=0))


def _rounded(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(values * STEPS) / STEPS, dtype=np.float32)


def packed(values: np.ndarray) -> str:
    """Logarithms float32 [T, 3], in steps of 1 / STEPS, as text for a scene's header: differences, compressed."""
    steps = np.rint(values.astype(np.float64) * STEPS).astype("<i4")
    differences = np.diff(steps, axis=0, prepend=np.zeros_like(steps[:1]))
    return base64.b64encode(zlib.compress(differences.T.tobytes(), 9)).decode()


def unpacked(text: object, instants: int, what: str) -> np.ndarray:
    """Inverse of `packed`: float32 [instants, 3], of text that holds as many or more; raises ValueError for others."""
    refused = ValueError(f"{what} must be the packed exposure of {instants} instants or more, but is {shown(text)}")
    try:
        data = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(data, 12 * MOST_FRAMES)
    except (ValueError, zlib.error):
        raise refused from None
    if unpacker.unconsumed_tail or len(content) % 12 or len(content) < 12 * instants:
        raise refused
    steps = np.cumsum(np.frombuffer(content, "<i4").reshape(3, -1).T[:instants], axis=0, dtype=np.int64)
    if (np.abs(steps) > MOST_LIGHT * STEPS).any():
        raise ValueError(f"{what} must hold natural logarithms within {MOST_LIGHT:g} of 0")
    return np.asarray(steps / STEPS, dtype=np.float32)
