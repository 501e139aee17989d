import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, ROTATION, Codes, Quantizer, attribute_count
from packuv.gaussians.floats import Gaussians


def quantizer(sh_degree: int = 1) -> Quantizer:
    count = attribute_count(sh_degree)
    low, high = np.full(count, -2.0), np.full(count, 2.0)
    low[:3], high[:3], low[3:6], high[3:6] = -9.0, 0.0, -1.0, 1.0
    low[6], high[6] = OPACITY_RANGE
    return Quantizer(np.array([0.5, -1.0, 2.0]), 1.5, np.array([5.0, 6.0, 7.0]), low, high, sh_degree)


def codes(seed: int, count: int = 200, sh_degree: int = 1) -> Codes:
    rng = np.random.default_rng(seed)
    return Codes(
        rng.integers(0, 65536, (count, 3), dtype=np.uint16),
        rng.integers(0, 256, (count, attribute_count(sh_degree)), dtype=np.uint8),
    )


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_what_was_decoded_encodes_to_the_same_codes(seed):
    q, c = quantizer(), codes(seed)
    again = q.encode(q.decode(c))
    assert np.array_equal(again.xyz, c.xyz)
    others = np.delete(np.arange(c.attributes.shape[1]), np.arange(ROTATION.start, ROTATION.stop))
    assert np.array_equal(again.attributes[:, others], c.attributes[:, others])
    # Rotations longer than one have no w left: encoding normalises them. All others come back within one step,
    # the rounding of float32 where w is small.
    vector = q.attribute_table[3:6].T[c.attributes[:, ROTATION], np.arange(3)]
    valid = (vector**2).sum(axis=1) <= 1
    change = again.attributes[valid, ROTATION].astype(int) - c.attributes[valid, ROTATION]
    assert np.abs(change).max(initial=0) <= 1


def test_positions_err_less_than_half_a_step_of_the_logarithm():
    q = quantizer()
    rng = np.random.default_rng(1)
    offset = rng.uniform(-1, 1, (5000, 3)) * q.reach
    g = q.decode(codes(2, 5000))
    g.means[:] = q.centre + offset
    error = np.abs(q.decode(q.encode(g)).means - (q.centre + offset))
    step = 2 * np.log1p(q.reach / q.unit) / 65535
    bound = 0.5 * step * (q.unit + np.abs(offset)) * 1.01 + 1e-6  # derivative of the expansion, and float32
    assert (error <= bound).all()


def test_tables_rise():
    q = quantizer()
    assert (np.diff(q.xyz_table, axis=1) > 0).all()
    assert (np.diff(q.attribute_table, axis=1) > 0).all()


def test_opacity_code_zero_is_below_what_renderers_draw():
    logit = quantizer().attribute_table[OPACITY, 0]
    assert 1 / (1 + np.exp(-logit)) < 1 / 255


def test_saturation_counts_values_outside_and_encoding_clips_them():
    q = quantizer()
    g = q.decode(codes(3))
    assert q.saturation(g) == 0
    g.means[7, 1] = 1e9
    g.log_scales[9, 0] = 50
    assert q.saturation(g) == 2
    assert q.encode(g).xyz[7, 1] == 65535
    assert q.encode(g).attributes[9, 0] == 255


def test_json_gives_the_same_tables():
    q = quantizer()
    again = Quantizer.from_json(q.to_json())
    assert np.array_equal(again.xyz_table, q.xyz_table)
    assert np.array_equal(again.attribute_table, q.attribute_table)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"attributes must be uint8 \[4, A\]"):
        Codes(np.zeros((4, 3), np.uint16), np.zeros((5, 10), np.uint8))
    with pytest.raises(ValueError, match="SH degree 0 has 10 columns"):
        Quantizer(np.zeros(3), 1.0, np.ones(3), np.zeros(9), np.ones(9), 0)
    with pytest.raises(ValueError, match="codes have 10 columns, the quantizer 19"):
        quantizer(1).decode(codes(0, 4, sh_degree=0))


def test_quaternion_and_its_negative_are_one_rotation():
    q = quantizer()
    g = q.decode(codes(5))
    flipped = Gaussians(g.means, g.log_scales, -g.quaternions, g.opacity_logits, g.sh)
    positive = g.quaternions[:, 0] > 1e-3  # at w = 0 both signs are right
    assert np.array_equal(q.encode(flipped).attributes[positive], q.encode(g).attributes[positive])
