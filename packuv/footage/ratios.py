"""How much brighter than usual a camera's pictures are, instant by instant, from what stands still in them.

Pictures are shrunk by area, which commutes with factors on sRGB + 0.055 (`packuv.footage.response`). What is clipped or
dark in the reference, or seen to move, has no say; of the rest, what disagrees with most has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from packuv.colour import GAMMA, OFFSET
from packuv.files import open_npz, save_npz
from packuv.kernels.compile import kernel
from packuv.progress import Progress, no_progress

Shot = Callable[[int], np.ndarray]
"""Picture of an instant, uint8 [H, W, 3]"""

DARKEST, BRIGHTEST = 0.1, 0.85
"""sRGB of pixels that count: below, noise and flare outweigh light; above, a little more of it clips"""
HELD = 600
"""Small pictures of a camera that are kept for the second look, 43 KB each; longer ones decode their samples twice"""
KEPT = 1024
"""Instants of a camera that are kept at a time, and that a kill costs: seconds to decode and compare"""
PARTS = 4
"""Quarters of the picture that are measured apart as well: light of all of it must show in each"""
LEAST_PIXELS = 200
"""Steady pixels without which a camera tells nothing; a quarter of it for a part"""
LEAST_SHARE = 0.25
"""Of all pixels that count, moving or not, that must agree at an instant: after a cut or behind a crowd they do not"""
LEVEL = 1 / 255
ROUNDS = 5
REACH = 1.5
"""Logarithms of ratios, on sRGB + 0.055, that are looked for: a factor of 36 on light, up or down"""
MOST_DARK = 0.75
"""Of all pixels that count, what may be darker than that before it is the light that went, and not what stood there"""
_BINS, _FINE = 300, 16
"""Of the histogram whose top starts an estimate; of the errors', a grey level"""
_CUT = 4.0
"""Errors that weigh nothing, in deviations"""
_MOST_DEVIATION = 2
"""Grey levels: small pictures have less noise than that, and more would let other things agree by chance"""
_f32 = np.float32
_VALUES = (np.arange(256) * LEVEL + OFFSET).astype(_f32)


@dataclass(frozen=True)
class Ratios:
    """One camera's brightness over that of its reference, natural logarithm of linear light, NaN where unknown."""

    whole: np.ndarray
    """float32 [T, 3]"""
    parts: np.ndarray
    """float32 [T, PARTS, 3]: of each quarter of the picture alone"""

    def keep(self, path: Path, instants: Sequence[int]) -> None:
        """Write some instants into a file, in a folder that is made where it is missing."""
        path.parent.mkdir(parents=True, exist_ok=True)
        save_npz(path, {"whole": self.whole[instants], "parts": self.parts[instants]})

    def read(self, path: Path, instants: Sequence[int]) -> bool:
        """Take over what `keep` wrote; whether there is such a file."""
        if not path.exists():
            return False
        with open_npz(path) as measured:
            self.whole[instants], self.parts[instants] = measured["whole"], measured["parts"]
        return True


@dataclass(frozen=True)
class _Reference:
    """Pixels of a camera as they look at usual brightness."""

    pixels: np.ndarray
    """int64 [P]: their places in the small picture, by row"""
    values: np.ndarray
    """float32 [P, 3], sRGB + 0.055; 0 in channels that do not count"""
    part: np.ndarray
    """uint8 [P]: quarter of the picture that each lies in; PARTS for one that is not steady, and has no say"""

    @classmethod
    def of(cls, values: np.ndarray, steady: np.ndarray, size: tuple[int, int]) -> _Reference:
        """From whole pictures, [H * W, 3] and bool [H * W], of `size` height and width."""
        height, width = size
        pixels = np.flatnonzero(values.any(axis=1))
        rows, columns = np.divmod(pixels, width)
        part = 2 * (2 * rows >= height) + (2 * columns >= width)
        return cls(pixels, values[pixels].astype(_f32), np.where(steady[pixels], part, PARTS).astype(np.uint8))

    def ratio(self, small: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Factors on sRGB + 0.055, float64 [3] and [PARTS, 3], of a picture uint8 [H, W, 3]; NaN where unknown."""
        light, seen = np.zeros((PARTS, 3)), np.zeros((PARTS, 3))
        counts, share = np.zeros((PARTS, 3), np.int64), np.zeros(3)
        codes = small.reshape(-1, 3)[self.pixels]
        _compare(codes, self.values, self.part, _VALUES, light, seen, counts, share)
        known = share >= LEAST_SHARE
        whole = _divided(seen.sum(axis=0), light.sum(axis=0), known)
        return whole, _divided(seen, light, known & (counts >= LEAST_PIXELS / PARTS))


def measure_ratios(
    shot: Shot,
    frames: np.ndarray,
    *,
    width: int,
    samples: int,
    kept: Path | None = None,
    progress: Progress = no_progress,
) -> Ratios:
    """Of the instants t with `frames[t]` >= 0; pictures are shrunk to `width`, `samples` of them make the reference.

    What is measured goes to the folder `kept`, if given, from which the same measurement goes on after a kill.
    """
    there = np.flatnonzero(frames >= 0).tolist()
    found = Ratios(np.full((len(frames), 3), np.nan, _f32), np.full((len(frames), PARTS, 3), np.nan, _f32))
    if not there:
        return found
    chosen = [there[k] for k in np.unique(np.linspace(0, len(there) - 1, min(samples, len(there))).round().astype(int))]
    held = {t: _shrunk(shot(t), width) for t in (there if len(there) <= HELD else chosen)}
    reference = _reference(np.stack([held[t] for t in chosen]))
    for begin in range(0, len(there) if reference else 0, KEPT):
        some = there[begin : begin + KEPT]
        path = kept / f"{begin:09d}.npz" if kept is not None and len(some) == KEPT else None
        if path is None or not found.read(path, some):
            for done, t in enumerate(some, start=begin + 1):
                small = held.pop(t) if t in held else _shrunk(shot(t), width)
                assert reference is not None
                found.whole[t], found.parts[t] = (GAMMA * np.log(factors) for factors in reference.ratio(small))
                progress(done, len(there))
            if path is not None:
                found.keep(path, some)
    progress(len(there), len(there))
    return found


def _shrunk(picture: np.ndarray, width: int) -> np.ndarray:
    """At most `width` wide; an array of its own, so that the large one can go."""
    if picture.shape[1] <= width:
        return picture.copy()
    size = width, max(1, round(picture.shape[0] * width / picture.shape[1]))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _reference(pictures: np.ndarray) -> _Reference | None:
    """From pictures of several instants, uint8 [S, H, W, 3]; None where next to nothing stands still."""
    size = pictures.shape[1], pictures.shape[2]
    shown = _VALUES[pictures].reshape(len(pictures), -1, 3)  # [S, P, 3]
    usual = np.median(shown, axis=0)
    counts, steady = _mid_tones(usual, size), np.ones(len(usual), bool)
    for _ in range(2):  # the second time without what moved, against pictures of one brightness
        reference = _Reference.of(np.where(counts, usual, 0), steady, size)
        factors = np.stack([reference.ratio(picture)[0] for picture in pictures])  # [S, 3]
        known = np.isfinite(factors).all(axis=1)
        if not known.any():
            return None
        level = shown[known] / factors[known, None].astype(_f32)
        usual = np.median(level, axis=0)
        steady = _steady(np.sqrt(((level - usual) ** 2).mean(axis=(0, 2))), np.asarray(counts.any(axis=1)))
    # The mean of what agrees with the median is finer than a grey level.
    close = np.abs(level - usual) < 4 * LEVEL
    usual = np.divide(np.where(close, level, 0).sum(axis=0), close.sum(axis=0), out=usual, where=close.any(axis=0))
    reference = _Reference.of(np.where(counts, usual, 0), steady, size)
    return reference if (reference.part < PARTS).sum() >= LEAST_PIXELS else None


def _mid_tones(usual: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Where light acts as it should, bool [P, 3]: channels bright enough, of pixels not beside clipped ones."""
    brightest = usual.max(axis=1).reshape(size).astype(_f32)
    below = cv2.dilate(brightest, np.ones((3, 3), np.uint8)).reshape(-1) < BRIGHTEST + OFFSET
    return np.asarray((usual > DARKEST + OFFSET) & below[:, None])


def _steady(spread: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Pixels that change over time, root mean square [P], by little more than noise; `counts` is bool [P]."""
    least = np.quantile(spread[counts], 0.25) if counts.any() else 0.0
    return np.asarray(spread <= np.clip(3 * least, 1.5 * LEVEL, 5 * LEVEL))


def _divided(seen: np.ndarray, light: np.ndarray, known: np.ndarray) -> np.ndarray:
    factors, known = np.full(seen.shape, np.nan), known & (light > 0) & (seen > 0)
    np.divide(seen, light, out=factors, where=known)
    return factors


@kernel()
def _compare(codes, values, part, table, light, seen, counts, share):
    """Factors from reference to picture by least squares, as their sums over each part.

    `codes` is uint8 [P, 3], `values` float32 [P, 3], 0 in what does not count, `table` the value of each code. `light`
    gets the sums of the reference squared, `seen` of reference times picture, float64 [PARTS, 3]: brighter pixels
    count for more, as their noise is a smaller share. `counts` is what weighs anything, `share` [3] how much of all
    agrees, pixels without a part included.

    Weights are Tukey's about the most frequent ratio: what moved there weighs nothing.
    """
    for c in range(3):
        factor, valid = _most_frequent(codes, values, part, table, c)
        deviation = _f32(1)
        for _step in range(ROUNDS):
            deviation = _deviation(codes, values, part, table, c, factor, valid)
            light[:, c] = 0
            seen[:, c] = 0
            counts[:, c] = 0
            for p in range(len(codes)):
                r, x = values[p, c], table[codes[p, c]]
                e = (x - factor * r) / (_f32(_CUT) * deviation)
                if r > 0 and part[p] < PARTS and e * e < 1:
                    weight = (1 - e * e) * (1 - e * e)
                    light[part[p], c] += weight * r * r
                    seen[part[p], c] += weight * r * x
                    counts[part[p], c] += 1
            if light[:, c].sum() > 0:
                factor = _f32(seen[:, c].sum() / light[:, c].sum())
        share[c] = _agreeing(codes, values, table, c, factor, 2 * deviation)


@kernel(inner=True)
def _agreeing(codes, values, table, c, factor, most):
    """Share of what counts that has this ratio, but for so much."""
    agreeing, all_of_them = 0, 0
    for p in range(len(codes)):
        if values[p, c] > 0:
            all_of_them += 1
            agreeing += abs(table[codes[p, c]] - factor * values[p, c]) < most
    return agreeing / max(1, all_of_them)


@kernel(inner=True)
def _most_frequent(codes, values, part, table, c):
    """The ratio that most steady pixels are close to, and how many there are.

    What is darker than `REACH` stood before black and has gone, unless next to all is dark.
    """
    bins, valid, all_of_them, dark = np.zeros(_BINS + 4, np.int64), 0, 0, 0
    for p in range(len(codes)):
        if values[p, c] > 0:
            place = np.log(table[codes[p, c]] / values[p, c]) / _f32(2 * REACH) + _f32(0.5)
            all_of_them += 1
            dark += place < 0
            if part[p] < PARTS:
                valid += 1
                if place >= 0:
                    bins[2 + min(int(place * _f32(_BINS)), _BINS - 1)] += 1
    if dark > _f32(MOST_DARK) * all_of_them:
        return _f32(np.exp(-REACH)), valid
    best, top = -1, 0
    for b in range(2, _BINS + 2):
        near = bins[b - 2] + 2 * bins[b - 1] + 3 * bins[b] + 2 * bins[b + 1] + bins[b + 2]
        if near > best:
            best, top = near, b
    return _f32(np.exp(((top - 2 + 0.5) / _BINS - 0.5) * 2 * REACH)), valid


@kernel(inner=True)
def _deviation(codes, values, part, table, c, factor, valid):
    """Of a normal distribution with the median magnitude of the steady pixels' errors, within limits."""
    bins = np.zeros(_MOST_DEVIATION * _FINE, np.int64)
    for p in range(len(codes)):
        if values[p, c] > 0 and part[p] < PARTS:
            place = int(abs(table[codes[p, c]] - factor * values[p, c]) * _f32(_FINE / LEVEL))
            if place < len(bins):
                bins[place] += 1
    below, b = 0, 0
    while b < len(bins) and 2 * below < valid:
        below += bins[b]
        b += 1
    return _f32(LEVEL) * min(max(_f32(1.4826 / _FINE) * b, _f32(0.5)), _f32(_MOST_DEVIATION))
