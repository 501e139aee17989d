"""Networks of the compression benchmark: what is stored comes back, coarser is smaller and worse, seeds decide."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from packuv.compress.networks import MOST_LATENT, Examples, neighbours, train
from packuv.gaussians.codes import Codes, Quantizer
from packuv.scene import open_scene, write_scene
from packuv.scene.mosaic import NEUTRAL
from tests.support.small_scene import small_scene, small_segments

COUNT, LATER, MOVING = 1000, 3, 200


def synthetic(wide=1.0):
    """Rows of four columns, of which two go together and all drift from neighbour to neighbour."""
    rng = np.random.default_rng(1)
    walk = np.cumsum(rng.normal(size=(COUNT, 2)), axis=0)
    values = np.concatenate([walk, walk + rng.normal(size=(COUNT, 2))], axis=1) * 3 / wide
    moving = values[:MOVING] + np.cumsum(rng.normal(size=(LATER, MOVING, 4)), axis=0) / wide
    weights = np.ones((COUNT, 4), np.float32)
    return Examples(values.astype(np.float32), weights, neighbours(COUNT), moving.astype(np.float32))


def bits(latents):
    """Order-0 entropy of what neighbours do not tell, a row."""
    around = neighbours(COUNT)
    left, above, corner = (latents[around[:, side]] for side in range(3))
    residuals = latents - np.median([left, above, left + above - corner], axis=0)
    shares = [np.unique(column, return_counts=True)[1] / COUNT for column in residuals.T]
    return sum(-(share * np.log2(share)).sum() for share in shares)


@pytest.mark.parametrize(("latents", "hidden"), [(4, 0), (4, 8)])
def test_coarser_is_smaller_and_worse(latents, hidden):
    points = []
    for wide in (1.0, 4.0, 16.0):
        rows = synthetic(wide)
        transform = train(rows, latents, hidden=hidden, iterations=15)
        found = transform.latents(rows.key)
        points.append((bits(found), np.square((transform.values(found) - rows.key) * wide).mean()))
        assert np.abs(found).max() <= MOST_LATENT
    for (size, error), (next_size, next_error) in pairwise(points):
        assert next_size < size
        assert next_error > error


def test_a_seed_is_a_network():
    first, second, other = (train(synthetic(), 3, hidden=8, iterations=2, seed=seed) for seed in (1, 1, 2))
    assert all(a.equal(b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert not all(a.equal(b) for a, b in zip(first.parameters(), other.parameters(), strict=True))


def test_latents_come_back_from_a_scene_file(tmp_path):
    rows = synthetic()
    transform = train(rows, 4, hidden=8, iterations=2)
    segment, attributes = small_segments()[0], np.full((COUNT, 10), NEUTRAL, np.uint8)
    attributes[:, :4] = transform.latents(rows.key) + NEUTRAL
    moving = np.full((LATER, MOVING, 10), NEUTRAL, np.uint8)
    moving[..., :4] = transform.latents(rows.moving) + NEUTRAL
    place, still = np.zeros((COUNT, 3), np.uint16), np.zeros((LATER, MOVING, 3), np.uint16)
    stored = replace(
        segment, key=Codes(place, attributes), dynamic=np.arange(COUNT) < MOVING, xyz=still, attributes=moving
    )
    with open_scene(small_scene(tmp_path / "small.mkv")) as scene:
        quantizer = Quantizer(np.zeros(3), 1.0, np.ones(3), np.zeros(10), np.full(10, 255.0))
        header = replace(scene.header, quantizer=quantizer).first(1 + LATER)
    stored.save(tmp_path / "0.npz")
    write_scene(tmp_path / "latents.mkv", [tmp_path / "0.npz"], header)
    with open_scene(tmp_path / "latents.mkv") as scene:
        found = scene.segment(0)
    assert np.array_equal(found.key.attributes, attributes)
    assert np.array_equal(found.attributes, moving)
