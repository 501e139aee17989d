"""What noise costs at least, against draws of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.floor import noise_bits, rounded_bits
from bench.made_up import SequenceOptions, made_up_gaussians, make_sequence
from packuv.gaussians.floats import Gaussians
from packuv.scene.stream import entropy_bits
from tests.support.small_scene import small_quantizer
from tests.support.splats import FIELDS, random_gaussians

DRAWS = 40_000


@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.3, 5.0, 9.0])
@pytest.mark.parametrize("mean", [-0.3, 0.5, 2.0, 127.25, 254.9, 300.0])
def test_rounding_has_the_entropy_that_draws_of_it_have(mean, sigma):
    draws = np.random.default_rng(0).normal(mean, sigma, DRAWS)
    codes = np.clip(np.rint(draws), 0, 255).astype(np.uint8)
    found = rounded_bits(np.array([mean]), np.array([sigma]), 255)
    # Of 40,000 draws the entropy is known to 0.01 bits, less what rare codes lack.
    assert found[0] == pytest.approx(entropy_bits(codes[:, None]) / DRAWS, abs=0.015)


def test_wide_noise_costs_a_bit_more_at_twice_the_width():
    mean = np.full(3, 30_000.0)
    narrow, wide = (rounded_bits(mean, np.full(3, width), 65535) for width in (5.999, 599.9))
    assert wide - narrow == pytest.approx(np.full(3, np.log2(100) - 0.00167), abs=1e-5)  # rounding: 1 / (24 ln 2 36)


def test_what_is_certain_costs_nothing():
    assert rounded_bits(np.array([3.2, -7.0, 400.0]), np.array([0.0, 0.0, 0.0]), 255) == pytest.approx(np.zeros(3))


def test_rotations_cost_what_unit_quaternions_of_noise_do():
    """x, y and z are coded one after the other; all three together have no more and, at fine steps, no less."""
    coarse = small_quantizer()
    one = random_gaussians(1, 0, 4)
    expected = replace(one, means=np.array([[0.3, 0.2, 4.1]], np.float32))
    bits = noise_bits(expected, (1e-9, 1e-9, 0.02, 1e-9, 1e-9), coarse)
    rng = np.random.default_rng(1)
    noisy = expected.quaternions + rng.normal(0, 0.02, (DRAWS * 4, 4))
    many = Gaussians(*(np.repeat(getattr(expected, name), len(noisy), axis=0) for name in FIELDS))
    codes = coarse.encode(replace(many, quaternions=noisy.astype(np.float32))).attributes[:, 3:6].astype(np.int64)
    _, counts = np.unique(codes @ [65536, 256, 1], return_counts=True)
    share = counts / counts.sum()
    assert bits[0] == pytest.approx(-(share * np.log2(share)).sum(), abs=0.05)


def test_a_made_up_sequence_holds_no_less_than_its_noise():
    options = SequenceOptions(frames=3, still=600, restless=100, actor=1500, noise=1.0)
    (segment,), _, least = make_sequence(made_up_gaussians(3000, np.random.default_rng(0)), options)
    moving = segment.xyz.shape[1] * (len(segment) - 1)
    _, _, nothing = make_sequence(made_up_gaussians(3000, np.random.default_rng(0)), replace(options, noise=0.0))
    assert nothing == pytest.approx(0, abs=1e-3 * moving)
    assert 15 < least / moving < 45
