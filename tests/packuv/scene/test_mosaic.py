"""Laws of the mosaics: every row has its own cells, and comes back from them."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.scene.mosaic import BLOCK, NEUTRAL, Mosaic, hilbert


def test_the_hilbert_curve_fills_a_block_step_by_step():
    x, y = hilbert(np.arange(BLOCK**2))
    assert len(set(zip(x.tolist(), y.tolist(), strict=True))) == BLOCK**2
    assert (np.abs(np.diff(x)) + np.abs(np.diff(y)) == 1).all()
    assert (x[0], y[0], x[-1], y[-1]) == (0, 0, BLOCK - 1, 0)


@settings(max_examples=40)
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
    mosaic = Mosaic.of(3000, tuple(range(5)), 5, flagged=True)
    used = np.concatenate([corner + mosaic.cells for corner in [*mosaic.corners, mosaic.flag_corner]])
    assert len(np.unique(used)) == 6 * mosaic.capacity
    assert mosaic.capacity >= 3000


@settings(max_examples=30)
@given(st.integers(0, 1500), st.integers(0, 1500), st.integers(0, 2**32 - 1))
def test_flags_and_rows_do_not_touch_each_other(rows, flags, seed):
    rng = np.random.default_rng(seed)
    mosaic = Mosaic.of(max(rows, flags), (0, 2), 3, flagged=True)
    content = rng.integers(0, 256, (rows, 3), np.uint8)
    content[:, 1] = 7
    raised = rng.integers(0, 3, flags).astype(np.uint8)
    picture = mosaic.draw(content, raised)
    assert np.array_equal(mosaic.read(picture, np.full(3, 7, np.uint8), rows), content)
    assert np.array_equal(mosaic.read_flags(picture, flags), raised)
    assert not mosaic.read_flags(picture, mosaic.capacity)[flags:].any()


def test_a_mosaic_without_flags_has_no_plane_for_them():
    bare = Mosaic.of(100, (0, 1, 2, 3), 4)
    assert bare.planes == 4
    assert bare.flag_corner == -1
    assert np.array_equal(
        bare.draw(np.zeros((5, 4), np.uint8), np.ones(5, np.uint8)), bare.draw(np.zeros((5, 4), np.uint8))
    )
