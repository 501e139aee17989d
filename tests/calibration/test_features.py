"""Matches against a naive twin, and tracks against connected components."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.features import Band, FeatureOptions, Features, _all_rivals, _rivals, detect, match, pairs_by_look
from calibration.tracks import Link, chain
from tests.support.calibration_scene import filmed


def features(descriptors: np.ndarray) -> Features:
    count = len(descriptors)
    return Features(
        np.zeros((count, 2)), descriptors.astype(np.int16), np.arange(count), np.arange(count, dtype=np.float32)
    )


def naive(a: np.ndarray, b: np.ndarray, allowed: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    """Mutual nearest with the ratio test in both directions, by sorting every row and column."""
    distance = ((a[:, None].astype(np.int64) - b[None]) ** 2).sum(axis=2).astype(float)
    distance[~allowed] = np.inf
    found = []
    for i in range(len(a)):
        j = int(distance[i].argmin())
        rivals = np.sort(distance[i])[1:2].tolist() + np.sort(distance[:, j])[1:2].tolist()
        mutual = np.isfinite(distance[i, j]) and int(distance[:, j].argmin()) == i
        if mutual and all(distance[i, j] < ratio**2 * rival for rival in rivals):
            found.append((i, j))
    return found


@settings(max_examples=60)
@given(
    st.integers(0, 12), st.integers(0, 12), st.integers(0, 2**32 - 1), st.sampled_from([0.7, 0.9, 1.0]), st.booleans()
)
def test_matches_equal_a_naive_twin(n, m, seed, ratio, banded):
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, 4, (n, 128)), rng.integers(0, 4, (m, 128))
    copies = min(n, m) // 2
    b[:copies] = a[:copies] + (rng.uniform(size=(copies, 128)) < 0.1)
    lines, rays = rng.normal(size=(n, 3)), rng.normal(size=(m, 3))
    band = Band(lines, rays, np.full(n, 1.5), rng.uniform(0.5, 2, m))
    allowed = np.ones((n, m), bool)
    if banded:
        allowed = np.abs(lines @ rays.T) <= np.minimum(band.first_reach[:, None], band.second_reach[None])
    rows, distances = match(features(a), features(b), ratio=ratio, band=band if banded else None)
    assert list(map(tuple, rows.tolist())) == (naive(a, b, allowed, ratio) if n and m else [])
    assert distances.tolist() == [((a[i] - b[j]) ** 2).sum() for i, j in rows.tolist()]


@pytest.mark.parametrize("largest", [2, 90, 5000])
def test_products_of_matrices_find_the_rivals_that_sums_find(largest):
    """Also over several blocks, for equal distances, and where float32 would round."""
    rng = np.random.default_rng(largest)
    a, b = (rng.integers(0, largest + 1, (count, 128)).astype(np.int16) for count in (600, 300))
    b[:100] = a[500:]
    everything = np.zeros((600, 3)), np.zeros((300, 3)), np.ones(600), np.ones(300)
    found, wanted = _all_rivals(a, b), _rivals(a, b, *everything)
    assert all(np.array_equal(x, y) for x, y in zip(found, wanted, strict=True))


def test_a_picture_gives_the_same_features_twice_sorted_by_place():
    picture = filmed(6)[2]["cam2"]
    once, again = detect(picture), detect(picture.copy())
    assert all(np.array_equal(getattr(once, key), getattr(again, key)) for key in ("pixels", "descriptors", "places"))
    assert np.all(np.diff(once.places) >= 0)
    assert len(once.pixels) > 300
    assert np.all((once.pixels > 0) & (once.pixels < (320, 240)))


def test_features_lie_where_the_pixel_convention_says():
    """A blob centred on the corner shared by four pixels lies at whole coordinates."""
    y, x = np.mgrid[:96, :128] + 0.5
    blob = 255 * np.exp(-((x - 60) ** 2 + (y - 40) ** 2) / 50)
    found = detect(np.repeat(blob.astype(np.uint8)[:, :, None], 3, axis=2))
    distance = np.linalg.norm(found.pixels - (60, 40), axis=1)
    assert distance.min() < 0.1  # SIFT's interpolation; half a pixel of convention would be 0.7


def test_an_empty_picture_has_no_features_and_no_matches():
    none = detect(np.full((64, 64, 3), 90, np.uint8))
    assert len(none.pixels) == 0
    assert len(match(none, none, ratio=0.8)[0]) == 0
    with pytest.raises(ValueError, match="at least 8"):
        FeatureOptions(max_features=3)


def test_pairs_by_look_finds_the_neighbours_among_many():
    pictures = filmed(6)[2]
    found = {name: detect(picture) for name, picture in pictures.items()}
    assert len(pairs_by_look(found, ratio=0.8)) == 15
    few = pairs_by_look(found, ratio=0.8, exhaustive=3, partners=2)
    assert {("cam0", "cam1"), ("cam4", "cam5")} <= set(few)
    assert len(few) < 15


links = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 4), st.integers(0, 3), st.integers(0, 4), st.integers(0, 50)),
    max_size=25,
)


@given(links, st.integers(2, 3))
def test_tracks_have_each_camera_once_and_join_only_linked_places(entries, min_views):
    entries = [(a, p, b, q, d) for a, p, b, q, d in entries if a != b]
    given_links = [Link(a, b, np.array([[p, q]], np.int32), np.array([d], np.int32)) for a, p, b, q, d in entries]
    point, camera, place = chain(given_links, dict.fromkeys(range(4), 5), min_views=min_views)
    tracks: dict[int, set[tuple[int, int]]] = {}
    for track, c, p in zip(point.tolist(), camera.tolist(), place.tolist(), strict=True):
        tracks.setdefault(track, set()).add((c, p))
    groups = components([((a, p), (b, q)) for a, p, b, q, _ in entries])
    assert sorted(tracks) == list(range(len(tracks)))
    for track in tracks.values():
        assert len({c for c, _ in track}) == len(track) >= min_views
        assert any(track <= group for group in groups)
    for group in groups:
        if len({c for c, _ in group}) == len(group) >= min_views:  # nothing in conflict: nothing may be lost
            assert group in tracks.values()


def components(edges: list[tuple[tuple[int, int], tuple[int, int]]]) -> list[set[tuple[int, int]]]:
    groups: list[set[tuple[int, int]]] = []
    for edge in edges:
        touched = [group for group in groups if group & set(edge)]
        groups = [group for group in groups if not group & set(edge)] + [set(edge).union(*touched)]
    return groups


def test_the_nearest_match_wins_a_conflict():
    wrong = Link(0, 1, np.array([[0, 1]], np.int32), np.array([9], np.int32))
    right = Link(0, 1, np.array([[0, 0]], np.int32), np.array([4], np.int32))
    point, camera, place = chain([wrong, right], {0: 2, 1: 2}, min_views=2)
    assert (point.tolist(), camera.tolist(), place.tolist()) == ([0, 0], [0, 1], [0, 0])


@pytest.mark.parametrize("counts", [{}, {0: 0, 1: 0}])
def test_pictures_without_features_have_no_tracks(counts):
    assert [len(part) for part in chain([], counts, min_views=2)] == [0, 0, 0]
