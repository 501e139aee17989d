"""The terms of the loss: each derivative against a difference quotient, and the sum by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from packuv.fit.depth import SparseDepth
from packuv.fit.options import FitOptions, LossOptions
from packuv.fit.shots import Shot
from packuv.fit.terms import TERMS, Pull, Seen, pulls, summed
from packuv.gaussians.floats import ATTRIBUTES
from packuv.raster import render
from tests.support.dense_raster import OPTIONS, camera, scene

WEIGHTS = LossOptions(depth_weight=0.3, opacity_weight=0.2, scale_weight=50.0, scale_limit=0.01)
STEP = {"opacity": ("opacity_logits", 1e-2), "scale": ("log_scales", 1e-3)}


@pytest.fixture
def seen() -> Seen:
    gaussians, view = scene(40, degree=0), camera()
    rendering = render(gaussians, view, options=OPTIONS)
    covered = np.flatnonzero(rendering.alpha.ravel() > 0.6)
    assert len(covered) > 20
    known = SparseDepth(covered, rendering.depth.ravel()[covered] / rendering.alpha.ravel()[covered] + np.float32(0.2))
    target = np.full_like(rendering.colour, 0.5)
    rows = np.arange(40) % 4 != 0
    return Seen(rendering, rendering.colour, target, Shot(view, target, depths=known), gaussians, rows, 2.0)


def found(name: str, seen: Seen, options: LossOptions = WEIGHTS) -> Pull:
    pull = TERMS[name](seen, options)
    assert pull is not None
    return pull


@pytest.mark.parametrize("name", ["opacity", "scale"])
def test_derivatives_by_the_gaussians(seen: Seen, name: str) -> None:
    attribute, step = STEP[name]
    gradient = found(name, seen).gaussians[attribute].astype(np.float64)
    direction = np.random.default_rng(0).standard_normal(gradient.shape)

    def value(sign: int) -> float:
        moved = (getattr(seen.gaussians, attribute) + sign * step * direction).astype(np.float32)
        return found(name, replace(seen, gaussians=replace(seen.gaussians, **{attribute: moved}))).value

    assert (value(1) - value(-1)) / (2 * step) == pytest.approx((gradient * direction).sum(), rel=0.02)
    assert not gradient[~seen.rows].any()


@pytest.mark.parametrize("name", ["depth", "alpha"])
def test_derivatives_of_the_depth_term(seen: Seen, name: str) -> None:
    gradient = getattr(found("depth", seen), name)
    direction = np.random.default_rng(1).standard_normal(gradient.shape).astype(np.float32) * (gradient != 0)

    def value(sign: int) -> float:
        moved: Any = _Drawn(seen.rendering, **{name: getattr(seen.rendering, name) + sign * 1e-3 * direction})
        return found("depth", replace(seen, rendering=moved)).value

    assert (value(1) - value(-1)) / 2e-3 == pytest.approx(float((gradient * direction).sum()), rel=0.02)


class _Drawn:
    """A rendering, some pictures of which are others."""

    def __init__(self, rendering: Any, **changes: np.ndarray) -> None:
        self.depth, self.alpha = rendering.depth, rendering.alpha
        vars(self).update(changes)


def test_a_term_without_weight_does_not_apply(seen: Seen) -> None:
    none = LossOptions(depth_weight=0.0)
    assert list(pulls(seen, none)) == ["photometric"]
    assert list(pulls(seen, WEIGHTS)) == ["photometric", "depth", "opacity", "scale"]
    assert list(pulls(replace(seen, shot=replace(seen.shot, depths=None)), FitOptions())) == ["photometric"]


def test_weights_scale_values_and_pulls(seen: Seen) -> None:
    once, twice = found("scale", seen), found("scale", seen, replace(WEIGHTS, scale_weight=100.0))
    assert twice.value == pytest.approx(2 * once.value)
    assert np.allclose(twice.gaussians["log_scales"], 2 * once.gaussians["log_scales"])
    assert set(once.gaussians) <= set(ATTRIBUTES)


def test_what_is_not_there_adds_nothing() -> None:
    assert summed([None, None]) is None
    assert np.array_equal(summed([np.ones(2), None, np.ones(2)]), np.full(2, 2.0))
