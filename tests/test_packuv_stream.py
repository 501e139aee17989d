"""Laws of the compact layout, and of the quantizer whose codes it stores."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.interchange import read_ply
from packuv.quantize import OPACITY, OPACITY_RANGE, ROTATION, Codes, Gaussians, Quantizer, attribute_count
from packuv.segment import Segment
from packuv.stream import (
    BLOCK,
    LINEAR,
    NEUTRAL,
    PREVIOUS,
    REPEAT,
    Mosaic,
    Playback,
    changes,
    changing_channels,
    channel_names,
    entropy_bits,
    hilbert,
    hold_absent,
    in_storage_order,
    key_codes,
    key_rows,
    morton_codes,
    storage_order,
)

SPLATS = Path(os.environ.get("PACKUV_DATA", Path(__file__).parents[1] / "../shared/data")) / "splats"


def random_codes(rng, count, columns):
    return Codes(rng.integers(0, 65536, (count, 3), np.uint16), rng.integers(0, 256, (count, columns), np.uint8))


def random_segment(seed, rows, dynamic, frames, degree=0):
    """A random walk with births, deaths and frames in which nothing happens."""
    rng, columns = np.random.default_rng(seed), attribute_count(degree)
    key, mask = random_codes(rng, rows, columns), rng.permutation(rows) < dynamic
    key.attributes[rng.random(rows) < 0.3, OPACITY] = 0
    xyz, attributes = [key.xyz[mask]], [key.attributes[mask]]
    for _ in range(frames - 1):
        still = rng.random() < 0.25
        step = 0 if still else rng.integers(-300, 301, (dynamic, 3))
        change = 0 if still else rng.integers(-4, 5, (dynamic, 1)) + rng.integers(0, 2, (dynamic, columns))
        xyz.append((xyz[-1] + step).astype(np.uint16))
        attributes.append((attributes[-1] + change).astype(np.uint8))
        if not still:
            attributes[-1][rng.random(dynamic) < 0.2, OPACITY] = 0
    return Segment(0, key, mask, np.stack(xyz)[1:], np.stack(attributes)[1:])


segments = st.builds(
    lambda seed, rows, share, frames, degree: random_segment(seed, rows, int(rows * share), frames, degree),
    st.integers(0, 2**32 - 1),
    st.integers(1, 300),
    st.sampled_from([0.0, 0.3, 1.0]),
    st.integers(1, 6),
    st.integers(0, 2),
)


def same(a: Codes, b: Codes) -> bool:
    return np.array_equal(a.xyz, b.xyz) and np.array_equal(a.attributes, b.attributes)


def full_mosaic(capacity, channels):
    return Mosaic.of(capacity, tuple(range(channels)), channels)


# Order


def test_morton_codes_interleave_the_bits():
    xyz = np.random.default_rng(0).integers(0, 65536, (200, 3), np.uint16)
    for position, code in zip(xyz.tolist(), morton_codes(xyz).tolist(), strict=True):
        assert code == sum((position[a] >> b & 1) << (3 * b + a) for b in range(16) for a in range(3))


def test_the_hilbert_curve_fills_a_block_step_by_step():
    x, y = hilbert(np.arange(BLOCK**2))
    assert len(set(zip(x.tolist(), y.tolist(), strict=True))) == BLOCK**2
    assert (np.abs(np.diff(x)) + np.abs(np.diff(y)) == 1).all()
    assert (x[0], y[0], x[-1], y[-1]) == (0, 0, BLOCK - 1, 0)


@settings(max_examples=30, deadline=None)
@given(segments)
def test_storage_order_permutes_rows_and_puts_the_dynamic_ones_first(segment):
    order, stored = storage_order(segment), in_storage_order(segment)
    assert np.array_equal(np.sort(order), np.arange(len(segment.key)))
    assert np.array_equal(stored.dynamic, np.sort(segment.dynamic)[::-1])
    for index in range(len(segment)):
        assert same(stored.frame(index), segment.frame(index)[order])


# Pictures


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 3000), st.sets(st.integers(0, 60), min_size=1, max_size=61), st.integers(0, 2**32 - 1))
def test_a_mosaic_gives_back_its_rows(count, chosen, seed):
    channels = tuple(sorted(chosen))
    mosaic = Mosaic.of(count, channels, 61)
    rng = np.random.default_rng(seed)
    rows, constants = rng.integers(0, 256, (count, 61), np.uint8), rng.integers(0, 256, 61, np.uint8)
    rows[:, [c for c in range(61) if c not in chosen]] = constants[[c for c in range(61) if c not in chosen]]
    picture = mosaic.draw(rows)
    assert np.array_equal(mosaic.read(picture, constants, count), rows)
    assert (picture != NEUTRAL).sum() == (rows[:, channels] != NEUTRAL).sum()  # unused cells are neutral
    across, down = mosaic.grid
    assert len(channels) <= across * down
    assert down <= across <= 2 * down  # what FFV1 can slice
    assert picture.shape == (mosaic.height, mosaic.width)


def test_cells_of_a_plane_are_its_own():
    mosaic = full_mosaic(3000, 5)
    used = np.concatenate([corner + mosaic.cells for corner in mosaic.corners])
    assert len(np.unique(used)) == 5 * mosaic.capacity
    assert mosaic.capacity >= 3000


def test_channel_names_are_one_per_byte():
    for degree in range(4):
        names = channel_names(degree)
        assert len(set(names)) == len(names) == 6 + attribute_count(degree)


@given(st.integers(0, 2**32 - 1), st.integers(0, 300), st.integers(0, 3))
@settings(max_examples=30, deadline=None)
def test_key_bytes_are_reversible(seed, count, degree):
    codes = random_codes(np.random.default_rng(seed), count, attribute_count(degree))
    assert same(key_codes(key_rows(codes)), codes)


# Changes


def play(stored, mosaic):
    """Every frame of a segment, by way of pictures."""
    count = stored.xyz.shape[1]
    playback = Playback(Codes(stored.key.xyz.copy(), stored.key.attributes.copy()), count)
    for change in changes(stored):
        picture = None if change.rows is None else mosaic.draw(change.rows)
        playback.advance(change.prediction, change.differences, mosaic, picture)
        yield playback.codes


@settings(max_examples=30, deadline=None)
@given(segments)
def test_changes_give_back_every_code(segment):
    stored = in_storage_order(segment)
    mosaic = full_mosaic(stored.xyz.shape[1], 6 + stored.key.attributes.shape[1])
    for index, codes in enumerate(play(stored, mosaic), start=1):
        assert same(codes, stored.frame(index))


@settings(max_examples=30, deadline=None)
@given(segments, st.integers(0, 5))
def test_channels_that_never_change_need_no_plane(segment, frozen):
    segment.attributes[:, :, frozen] = segment.key.attributes[segment.dynamic, frozen]
    stored = in_storage_order(segment)
    changing = changing_channels(stored)
    assert not changing[6 + frozen]
    mosaic = Mosaic.of(stored.xyz.shape[1], tuple(np.flatnonzero(changing).tolist()) or (0,), len(changing))
    for index, codes in enumerate(play(stored, mosaic), start=1):
        assert same(codes, stored.frame(index))
    for change in changes(stored):
        assert change.rows is None or (change.rows[:, ~changing] == NEUTRAL).all()


def moving(steps, present=None):
    """One Gaussian at the positions of a walk, opacity 200 where present."""
    walk = np.cumsum([30000, *steps]).astype(np.uint16)
    present = np.ones(len(walk), bool) if present is None else np.asarray(present)
    xyz = np.repeat(walk[:, None, None], 3, axis=2)  # [T, 1, 3]
    attributes = np.full((len(walk), 1, 10), 7, np.uint8)
    attributes[:, :, OPACITY] = np.where(present, 200, 0)[:, None]
    return Segment(0, Codes(xyz[0], attributes[0]), np.ones(1, bool), xyz[1:], attributes[1:])


def test_steady_motion_is_predicted():
    first, *others = changes(moving([40, 40, 40, 40]))
    assert first.prediction == PREVIOUS
    assert all(change.prediction in (PREVIOUS, LINEAR) for change in others)
    crowd = moving([40, 40, 40, 40])
    steps = np.random.default_rng(0).integers(-200, 200, (50, 3))
    xyz = (crowd.key.xyz + steps * np.arange(5)[:, None, None]).astype(np.uint16)
    attributes = np.full((5, 50, 10), 7, np.uint8)
    segment = Segment(0, Codes(xyz[0], attributes[0]), np.ones(50, bool), xyz[1:], attributes[1:])
    _, *others = changes(segment)
    for change in others:
        assert change.prediction == LINEAR
        assert (change.rows == NEUTRAL).all()


def test_a_frame_in_which_nothing_changes_stores_nothing():
    predictions = [change.prediction for change in changes(moving([5, 0, 0, 9]))]
    assert predictions[1:3] == [REPEAT, REPEAT]
    assert predictions[0] != REPEAT
    assert predictions[3] != REPEAT


def test_colours_that_change_together_are_stored_as_differences():
    rng = np.random.default_rng(0)
    key = random_codes(rng, 2000, 10)
    light = rng.integers(-20, 20, (2000, 1)).astype(np.uint8)
    attributes = key.attributes.copy()
    attributes[:, 7:10] += light
    segment = Segment(0, key, np.ones(2000, bool), key.xyz[None], attributes[None])
    (change,) = changes(segment)
    assert change.differences
    assert (change.rows[:, [13, 15]] == NEUTRAL).all()
    (codes,) = play(in_storage_order(segment), full_mosaic(2000, 16))
    assert same(codes, in_storage_order(segment).frame(1))


def test_after_a_repeat_nothing_moves_on():
    mosaic, segment = full_mosaic(1, 16), moving([40, 40])
    playback = Playback(segment.key, 1)
    first, _ = changes(segment)
    playback.advance(first.prediction, first.differences, mosaic, mosaic.draw(first.rows))
    playback.advance(REPEAT, False, mosaic, None)
    playback.advance(LINEAR, False, mosaic, mosaic.blank())
    assert playback.codes.xyz[0].tolist() == [30040] * 3


def test_entropy_is_that_of_the_definition():
    rows = np.array([[0, 5], [0, 5], [1, 5], [1, 5]], np.uint8)
    assert entropy_bits(rows) == 4.0
    assert entropy_bits(rows[:0]) == 0.0


# Absence


@settings(max_examples=30, deadline=None)
@given(segments)
def test_holding_absent_rows_changes_nothing_that_is_seen(segment):
    held = hold_absent(segment)
    for index in range(len(segment)):
        before, after = segment.frame(index), held.frame(index)
        present = before.attributes[:, OPACITY] > 0
        assert same(before[present], after[present])
        assert np.array_equal(before.attributes[:, OPACITY], after.attributes[:, OPACITY])
        assert same(before[~segment.dynamic], after[~segment.dynamic])


@settings(max_examples=30, deadline=None)
@given(segments)
def test_held_rows_store_nothing_but_their_opacity_while_absent(segment):
    stored = in_storage_order(hold_absent(segment))
    count = stored.xyz.shape[1]
    for frame, change in enumerate(changes(stored), start=1):
        then, now = (stored.frame(t).attributes[:count, OPACITY] > 0 for t in (frame - 1, frame))
        if change.rows is not None and not change.differences:
            others = np.delete(change.rows, 6 + OPACITY, axis=1)
            assert (others[~now] == NEUTRAL).all()
            ever = np.array([stored.frame(t).attributes[:count, OPACITY] for t in range(frame)]).any(axis=0)
            assert (others[now & ~then & ~ever] == NEUTRAL).all()  # born with what the row already held


# The quantizer


def quantizer(degree=0, centre=(0.0, 0.0, 0.0), unit=1.0, reach=20.0):
    low, high = np.full(attribute_count(degree), -2.0), np.full(attribute_count(degree), 3.0)
    low[:3], high[:3] = -9, 1
    low[ROTATION], high[ROTATION] = -1, 1
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    return Quantizer(np.array(centre, float), unit, np.full(3, reach), low, high, degree)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.01, 100), st.floats(0.5, 1000), st.floats(-50, 50))
def test_every_position_code_survives_decoding(unit, reach_in_units, centre_in_units):
    # Holds while float32 resolves the finest step at the centre: |centre| 2^-24 < unit * edge / 65535 / 2.
    q = quantizer(centre=(centre_in_units * unit,) * 3, unit=unit, reach=reach_in_units * unit)
    codes = Codes(np.repeat(np.arange(65536, dtype=np.uint16)[:, None], 3, axis=1), np.full((65536, 10), 128, np.uint8))
    decoded = q.decode(codes)
    assert (np.diff(decoded.means, axis=0) > 0).all()  # monotone
    assert np.array_equal(q.encode(decoded).xyz, codes.xyz)


@pytest.mark.parametrize("degree", [0, 3])
def test_every_attribute_code_survives_decoding_and_rotations_do_inside_the_unit_ball(degree):
    q, rng = quantizer(degree), np.random.default_rng(degree)
    codes = random_codes(rng, 20000, attribute_count(degree))
    codes.attributes[:256] = np.arange(256)[:, None]
    codes.attributes[:256, ROTATION] = 128
    decoded = q.decode(codes)
    again = q.encode(decoded)
    others = np.delete(np.arange(attribute_count(degree)), np.arange(3, 6))
    assert np.array_equal(again.attributes[:, others], codes.attributes[:, others])
    # A vector longer than 1 is no unit quaternion: it comes back shortened to the ball's surface.
    inside = (decoded.quaternions[:, 1:].astype(np.float64) ** 2).sum(axis=1) <= 1
    assert 0.3 < inside.mean() < 0.7
    assert np.array_equal(again.attributes[inside, 3:6], codes.attributes[inside, 3:6])
    assert (np.diff(q.attribute_table, axis=1) > 0).all()


def test_absent_gaussians_are_below_what_renderers_draw():
    q = quantizer()
    absent = q.decode(Codes(np.zeros((1, 3), np.uint16), np.zeros((1, 10), np.uint8))).opacity_logits[0]
    assert 1 / (1 + np.exp(-absent)) < 1 / 255


def test_position_error_is_at_most_half_a_step():
    rng, q = np.random.default_rng(0), quantizer()
    means = rng.uniform(-19, 19, (10000, 3)).astype(np.float32)
    n = len(means)
    blank = Gaussians(means, np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)), np.zeros(n), np.zeros((n, 1, 3)))
    error = np.abs(q.decode(q.encode(blank)).means.astype(np.float64) - means)
    step = (np.abs(means) + 1) * np.log1p(20) / 32767.5  # derivative of the symmetric logarithm, unit 1
    assert (error <= 0.5 * step * 1.001 + 2e-6).all()  # curvature of the scale; rounding to float32 at 20


@pytest.mark.skipif(not SPLATS.is_dir(), reason="needs trained scenes under PACKUV_DATA")
@pytest.mark.parametrize("name", ["biker", "guitar"])
def test_positions_cost_a_small_share_of_a_trained_gaussians_size(name):
    scene = read_ply(SPLATS / f"{name}.compressed.ply")
    q = quantizer(reach=8.0)
    error = np.linalg.norm(q.decode(q.encode(scene)).means - scene.means, axis=1)
    share = error / np.exp(np.sort(scene.log_scales, axis=1)[:, 1])
    # The claim is a median of 0.01 to 0.02 of the middle standard deviation; 0.018 and 0.015 were measured, and 0.26
    # and 0.19 at the 99th percentile, which is Gaussians of 1 mm.
    assert np.median(share) < 0.02
    assert np.percentile(share, 99) < 0.35
