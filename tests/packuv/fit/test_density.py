import numpy as np
import pytest

from packuv.fit.density import DensityOptions, ScreenGradient, divide, draw, grow, prune, relocate
from packuv.fit.model import Model
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.first import round_gaussians
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, opacity
from packuv.gaussians.uvsize import UvOptions

NOTHING = np.empty((0, 3), np.float32)
BOUNDS = Bounds(np.zeros(3), 2.0, 0.2)
UV = UvOptions(rows=64, columns=64, layers=4)


def model(count: int = 400, seed: int = 0, scale: float = 0.05) -> Model:
    rng = np.random.default_rng(seed)
    return Model(round_gaussians(rng.normal(size=(count, 3)), rng.random((count, 3)), np.full(count, scale),
                                 opacity=0.5, sh_degree=0))  # fmt: skip


def test_draw_gives_different_rows_in_proportion_to_their_score():
    score = np.repeat([0.0, 1.0, 9.0], 1000)
    rows = draw(score, 300, np.random.default_rng(0))
    assert len(set(rows.tolist())) == 300
    assert (rows >= 1000).all()
    # 9 of 10 expected; drawing without putting back lowers it a little.
    assert 0.8 < (rows >= 2000).mean() < 0.93
    assert len(draw(score, 10**6, np.random.default_rng(0))) == 2000


def test_growth_adds_as_many_as_asked_and_large_parents_shrink():
    m = model()
    score = np.ones(len(m))
    score[100:] = 0
    before = m.gaussians.log_scales.copy()
    parents = grow(m, score, 50, bounds=BOUNDS, options=DensityOptions(), rng=np.random.default_rng(1))
    assert len(parents) == 50
    assert len(m) == 450
    assert (parents < 100).all()
    np.testing.assert_allclose(m.gaussians.log_scales[parents], before[parents] - np.log(1.6), rtol=1e-5)


def test_small_parents_share_their_opacity_so_that_light_is_kept():
    m = model(scale=0.001)
    parents = np.arange(10)
    before = opacity(m.gaussians)[parents]
    child = divide(m, parents, bounds=BOUNDS, options=DensityOptions(), rng=np.random.default_rng(2))
    together = 1 - (1 - opacity(child)) * (1 - opacity(m.gaussians)[parents])
    np.testing.assert_allclose(together, before, rtol=1e-5)


def test_pruning_takes_the_faint_the_huge_the_lost_and_what_the_map_has_no_room_for():
    m = model()
    m.gaussians.opacity_logits[0] = -9
    m.gaussians.log_scales[1] = 3
    m.gaussians.means[2] = np.nan
    m.gaussians.means[10:60] = [1.0, 0.5, 0.2]  # one texel, four layers
    m.gaussians.opacity_logits[10:14] = 2.0
    keep = prune(m, ScreenGradient(len(m)), NOTHING, bounds=BOUNDS, options=DensityOptions(), uv=UV)
    assert not keep[:3].any()
    assert keep[10:60].sum() <= UV.layers
    assert keep[10:14].sum() >= keep[14:60].sum()


def test_pruning_by_gradient_takes_what_contributes_less_than_the_threshold():
    m = model(5)
    gradient = ScreenGradient(5)
    gradient.add(np.array([[1e-6, 0], [1e-2, 0], [0, 1e-6], [0, 1e-2], [0, 0]]), np.array([1, 1, 1, 1, 0]), 100, 100)
    options = DensityOptions(min_gradient=1e-3)
    keep = prune(m, gradient, NOTHING, bounds=BOUNDS, options=options, uv=UvOptions())
    assert keep.tolist() == [False, True, False, True, True]  # the last one was never drawn


def test_relocation_moves_dead_rows_beside_living_ones_and_touches_no_row_outside():
    m = model(100)
    m.gaussians.opacity_logits[:20] = -9
    rows = np.arange(100) < 60
    before = Gaussians(*(getattr(m.gaussians, name).copy() for name in ATTRIBUTES))
    moved = relocate(m, np.ones(100), rows, bounds=BOUNDS, options=DensityOptions(), share=0.25,
                     rng=np.random.default_rng(3))  # fmt: skip
    assert moved == 10  # a quarter of the 40 that live
    assert len(m) == 100
    assert (opacity(m.gaussians)[:10] > 0.3).all()
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(m.gaussians, name)[60:], getattr(before, name)[60:])


def test_screen_gradient_means_run_over_the_pictures_that_drew_the_gaussian():
    gradient = ScreenGradient(2)
    gradient.add(np.array([[3e-2, 4e-2], [1, 1]]), np.array([2, 0]), 200, 200)
    gradient.add(np.array([[0, 0], [0, 0]]), np.array([1, 0]), 200, 200)
    assert gradient.mean[0] == pytest.approx(2.5)
