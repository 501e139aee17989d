import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.gaussians.uvmap import (
    Slots,
    UvOptions,
    assign_slots,
    atlas_layout,
    atlas_pixels,
    atlas_size,
    choose_centre,
    sphere_texels,
)

ORIGIN = np.zeros(3)
SMALL = UvOptions(rows=8, columns=8, layers=4)
MAPS = [
    UvOptions(),
    UvOptions(rows=64, columns=64, layers=1),
    UvOptions(rows=64, columns=64, layers=2),
    UvOptions(rows=64, columns=64, layers=7),
    UvOptions(rows=64, columns=32, layers=6),
    UvOptions(rows=24, columns=96, layers=5),
]


def all_slots(options: UvOptions) -> Slots:
    grids = [(k, *np.divmod(np.arange(m * n), n)) for k, (m, n) in enumerate(options.sizes)]
    layer = np.concatenate([np.full(len(row), k, np.int8) for k, row, _ in grids])
    return Slots(layer, *(np.concatenate([g[i] for g in grids]).astype(np.int32) for i in (1, 2)))


def test_layer_sizes_follow_the_papers_recurrence():
    sizes = UvOptions().sizes
    assert sizes[0] == (1024, 1024)
    for k in range(1, 8):
        m, n = sizes[k - 1]
        assert sizes[k] == ((m, n // 2) if k % 2 else (m // 2, n))


@pytest.mark.parametrize("options", MAPS, ids=str)
def test_every_slot_has_its_own_atlas_pixel(options):
    pixels, (height, width) = atlas_pixels(all_slots(options), options=options), atlas_size(options)
    assert pixels.min() >= 0
    assert (pixels < [height, width]).all()
    assert np.bincount(pixels[:, 0] * width + pixels[:, 1]).max() == 1


def test_the_atlas_is_used_to_99_6_percent():
    height, width = atlas_size(UvOptions())
    assert (height, width) == (1024, 2048)
    assert sum(m * n for m, n in UvOptions().sizes) / (height * width) >= 0.996


def test_odd_layers_of_a_square_map_are_turned_counter_clockwise():
    options = UvOptions(rows=16, columns=16, layers=3)
    first, second, third = atlas_layout(options)
    assert (first.rotated, second.rotated, third.rotated) == (False, True, False)
    corner = Slots(np.array([1, 1, 1], np.int8), np.array([0, 1, 0]), np.array([0, 0, 1]))
    # The top left corner goes to the bottom left, rows run to the right, columns run up.
    assert atlas_pixels(corner, options=options).tolist() == [[7, 0], [7, 1], [6, 0]]


def test_pruned_gaussians_have_no_pixel():
    pruned = Slots(np.array([-1], np.int8), np.array([-1]), np.array([-1]))
    assert atlas_pixels(pruned, options=SMALL).tolist() == [[-1, -1]]


def naive_cascade(texels, opacity, options):
    taken, result = {}, np.full((len(texels), 3), -1)
    for i in sorted(range(len(texels)), key=lambda i: (-opacity[i], i)):
        for k, (rows, columns) in enumerate(options.sizes):
            slot = k, texels[i, 0] * rows // options.rows, texels[i, 1] * columns // options.columns
            if slot not in taken:
                taken[slot] = i
                result[i] = slot
                break
    return result


@settings(max_examples=60)
@given(st.integers(0, 400), st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_the_cascade_equals_its_naive_twin(count, seed, levels):
    rng = np.random.default_rng(seed)
    points, opacity = rng.normal(size=(count, 3)), rng.integers(0, levels, count)  # few levels: many ties
    slots = assign_slots(points, opacity, ORIGIN, options=SMALL)
    expected = naive_cascade(sphere_texels(points, ORIGIN, options=SMALL), opacity, SMALL)
    assert np.array_equal(np.stack([slots.layer, slots.row, slots.column], axis=1), expected)


def test_one_texel_keeps_its_k_most_opaque():
    points = np.tile([0.3, 0.4, 0.5], (20, 1))
    opacity = np.random.default_rng(3).permutation(20)
    slots = assign_slots(points, opacity, ORIGIN, options=SMALL)
    assert sorted(opacity[slots.kept]) == [16, 17, 18, 19]
    assert np.array_equal(np.argsort(slots.layer[slots.kept]), np.argsort(-opacity[slots.kept]))


@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6) | st.sampled_from([0.0, -0.0, 1e-300])] * 3), min_size=1, max_size=50))
def test_no_point_leaves_the_map(points):
    texels = sphere_texels(np.array(points), ORIGIN, options=SMALL)
    assert texels.min() >= 0
    assert texels.max() < 8


def test_azimuth_wraps_and_polar_angle_clamps():
    seam = np.array([[-1.0, 0.0, 0.0], [-1.0, -1e-18, 0.0], [-1.0, -1e-3, 0.0], [-1.0, 1e-3, 0.0]])
    assert sphere_texels(seam, ORIGIN, options=SMALL)[:, 0].tolist() == [0, 0, 0, 7]
    poles = np.array([[0.0, 0, 1], [0, 0, -1], [0, 0, 0]])
    assert sphere_texels(poles, ORIGIN, options=SMALL)[:, 1].tolist() == [0, 7, 0]


def test_the_centre_that_keeps_most_opacity_is_chosen():
    rng = np.random.default_rng(0)
    room = rng.normal(size=(4000, 3))
    room = 5 * room / np.linalg.norm(room, axis=1, keepdims=True)
    far_away = rng.normal([400.0, 0, 0], 1, (400, 3))
    points, alpha = np.concatenate([room, far_away]), np.ones(4400)
    cameras = rng.normal(0, 0.3, (8, 3))
    options = UvOptions(rows=64, columns=64, layers=4)

    def kept(centre):
        return assign_slots(points, alpha, centre, options=options).kept.sum()

    chosen = choose_centre(points, alpha, cameras, options=options)
    assert kept(chosen) == max(kept(cameras.mean(axis=0)), kept(points.mean(axis=0)), kept(chosen))
    assert np.linalg.norm(chosen) < 6  # inside the room, not dragged towards the far points
    assert kept(chosen) > kept(points.mean(axis=0))


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="finite"):
        assign_slots(np.full((1, 3), np.nan), np.ones(1), ORIGIN, options=SMALL)
    with pytest.raises(ValueError, match="as many opacities"):
        assign_slots(np.ones((2, 3)), np.ones(3), ORIGIN, options=SMALL)
    with pytest.raises(ValueError, match="multiples"):
        UvOptions(rows=12, columns=12, layers=8)
    with pytest.raises(ValueError, match="at least one"):
        UvOptions(layers=0)
    with pytest.raises(ValueError, match="no centre"):
        choose_centre(np.empty((0, 3)), np.empty(0), options=SMALL)
