import numpy as np

from packuv.fit.model import Model, Rates
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, rotation_matrices, rows_of, with_canonical_axes


def some(count: int, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    f = np.float32
    return Gaussians(
        rng.normal(size=(count, 3)).astype(f),
        rng.normal(-3, 1, (count, 3)).astype(f),
        rng.normal(size=(count, 4)).astype(f),
        rng.normal(size=count).astype(f),
        rng.normal(size=(count, (sh_degree + 1) ** 2, 3)).astype(f),
    )


def covariance(g: Gaussians) -> np.ndarray:
    axes = rotation_matrices(g.quaternions.astype(np.float64)) * np.exp(g.log_scales.astype(np.float64))[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def snapshot(model: Model) -> dict[str, np.ndarray]:
    return {name: getattr(model.gaussians, name).copy() for name in ATTRIBUTES}


def test_canonical_frame_is_the_same_ellipsoid_with_large_w_and_sorted_axes():
    g = some(2000)
    c = with_canonical_axes(g)
    np.testing.assert_allclose(covariance(c), covariance(g), rtol=2e-4, atol=1e-7)  # float32 quaternions
    assert (c.quaternions[:, 0] >= 0.5 - 1e-6).all()
    assert (np.diff(c.log_scales, axis=1) <= 0).all()


def test_canonical_of_canonical_changes_nothing_but_rounding():
    c = with_canonical_axes(some(500))
    np.testing.assert_allclose(with_canonical_axes(c).quaternions, c.quaternions, atol=1e-6)


def test_a_step_moves_the_chosen_rows_and_no_bit_of_the_others():
    model = Model(some(50))
    rows = np.arange(50) % 3 == 0
    before = snapshot(model)
    gradient = {name: np.ones_like(getattr(model.gaussians, name)) for name in ATTRIBUTES}
    for _ in range(3):
        model.step(gradient, Rates(), radius=2.0, progress=0.5, rows=rows)
    for name in ATTRIBUTES:
        after = getattr(model.gaussians, name)
        assert np.array_equal(after[~rows], before[name][~rows])
        assert (after[rows] != before[name][rows]).all()
        assert not model.moments[name].first[~rows].any()
        assert not model.moments[name].steps[~rows].any()


def test_keep_append_overwrite_keep_moments_beside_their_rows():
    model = Model(some(10))
    gradient = {name: np.ones_like(getattr(model.gaussians, name)) for name in ATTRIBUTES}
    model.step(gradient, Rates(), radius=1.0, progress=0.0, rows=np.arange(10) >= 5)
    model.keep(np.arange(10) % 2 == 1)
    model.append(some(3, seed=1))
    assert len(model) == 8
    assert model.moments["means"].steps.tolist() == [0, 0, 1, 1, 1, 0, 0, 0]
    model.overwrite(np.array([3]), rows_of(some(3, seed=1), slice(0, 1)))
    assert model.moments["means"].steps.tolist() == [0, 0, 1, 0, 1, 0, 0, 0]
    assert np.array_equal(model.gaussians.means[3], model.gaussians.means[5])


def test_the_rate_of_the_means_falls_to_its_end_and_scales_with_the_scene():
    rates = Rates(means=1e-3, means_end=0.1)
    start = rates.columns("means", 3, radius=2.0, progress=0.0)
    end = rates.columns("means", 3, radius=2.0, progress=1.0)
    np.testing.assert_allclose(start, 2e-3)
    np.testing.assert_allclose(end, 2e-4)
    assert rates.columns("sh", 12, radius=1.0, progress=0.0)[:3].tolist() == [rates.sh_base] * 3
