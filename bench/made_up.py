"""A made-up sequence to measure the scene file on: a moving, turning, bending actor among surroundings.

Its Gaussians are those of trained scenes (`splats/*.compressed.ply` under PACKUV_DATA) or, without them, drawn on
made-up surfaces; the noise that a fit leaves in moving Gaussians is imitated by an AR(1) process.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.floor import noise_bits
from packuv.camera import PinholeCamera
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, ROTATION, Quantizer, attribute_values
from packuv.gaussians.floats import Gaussians
from packuv.gaussians.segment import Segment
from packuv.gaussians.uvmap import assign_slots
from packuv.gaussians.uvsize import UvOptions
from packuv.interchange import read_ply

DATA = Path(os.environ.get("PACKUV_DATA", Path(__file__).parents[1] / "../shared/data"))
CAMERA = PinholeCamera(
    "front", 640, 360, 500.0, 500.0, 320.0, 180.0, np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 3], [0, 0, 0, 1]])
)
"""One that looks at the actor from 3 m, z up in the world"""
NEAR = 0.1
"""Before which it sees nothing, m"""


@dataclass(frozen=True)
class SequenceOptions:
    """A made-up sequence."""

    frames: int = 30
    """Frames of one segment, its keyframe included"""
    keyframes: int = 1
    """Segments, each of `frames` frames"""
    still: int = 260_000
    """Gaussians of the surroundings before the UV map prunes"""
    restless: int = 23_000
    """Of these, how many at a time do not move but are labelled dynamic, and so get noise; others in each segment"""
    actor: int = 60_000
    """Gaussians of the actor"""
    noise: float = 1.0
    """Strength of the fit's noise; 1: 0.03 in log scale, 0.01 in rotation, 0.1 in logit, 0.02 in colour, 5 % of the
    own size in position, correlated 0.9 from frame to frame"""
    seed: int = 1


# Sources of Gaussians


def trained_gaussians(folder: Path) -> Gaussians:
    """All trained scenes of a folder (compressed PLY, y down), as one cloud with z up."""
    scenes = [read_ply(path) for path in sorted(folder.glob("*.compressed.ply"))]
    up = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0])
    return _turned(_join([_placed(scene, 2.0, np.zeros(3)) for scene in scenes]), up)


def made_up_gaussians(n: int, rng: np.random.Generator) -> Gaussians:
    """Flat Gaussians on a bumpy ball about 2 across, with a texture."""
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    bumps = 0.1 * np.sin(7 * direction[:, 0] + 3 * direction[:, 1]) + 0.05 * np.sin(19 * direction[:, 2])
    means = direction * (1 + bumps)[:, None]
    scales = np.log([0.02, 0.015, 0.003]) + rng.normal(0, 0.4, (n, 3))
    quaternions = np.concatenate([np.ones((n, 1)), direction + rng.normal(0, 0.1, (n, 3))], axis=1)
    texture = np.sin(means @ rng.normal(0, 12, (3, 3))) + rng.normal(0, 0.1, (n, 3))
    return Gaussians(means, scales, _unit(quaternions), rng.normal(1.5, 2, n), texture[:, None])


def _unit(quaternions: np.ndarray) -> np.ndarray:
    unit: np.ndarray = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return unit


# The sequence


def _pick(g: Gaussians, rows: np.ndarray) -> Gaussians:
    return Gaussians(g.means[rows], g.log_scales[rows], g.quaternions[rows], g.opacity_logits[rows], g.sh[rows])


def _join(parts: Sequence[Gaussians]) -> Gaussians:
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    return Gaussians(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _placed(g: Gaussians, height: float, offset: np.ndarray) -> Gaussians:
    """Scaled to a height in metres, its middle put at `offset`."""
    low, high = np.percentile(g.means, [1, 99], axis=0)
    factor = height / (high - low).max()
    return replace(g, means=(g.means - (low + high) / 2) * factor + offset, log_scales=g.log_scales + np.log(factor))


def _turned(g: Gaussians, rotation: np.ndarray) -> Gaussians:
    """Turned about the origin by unit quaternions [4] or [n, 4], w x y z."""
    rotation = np.broadcast_to(rotation, (len(g), 4))
    w, u, v = rotation[:, :1], rotation[:, 1:], g.quaternions[:, 1:]
    across = 2 * np.cross(u, g.means)
    scalar = w * g.quaternions[:, :1] - (u * v).sum(axis=1, keepdims=True)
    vector = w * v + g.quaternions[:, :1] * u + np.cross(u, v)
    means = g.means + w * across + np.cross(u, across)
    return replace(g, means=means, quaternions=np.concatenate([scalar, vector], axis=1))


def _about_z(angle: np.ndarray | float) -> np.ndarray:
    half = np.asarray(angle) / 2
    return np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)


def _surroundings(source: Gaussians, count: int, rng: np.random.Generator) -> Gaussians:
    """Twelve different, larger samples of the source, which stand all around at 4 to 7 m."""
    parts = []
    for k in range(12):
        part = _pick(source, rng.permutation(len(source))[: count // 12])
        radius, azimuth = 4 + k % 4, k * np.pi / 6
        place = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), 0])
        parts.append(_placed(_turned(part, _about_z(1.1 * k)), 1.6 * radius, place))
    return _join(parts)


def _posed(actor: Gaussians, seconds: float) -> Gaussians:
    """The actor at a time: it turns, bends with height and wanders, about 25 mm a frame."""
    bend = 0.25 * np.sin(2 * np.pi * seconds * 0.8) * actor.means[:, 2] / 0.9
    turned = _turned(actor, _about_z(0.6 * np.sin(np.pi * seconds) + bend))
    way = [0.5 * np.sin(0.8 * np.pi * seconds), 0.6 * np.sin(seconds), 0.05 * np.sin(4 * np.pi * seconds)]
    return replace(turned, means=turned.means + way)


class _FitNoise:
    """AR(1) noise on every attribute of the dynamic Gaussians."""

    def __init__(self, g: Gaussians, strength: float, rng: np.random.Generator) -> None:
        self._rng, size = rng, np.exp(g.log_scales.mean(axis=1, keepdims=True))
        self._sigma = [strength * s for s in (0.05 * size, 0.03, 0.01, 0.10, 0.02)]
        self._state = self._foretold = [np.zeros_like(a) for a in _arrays(g)]

    def step(self) -> None:
        draws = (sigma * self._rng.standard_normal(s.shape) for s, sigma in zip(self._state, self._sigma, strict=True))
        self._foretold = [0.9 * s for s in self._state]
        self._state = [0.9 * s + draw for s, draw in zip(self._state, draws, strict=True)]

    def least_bits(self, g: Gaussians, quantizer: Quantizer) -> np.ndarray:
        """Of the codes of `on(g)`, [n], for one who knows g and the noise before the last step, not only its codes."""
        expected = Gaussians(*(a + s for a, s in zip(_arrays(g), self._foretold, strict=True)))
        return noise_bits(expected, self._sigma, quantizer)

    def on(self, g: Gaussians) -> Gaussians:
        noisy = Gaussians(*(a + s for a, s in zip(_arrays(g), self._state, strict=True)))
        return replace(noisy, quaternions=_unit(noisy.quaternions))


def _arrays(g: Gaussians) -> tuple[np.ndarray, ...]:
    return g.means, g.log_scales, g.quaternions, g.opacity_logits, g.sh


def make_sequence(source: Gaussians, options: SequenceOptions) -> tuple[list[Segment], Quantizer, float]:
    """Segments of one made-up sequence, pruned by the UV map at each key, their quantizer, and the least bits.

    What no segment touched keeps its codes from key to key, as in a fit; the actor is fitted anew at each. The least
    bits are those of the noise in all frames but the keys: no code of these frames is smaller on average.
    """
    rng = np.random.default_rng(options.seed)
    around = _surroundings(source, options.still, rng)
    actor = _placed(_pick(source, rng.permutation(len(source))[: options.actor]), 1.8, np.zeros(3))
    quantizer = _quantizer(_join([around, _posed(actor, 0)]))
    azimuth = np.arctan2(around.means[:, 1], around.means[:, 0])
    segments, least_bits = [], 0.0
    for number in range(options.keyframes):
        away = np.abs(np.angle(np.exp(1j * (azimuth - 0.5 - 0.15 * number))))
        near = np.argsort(away, kind="stable")[: options.restless]
        segment, touched, bits = _segment(number * options.frames, around, near, actor, quantizer, options, rng)
        segments.append(segment)
        least_bits += bits
        for old, new in zip(_arrays(around), _arrays(touched), strict=True):
            old[near] = new
    return segments, quantizer, least_bits


def _segment(
    first: int,
    around: Gaussians,
    near: np.ndarray,
    actor: Gaussians,
    quantizer: Quantizer,
    options: SequenceOptions,
    rng: np.random.Generator,
) -> tuple[Segment, Gaussians, float]:
    """A segment, what the surroundings that it touched are in the end, and the least bits of its frames."""
    restless = _pick(around, near)
    moving = _join([restless, _posed(actor, first / 30)])
    noise = _FitNoise(moving, options.noise, rng)
    noise.step()  # every key is a fit of its own
    fitted = _pick(noise.on(moving), np.arange(len(restless), len(moving)))
    key = _join([around, fitted])
    kept = assign_slots(key.means, key.opacity_logits, quantizer.centre, options=UvOptions()).kept
    dynamic = np.isin(np.arange(len(key)), near) | (np.arange(len(key)) >= len(around))
    place = np.concatenate([np.argsort(np.argsort(near)), np.arange(len(restless), len(moving))])
    order = np.argsort(place, kind="stable")  # rows of `moving` in the order of the key
    last, frames, least_bits = moving, [], 0.0
    for frame in range(first + 1, first + options.frames):
        noise.step()
        moved = _join([restless, _posed(actor, frame / 30)])
        last = noise.on(moved)
        frames.append(quantizer.encode(_pick(last, order))[kept[dynamic]])
        least_bits += float(noise.least_bits(moved, quantizer)[order][kept[dynamic]].sum())
    count = int((dynamic & kept).sum())
    xyz = np.array([f.xyz for f in frames], np.uint16).reshape(-1, count, 3)
    attributes = np.array([f.attributes for f in frames], np.uint8).reshape(len(frames), count, -1)
    segment = Segment(first, quantizer.encode(key)[kept], dynamic[kept], xyz, attributes)
    return segment, _pick(last, np.arange(len(restless))), least_bits


def _quantizer(key: Gaussians) -> Quantizer:
    """Ranges with margin from the first frame, centre in the actor."""
    values = attribute_values(key)
    low, high = np.percentile(values, [0.02, 99.98], axis=0)
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    low[ROTATION], high[ROTATION] = -1, 1
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    return Quantizer(np.zeros(3), 1.0, np.abs(key.means).max(axis=0) * 1.2, low, high, key.sh_degree)


def find_gaussians(seed: int) -> tuple[Gaussians, str]:
    """Gaussians to make a sequence of, and where they are from."""
    if any((DATA / "splats").glob("*.compressed.ply")):
        return trained_gaussians(DATA / "splats"), "trained scenes"
    return made_up_gaussians(250_000, np.random.default_rng(seed)), "made-up surfaces"
