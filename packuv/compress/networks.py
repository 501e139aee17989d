"""Encoder-decoders of rows whose latents are integers, for a benchmark: no scene file holds any of this.

Values are codes in learned steps (`packuv.compress.steps`), so that an error of one costs all columns the same. An
encoder-decoder is a pair of matrices, and beside them, unless it is to be linear, a pair of networks of two hidden
layers. It is trained for bits + 6 / ln 2 times squared errors, each weighted by what it does to pictures: at equal
steps both change alike, which is the exchange that learned steps make. Bits are those of a Laplace distribution about
what FFV1 predicts: the median of neighbours in the key, the row's own last latents in later frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from packuv.scene.mosaic import Mosaic

EXCHANGE = 6 / np.log(2)
"""Bits that a squared error of one step is worth: a step s errs by s^2 / 12, and half as much costs a bit"""
COARSER = 3
"""Steps of frames after the key, as in `Steps.tolerance`"""
MOST_LATENT = 127
BATCH = 1024
"""Rows of the key in an iteration, and as many of later frames"""
ROUNDED_FROM = 0.6
"""Share of iterations after which noise gives way to rounding"""
RATE = 2e-3
"""Of Adam at the start; it falls to 0"""


@dataclass(frozen=True)
class Examples:
    """What is learned from."""

    key: np.ndarray
    """float32 [N, d], in learned steps"""
    weights: np.ndarray
    """float32 [N, d], of squared errors; 1 on average in each column"""
    around: np.ndarray
    """int64 [N, 3]: rows to the left, above, and above the left in a plane, see `neighbours`"""
    moving: np.ndarray
    """float32 [T - 1, D, d]: later frames of the first D rows"""

    def columns(self, which: slice | np.ndarray) -> Examples:
        return Examples(self.key[:, which], self.weights[:, which], self.around, self.moving[:, :, which])


def neighbours(count: int) -> np.ndarray:
    """Rows from which FFV1 predicts each of `count` rows, int64 [count, 3]; the row itself where there is none."""
    mosaic = Mosaic.of(count, (0,), 1)
    cells = mosaic.cells[:count]
    rows = np.full(mosaic.width * mosaic.height, -1)
    rows[cells] = np.arange(count)
    x, y = cells % mosaic.width, cells // mosaic.width
    found = [
        np.where((x >= dx) & (y >= dy), rows[cells - dx - dy * mosaic.width], -1) for dx, dy in ((1, 0), (0, 1), (1, 1))
    ]
    around = np.stack(found, axis=1)
    return np.where(around >= 0, around, np.arange(count)[:, None])


class Transform(nn.Module):
    """An encoder-decoder of rows [n, d] to integer latents [n, k] and back."""

    def __init__(self, rows: Examples, latents: int, hidden: int) -> None:
        """Begin as the main axes: of what FFV1 predicts badly, or of the values, where latents are fewer than these."""
        super().__init__()
        d = rows.key.shape[1]
        self.hidden = hidden
        self.mean = torch.as_tensor(rows.key.mean(axis=0))
        self.spread = torch.as_tensor(rows.key.std(axis=0) + 1e-3)
        axes = _axes(rows.key - rows.key[rows.around[:, 0]] if latents == d else rows.key)[:latents]
        self.into = nn.Parameter(torch.as_tensor(axes.astype(np.float32)))  # [k, d]
        self.back = nn.Parameter(self.into.detach().T.contiguous())  # [d, k]
        self.width = torch.as_tensor((rows.key @ axes.T).std(axis=0) + 1e-3).float()
        self.encoder, self.decoder = _network(d, hidden, latents), _network(latents, hidden, d)
        self.scales = nn.Parameter(torch.zeros(3, latents))  # logarithms of Laplace's, and how they grow with activity

    def encode(self, values: Tensor) -> Tensor:
        """[n, d] -> [n, k], not rounded."""
        offset = values - self.mean
        straight = offset @ self.into.T
        return straight + self.width * _passed(self.encoder, offset / self.spread) if self.hidden else straight

    def decode(self, latents: Tensor) -> Tensor:
        """[n, k] -> [n, d]."""
        straight = latents @ self.back.T + self.mean
        return straight + self.spread * _passed(self.decoder, latents / self.width) if self.hidden else straight

    def latents(self, values: np.ndarray) -> np.ndarray:
        """Of values float32 [..., d], rounded, int64 [..., k] within MOST_LATENT."""
        with torch.no_grad():
            found = self.encode(torch.as_tensor(values)).round().clamp(-MOST_LATENT, MOST_LATENT)
        return np.asarray(found.numpy(), np.int64)

    def values(self, latents: np.ndarray) -> np.ndarray:
        """Of latents int [..., k], float32 [..., d]."""
        with torch.no_grad():
            return self.decode(torch.as_tensor(latents, dtype=torch.float32)).numpy()

    @property
    def bytes(self) -> int:
        """Of what a decoder needs: 8 bits a weight of the network, 32 of everything else."""
        return _network_bytes(self.decoder) + 4 * (self.back.numel() + 2 * len(self.mean) + len(self.width))


def _axes(values: np.ndarray) -> np.ndarray:
    """Main axes of values [n, d], each a row [d, d], the longest first; the outermost hundredth is pulled in."""
    low, high = np.quantile(values, [0.005, 0.995], axis=0)
    axes: np.ndarray = np.linalg.eigh(np.cov(np.clip(values, low, high).T.astype(np.float64)))[1][:, ::-1].T
    return np.ascontiguousarray(axes)


def _network(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two hidden layers; begins as 0, so that the matrices are all there is."""
    if not hidden:
        return nn.Sequential()
    last = nn.Linear(hidden, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), last)


def _network_bytes(found: nn.Sequential) -> int:
    """8 bits a weight, 32 a bias and the weights' step."""
    layers = [layer for layer in found if isinstance(layer, nn.Linear)]
    return sum(layer.weight.numel() + 4 * (layer.bias.numel() + 1) for layer in layers)


def _passed(found: nn.Sequential, values: Tensor) -> Tensor:
    """What a network makes of values, its weights rounded to 8 bits; gradients pass as if they were not."""
    for layer in found:
        if isinstance(layer, nn.Linear):
            step = layer.weight.detach().abs().max() / 127 + 1e-12
            weight = layer.weight + ((layer.weight / step).round() * step - layer.weight).detach()
            values = nn.functional.linear(values, weight, layer.bias)
        else:
            values = layer(values)
    return values


def train(
    rows: Examples, latents: int, *, hidden: int = 48, iterations: int = 150, seed: int = 0, weight: float = EXCHANGE
) -> Transform:
    """An encoder-decoder of these rows; the same seed gives the same one. `weight` is that of a squared error, bits."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        transform = Transform(rows, latents, hidden)
        optimizer = torch.optim.Adam(transform.parameters(), lr=RATE)
        batches = _Batches(rows, seed)
        for iteration in range(iterations):
            optimizer.param_groups[0]["lr"] = RATE * (1 - iteration / iterations)
            rounded = iteration >= ROUNDED_FROM * iterations
            loss = _key_loss(transform, *batches.key(), rounded, weight)
            if rows.moving.size:
                later = _moving_loss(transform, *batches.moving(), rounded, weight)
                loss = (1 - batches.share) * loss + batches.share * later
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
    return transform


class _Batches:
    """Rows at random."""

    def __init__(self, rows: Examples, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._key, self._weights = torch.as_tensor(rows.key), torch.as_tensor(rows.weights)
        self._around = np.concatenate([np.arange(len(rows.key))[:, None], rows.around], axis=1)
        frames = np.concatenate([rows.key[None, : rows.moving.shape[1]], rows.moving])
        self._frames = torch.as_tensor(frames)
        moving = rows.moving.shape[0] * rows.moving.shape[1]
        self.share = moving / (moving + len(rows.key))
        """Of rows that are coded in later frames"""

    def key(self) -> tuple[Tensor, Tensor]:
        """Rows and their neighbours [4, n, d], weights [n, d]."""
        chosen = self._rng.integers(0, len(self._key), BATCH)
        return self._key[self._around[chosen].T], self._weights[chosen]

    def moving(self) -> tuple[Tensor, Tensor]:
        """Rows in a frame and in the next [2, n, d], weights [n, d]."""
        frame = self._rng.integers(1, len(self._frames), BATCH)
        chosen = self._rng.integers(0, self._frames.shape[1], BATCH)
        return torch.stack([self._frames[frame - 1, chosen], self._frames[frame, chosen]]), self._weights[chosen]


def _key_loss(transform: Transform, values: Tensor, weights: Tensor, rounded: bool, weight: float) -> Tensor:
    count, n, _ = values.shape
    latents = _coarse(transform.encode(values.flatten(0, 1)), rounded).reshape(count, n, -1)
    own, left, above, corner = latents
    expected = torch.stack([left, above, left + above - corner]).median(dim=0).values
    activity = torch.log1p((left - corner).abs() + (above - corner).abs())
    bits = _bits(own - expected, transform.scales[0] + transform.scales[1] * activity)
    error = (transform.decode(own) - values[0]).square() * weights
    return bits.sum(dim=1).mean() + weight * error.sum(dim=1).mean()


def _moving_loss(transform: Transform, values: Tensor, weights: Tensor, rounded: bool, weight: float) -> Tensor:
    """As that of the key, at steps COARSER times as wide."""
    _, n, _ = values.shape
    before, now = transform.encode(values.flatten(0, 1)).reshape(2, n, -1)
    last = before + COARSER * (torch.rand_like(before) - 0.5)
    residual = _coarse((now - last) / COARSER, rounded)
    error = (transform.decode(last + COARSER * residual) - values[1]).square() * weights
    bits = _bits(residual, transform.scales[2].expand_as(residual))
    return bits.sum(dim=1).mean() + weight / COARSER**2 * error.sum(dim=1).mean()


def _coarse(latents: Tensor, rounded: bool) -> Tensor:
    """Rounded, with gradients as if they were not; or with as much noise as rounding makes."""
    noise = latents.round() - latents if rounded else torch.rand_like(latents) - 0.5
    return latents + noise.detach()


def _bits(residuals: Tensor, log_scales: Tensor) -> Tensor:
    """Bits of integers, or of values with noise, whose logarithms of Laplace scales are given."""
    scale = log_scales.clamp(-3, 6).exp()
    low, high = ((residuals.abs() + side) / scale for side in (-0.5, 0.5))
    inside = 1 - 0.5 * (low.clamp(max=0).exp() + (-high).exp())
    outside = 0.5 * ((-low.clamp(min=0)).exp() - (-high).exp())
    return -torch.log2(torch.where(low < 0, inside, outside).clamp(min=1e-6))
