"""Laws of what keys take from each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.segment import Segment
from packuv.scene.sharing import (
    KEPT_DYNAMIC,
    KEPT_STILL,
    KeyPlanner,
    assemble,
    match_rows,
    morton_codes,
    row_order,
    stored_segments,
)


def same(a, b):
    return np.array_equal(a.xyz, b.xyz) and np.array_equal(a.attributes, b.attributes)


def rows_of(codes):
    """Rows as bytes, sorted."""
    return sorted(x.tobytes() + a.tobytes() for x, a in zip(codes.xyz, codes.attributes, strict=True))


def random_codes(rng, count, values=65536):
    """Few values make equal rows."""
    xyz = rng.integers(0, values, (count, 3)).astype(np.uint16)
    return Codes(xyz, rng.integers(0, min(values, 256), (count, 10)).astype(np.uint8))


def next_key(rng, key, kept, fresh):
    """A later key: some rows survive in their order, new ones follow."""
    survivors = key[rng.random(len(key)) < kept]
    new = random_codes(rng, fresh)
    return Codes(np.concatenate([survivors.xyz, new.xyz]), np.concatenate([survivors.attributes, new.attributes]))


def changed_segment(rng, first, key, frames=2):
    dynamic = rng.random(len(key)) < 0.3
    count = int(dynamic.sum())
    xyz = rng.integers(0, 65536, (frames - 1, count, 3)).astype(np.uint16)
    attributes = rng.integers(0, 256, (frames - 1, count, 10)).astype(np.uint8)
    return Segment(first, key, dynamic, xyz, attributes)


def sequence(seed, sizes, kept, frames=2):
    """Segments whose keys keep part of the rows of the one before."""
    rng, result, key = np.random.default_rng(seed), [], None
    for number, fresh in enumerate(sizes):
        key = random_codes(rng, fresh + 1) if key is None else next_key(rng, key, kept, fresh)
        if not len(key):
            key = random_codes(rng, 1)
        result.append(changed_segment(rng, number * frames, key, frames))
    return result


sequences = st.builds(
    sequence,
    st.integers(0, 2**32 - 1),
    st.lists(st.integers(0, 120), min_size=1, max_size=6),
    st.sampled_from([0.0, 0.5, 0.9, 1.0]),
)


def test_morton_codes_interleave_the_bits():
    xyz = np.random.default_rng(0).integers(0, 65536, (200, 3), np.uint16)
    for position, code in zip(xyz.tolist(), morton_codes(xyz).tolist(), strict=True):
        assert code == sum((position[a] >> b & 1) << (3 * b + a) for b in range(16) for a in range(3))


@settings(max_examples=30)
@given(st.integers(0, 300), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_rows_go_dynamic_first_then_along_the_curve(count, values, seed):
    rng = np.random.default_rng(seed)
    xyz, dynamic = rng.integers(0, values, (count, 3)).astype(np.uint16), rng.random(count) < 0.5
    order = row_order(xyz, dynamic)
    keys = list(zip((~dynamic[order]).tolist(), morton_codes(xyz[order]).tolist(), order.tolist(), strict=True))
    assert keys == sorted(keys)  # ties as they came
    assert sorted(order.tolist()) == list(range(count))


@settings(max_examples=50)
@given(st.integers(0, 80), st.integers(0, 80), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_every_row_is_matched_that_can_be_and_none_twice(first, second, values, seed):
    rng = np.random.default_rng(seed)
    a, b = random_codes(rng, first, values), random_codes(rng, second, values)
    if first and second:  # equal rows on both sides, some more than once
        for source, target in zip(rng.integers(0, first, 20), rng.integers(0, second, 20), strict=True):
            b.xyz[target], b.attributes[target] = a.xyz[source], a.attributes[source]
    here, there = match_rows(a, b)
    assert same(a[here], b[there])
    assert (np.diff(here) > 0).all()
    assert len(set(there.tolist())) == len(there)
    left = [rows_of(a), rows_of(b)]
    common = sum(min(left[0].count(row), left[1].count(row)) for row in set(left[0]))
    assert len(here) == common


@settings(max_examples=50)
@given(sequences, st.integers(1, 4))
def test_plans_give_back_every_key_within_reach(segments, reach):
    planner, keys, plans = KeyPlanner(reach), [], []
    for number, segment in enumerate(segments):
        plan = planner.plan(segment)
        assert plan.reference is None or plan.reference < number
        reference = None if plan.reference is None else keys[plan.reference]
        key = assemble(reference, plan.fates, segment.key[plan.own], plan.own_dynamic)
        assert same(key, segment.key[plan.order])
        assert segment.dynamic[plan.order].tolist() == sorted(segment.dynamic, reverse=True)
        assert len(plan.own) + np.count_nonzero(plan.fates) == len(segment.key)
        keys.append(key)
        plans.append(plan)
        steps, at = 1, plan.reference
        while at is not None:
            steps, at = steps + 1, plans[at].reference
        assert steps <= reach


@settings(max_examples=30)
@given(sequences, st.integers(1, 4))
def test_stored_order_only_permutes_rows(segments, reach):
    planner = KeyPlanner(reach)
    plans = [planner.plan(segment) for segment in segments]
    in_order = stored_segments(segments, references=[plan.reference for plan in plans])
    for segment, stored, plan in zip(segments, in_order, plans, strict=True):
        assert same(stored.key, segment.key[plan.order])
        assert np.array_equal(stored.dynamic, np.sort(segment.dynamic)[::-1])
        for index in range(len(segment)):
            assert rows_of(stored.frame(index)) == rows_of(segment.frame(index))


def test_what_did_not_change_is_not_stored_again():
    rng = np.random.default_rng(0)
    key = random_codes(rng, 5000)
    planner = KeyPlanner(4)
    plans = []
    for number in range(10):
        plans.append(planner.plan(changed_segment(rng, number, key)))
        changed = rng.permutation(5000)[:500]
        key = Codes(key.xyz.copy(), key.attributes.copy())
        key.attributes[changed, OPACITY] += 1
    assert [len(plan.own) for plan in plans[:4]] == [5000, 500, 500, 500]  # each refers to the one before
    assert sum(len(plan.own) for plan in plans) < 0.35 * 10 * 5000  # past the reach they refer to earlier ones
    assert set(plans[1].fates.tolist()) == {0, KEPT_STILL, KEPT_DYNAMIC}


def test_an_aged_root_is_renewed():
    rng, planner = np.random.default_rng(0), KeyPlanner(2)
    key, plans = random_codes(rng, 2000), []
    for number in range(12):
        plans.append(planner.plan(changed_segment(rng, number, key)))
        key = next_key(rng, key, 0.9, 200)
    roots = [number for number, plan in enumerate(plans) if plan.reference is None]
    assert 2 <= len(roots) <= 4
    assert {plan.reference for plan in plans if plan.reference is not None} <= set(roots)


def test_a_key_that_is_new_stands_alone():
    segments = sequence(3, [100, 9000], kept=1.0)
    planner = KeyPlanner(4)
    assert [planner.plan(segment).reference for segment in segments] == [None, None]
    assert [KeyPlanner(1).plan(segment).reference for segment in sequence(3, [1000, 10], kept=1.0)] == [None, None]


@pytest.mark.parametrize("columns", [10, 19])
def test_rows_of_any_width_match(columns):
    rng = np.random.default_rng(1)
    xyz, attributes = (
        rng.integers(0, 9, (500, 3)).astype(np.uint16),
        rng.integers(0, 9, (500, columns)).astype(np.uint8),
    )
    codes = Codes(xyz, attributes)
    here, there = match_rows(codes, codes)
    assert np.array_equal(here, there)
    assert len(here) == 500
