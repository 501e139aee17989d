"""Steps of each row's own, told by networks from what is decoded already, for a benchmark: no scene file holds this.

What an error does to pictures differs from row to row by orders of magnitude, and opacity, size and place tell much of
that. Columns are decoded in groups; a small network takes those before to the logarithm of a group's squared
derivatives, and so to its steps. Values are coded as differences to what their decoded neighbours foretell, in these
steps: next to each other, codes in different steps would foretell nothing. FFV1 would predict again, so the pictures
are such that its own prediction leaves just these differences.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from packuv.compress.networks import COARSER, RATE, network, network_bytes, passed
from packuv.gaussians.codes import DC, OPACITY
from packuv.gaussians.segment import Segment
from packuv.kernels.compile import kernel
from packuv.scene.matroska import Encoder, VideoTrack
from packuv.scene.mosaic import BLOCK, NEUTRAL, Mosaic

PLACE = 3
"""Columns of positions, before those of attributes"""
HIDDEN = 24
BATCH = 2048
SHRUNK = 0.05
"""Share of the column's mean in what a row's pictures tell"""
CLASSES = 4
"""Steps to a doubling: few, so that no rounding of networks matters"""
OF_PLACE, OF_ATTRIBUTE = (0, 13 * CLASSES), (CLASSES, 7 * CLASSES)
"""Steps are 1 to 8192 codes of positions, 2 to 128 of attributes: any change of these fits into a byte"""
MOST_RESIDUAL, MOST_PLACE = 127, 32_000
SLICES = 4
"""Few share what they learn, see `packuv.scene.encoder`"""


def groups(columns: int) -> tuple[tuple[int, ...], ...]:
    """Columns [3 + A] in the order in which they are decoded; of a colour green first."""
    first = PLACE + DC.start
    colours = sorted(range(first, columns), key=lambda column: ((column - first) % 3 != 1, column))
    scales = [(PLACE + axis,) for axis in range(3)]
    return ((PLACE + OPACITY,), *scales, (PLACE + 3, PLACE + 4, PLACE + 5), (0, 1, 2), tuple(colours))


class RowSteps:
    """Networks that tell steps."""

    def __init__(self, values: np.ndarray, squares: np.ndarray, *, iterations: int, seed: int) -> None:
        """Learn from values [N, 3 + A], as coarse as decoded ones, and squared derivatives by them [N, 3 + A]."""
        self.groups = groups(values.shape[1])
        self._mean, self._spread = values.mean(axis=0), values.std(axis=0) + 1e-3
        self._level = squares.mean(axis=0) + 1e-300
        relative = torch.as_tensor(SHRUNK + (1 - SHRUNK) * squares / self._level, dtype=torch.float32)
        known = torch.as_tensor((values - self._mean) / self._spread, dtype=torch.float32)
        rng = np.random.default_rng(seed)
        self._networks = []
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            for number, group in enumerate(self.groups):
                before = self._before(number)
                found = network(len(before), HIDDEN if before else 0, len(group))
                self._networks.append(found)
                if before:
                    _fit(found, known[:, before], relative[:, list(group)], iterations, rng)

    def _before(self, number: int) -> list[int]:
        return [column for group in self.groups[:number] for column in group]

    def of(self, number: int, decoded: np.ndarray, noise: float) -> np.ndarray:
        """Steps [N, columns of the group], from decoded values [N, 3 + A] of the groups before."""
        group, before = self.groups[number], self._before(number)
        levels = np.broadcast_to(np.log(self._level[list(group)]), (len(decoded), len(group)))
        if before:
            known = torch.as_tensor(((decoded - self._mean) / self._spread)[:, before], dtype=torch.float32)
            with torch.no_grad():
                levels = levels + passed(self._networks[number], known).numpy()
        octaves = 0.5 * (np.log2(12 * noise / len(decoded)) - levels / np.log(2))
        limits = OF_PLACE if group[0] < PLACE else OF_ATTRIBUTE
        return np.asarray(np.exp2(np.clip(np.rint(CLASSES * octaves), *limits) / CLASSES))

    @property
    def bytes(self) -> int:
        return sum(network_bytes(found) for found in self._networks) + 12 * len(self._mean)


def _fit(found: torch.nn.Sequential, known: torch.Tensor, squares: torch.Tensor, iterations: int,
         rng: np.random.Generator) -> None:  # fmt: skip
    """Least S / w + log w, w being what the network tells: at one total error no other steps need fewer bits."""
    optimizer = torch.optim.Adam(found.parameters(), lr=2 * RATE)
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = 2 * RATE * (1 - iteration / iterations)
        chosen = rng.integers(0, len(known), BATCH)
        told = passed(found, known[chosen])
        loss = (squares[chosen] * (-told).exp() + told).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


class Key:
    """Rows of a key, in the cells of a plane."""

    def __init__(self, steps: RowSteps, count: int, noise: float) -> None:
        mosaic = Mosaic.of(count, (0,), 1)
        cells = mosaic.cells[:count]
        self._rows = np.full((mosaic.blocks_down * BLOCK, mosaic.blocks_across * BLOCK), -1)
        self._rows[cells // mosaic.width, cells % mosaic.width] = np.arange(count)
        self._steps, self._noise, self._count = steps, noise, count

    def residuals(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of values [N, 3 + A]: int64 of that shape, and what a reader makes of them."""
        residuals = np.zeros(values.shape, np.int64)
        return residuals, self._pass(values.astype(np.float64), residuals, known=False)

    def values(self, residuals: np.ndarray) -> np.ndarray:
        return self._pass(np.zeros(residuals.shape), residuals.copy(), known=True)

    def _pass(self, values: np.ndarray, residuals: np.ndarray, *, known: bool) -> np.ndarray:
        decoded = np.zeros(values.shape)
        for number, group in enumerate(self._steps.groups):
            steps = self._steps.of(number, decoded, self._noise)
            for place, column in enumerate(group):
                green = _green(column)
                base = np.zeros(self._count) if green is None else decoded[:, green]
                limit, most = (MOST_PLACE, 65535) if column < PLACE else (MOST_RESIDUAL, 255)
                found = _walk(
                    self._rows,
                    values[:, column] - base,
                    steps[:, place],
                    residuals[:, column],
                    limit,
                    most / 2 if green is None else 0.0,
                    known,
                )
                decoded[:, column] = np.clip(np.rint(found + base), 0, most)
        return decoded

    def steps(self, decoded: np.ndarray) -> np.ndarray:
        """Of all columns, [N, 3 + A]."""
        found = np.empty(decoded.shape)
        for number, group in enumerate(self._steps.groups):
            found[:, list(group)] = self._steps.of(number, decoded, self._noise)
        return found


def _green(column: int) -> int | None:
    """The column whose decoded value a red or blue one is a difference to."""
    channel = (column - PLACE - DC.start) % 3
    return None if column < PLACE + DC.start or channel == 1 else column + 1 - channel


@kernel()
def _walk(rows, values, steps, residuals, limit, start, known):
    """Values as decoded, each the median of what is left, above and between them, and a number of its steps."""
    down, across = rows.shape
    plane, decoded = np.zeros((down, across)), np.zeros(len(values))
    for y in range(down):
        for x in range(across):
            above = plane[y - 1, x] if y else start
            left = plane[y, x - 1] if x else above
            corner = plane[y - 1, x - 1] if x and y else above
            plane[y, x] = max(min(left, above), min(max(left, above), left + above - corner))
            i = rows[y, x]
            if i >= 0:
                if not known:
                    away = np.rint((values[i] - plane[y, x]) / steps[i])
                    residuals[i] = np.int64(min(max(away, -limit), limit))
                plane[y, x] += residuals[i] * steps[i]
                decoded[i] = plane[y, x]
    return decoded


def later(segment: Segment, decoded: np.ndarray, steps: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Residuals [D, 4 + A] and decoded values [D, 3 + A] of each frame after the key, which begins as decoded.

    Positions move on, steps are COARSER times those of the key. The last column is 1 for who comes or goes; of who is
    not there nothing is coded.
    """
    count = segment.xyz.shape[1]
    last, wide = decoded[:count].copy(), COARSER * steps[:count]
    velocity, before = np.zeros((count, PLACE)), segment.key.attributes[:count, OPACITY] > 0
    for xyz, attributes in zip(segment.xyz, segment.attributes, strict=True):
        now = np.concatenate([xyz, attributes], axis=1).astype(np.float64)
        expected = last.copy()
        expected[:, :PLACE] += velocity
        most = np.where(np.arange(now.shape[1]) < PLACE, MOST_PLACE, MOST_RESIDUAL)
        there = attributes[:, OPACITY] > 0
        residuals = np.clip(np.rint((now - expected) / wide), -most, most) * there[:, None]
        found = np.rint(expected + residuals * wide)
        found[:, :PLACE], found[:, PLACE:] = np.clip(found[:, :PLACE], 0, 65535), np.clip(found[:, PLACE:], 0, 255)
        velocity, last = (found[:, :PLACE] - last[:, :PLACE]) * there[:, None], found
        yield np.column_stack([residuals, there != before]).astype(np.int64), found
        before = there


def as_bytes(residuals: np.ndarray) -> np.ndarray:
    """Rows uint8 [n, 3 + c] of residuals [n, c]: positions in two bytes, all around 128."""
    place = residuals[:, :PLACE] + NEUTRAL * 257
    return np.concatenate([place >> 8, place & 255, residuals[:, PLACE:] + NEUTRAL], axis=1).astype(np.uint8)


def packet(rows: np.ndarray) -> bytes:
    """FFV1 picture of rows uint8 [n, channels] around 128, of which it codes just these. All 128 need no plane."""
    varying = tuple(np.flatnonzero((rows != NEUTRAL).any(axis=0)).tolist()) or (0,)
    mosaic = Mosaic.of(len(rows), varying, rows.shape[1])
    encoder = Encoder(VideoTrack("rows", mosaic.width, mosaic.height, SLICES))
    return encoder.encode(summed(mosaic.draw(rows)))


@kernel(inline=True)
def _foretold(picture, y, x):
    """What FFV1 expects of a pixel, but at the borders of slices."""
    above = np.int64(picture[y - 1, x]) if y else np.int64(0)
    left = np.int64(picture[y, x - 1]) if x else above
    corner = np.int64(picture[y - 1, x - 1]) if x and y else above
    return max(min(left, above), min(max(left, above), left + above - corner))


@kernel()
def summed(picture):
    """The picture uint8 [H, W] that differs by `picture` - 128 from what FFV1 expects."""
    found = np.zeros_like(picture)
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            found[y, x] = (_foretold(found, y, x) + picture[y, x] - NEUTRAL) & 255
    return found


@kernel()
def differences(picture):
    """Inverse of `summed`."""
    found = np.zeros_like(picture)
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            found[y, x] = (np.int64(picture[y, x]) - _foretold(picture, y, x) + NEUTRAL) & 255
    return found
