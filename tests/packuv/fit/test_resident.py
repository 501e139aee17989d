"""Fits that stay on the GPU, or in numba's simulator, against the CPU's: see `tests/packuv/raster/test_cuda.py`."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
import torch

from packuv.camera import PinholeCamera
from packuv.fit import frames as frames_module
from packuv.fit import resident, terms, terms_cuda
from packuv.fit.backdrop import Backdrop
from packuv.fit.density import DensityOptions
from packuv.fit.depth import SparseDepth
from packuv.fit.frames import fit_segment
from packuv.fit.keyframe import KeyState, choose_quantizer
from packuv.fit.lift import LiftOptions
from packuv.fit.model import Model
from packuv.fit.options import FitOptions, FrameOptions
from packuv.fit.resident import ResidentSolver
from packuv.fit.shots import Shot
from packuv.fit.shots_cuda import ShotOnGpu
from packuv.fit.solver import Solver
from packuv.fit.solvers import open_solver
from packuv.fit.start.bounds import Bounds
from packuv.footage import LensCamera, Response, Views
from packuv.gaussians.codes import Codes
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, arrays
from packuv.gaussians.segment import Segment
from packuv.raster import render
from packuv.raster.cuda.launch import send
from tests.support.dense_raster import OPTIONS, camera, scene
from tests.support.needs import needs

SIMULATED = bool(numba.config.ENABLE_CUDASIM)
pytestmark = needs("cuda", SIMULATED or torch.cuda.is_available(), "no CUDA device")

BOUNDS = Bounds(np.zeros(3), 2.0, OPTIONS.near)
RESPONSE = Response((1.1, 0.9, 1.0), (-0.2, 0.1), (8.0, 7.0, 0.07, 0.06))
TOLERANCE = 1e-4
"""Of losses, relative, and of masters beside the largest, after up to six steps"""
SHARE = 1.0 if SIMULATED else 0.95
"""Of the values that must be so near: Adam makes whole steps of gradients that are rounding alone, which a GPU rounds
otherwise than the CPU; the others stay within a tenth"""


def view(name: str, width: int = 16, height: int = 16) -> PinholeCamera:
    return replace(camera(width, height), name=name)


def shots(*, shift: float = 0.1) -> list[Shot]:
    """What two cameras film: one in bytes, through a response, before black and with known depths; the other in floats,
    of which some are unknown."""
    truth = scene(10, degree=0, seed=4)
    truth.means[:, 0] += shift
    filmed = [render(truth, view(name), options=OPTIONS).colour.clip(0, 1) for name in ("a", "b")]
    in_bytes = np.rint(255 * RESPONSE.shown(filmed[0])).astype(np.uint8).astype(np.float32) / np.float32(255)
    known = np.ones((16, 16), bool)
    known[3:6, 2:9] = False
    depths = SparseDepth(np.array([5, 100, 136, 137, 137]), np.array([3.0, 4.0, 4.1, 4.2, 4.3], np.float32))
    return [
        Shot(view("a"), in_bytes, RESPONSE, depths=depths),
        Shot(view("b"), filmed[1], tiles=np.ones((1, 1), bool), known=known),
    ]


def solver(device: str, still: Gaussians | None = None, **changes: Any) -> Solver:
    options = FitOptions(device=device, **changes)
    backdrop = None if still is None else Backdrop(still, OPTIONS.near, device)
    return open_solver(Model(scene(10, degree=0)), BOUNDS, options, np.random.default_rng(0), backdrop)


def assert_alike(here: Solver, there: Solver) -> None:
    """The same rows, with nearly the same masters and codes within a step."""
    assert len(here.model) == len(there.model)
    assert np.array_equal(here.rows, there.rows)
    assert here.done == there.done
    for name in ATTRIBUTES:
        truth, found = (getattr(tried.model.gaussians, name) for tried in (here, there))
        difference, largest = np.abs(found - truth), max(1.0, np.abs(truth).max())
        assert (difference <= TOLERANCE * largest).mean() >= SHARE, name
        assert difference.max() <= 0.1 * largest, name
        assert np.array_equal(here.model.moments[name].steps, there.model.moments[name].steps)
    assert np.array_equal(here.gradient.seen, there.gradient.seen)
    assert there.gradient.total == pytest.approx(here.gradient.total, rel=1e-3, abs=1e-9)


def codes(tried: Solver) -> Codes:
    return tried.known_quantizer.encode(tried.model.gaussians)


def test_the_device_decides_who_iterates():
    assert type(solver("cpu")) is Solver
    assert isinstance(solver("cuda"), ResidentSolver)


@pytest.fixture
def ways(monkeypatch):
    """Each time that a model goes to the GPU or comes back."""
    found = []

    class Counted(resident.RowsOnGpu):
        def __init__(self, *given: Any) -> None:
            found.append("there")
            super().__init__(*given)

        def bring_home(self, model: Model) -> int:
            found.append("back")
            return super().bring_home(model)

    monkeypatch.setattr(resident, "RowsOnGpu", Counted)
    return found


def test_a_keyframe_grows_and_is_pruned_as_on_the_cpu(ways):
    """Before colours at random, with the near plane jittered; then quantized. Two of ten are too faint to stay. The
    model goes to the GPU and comes back once in each of the three runs, not where it grows."""
    changes = {
        "density": DensityOptions(cap=16, every=2, min_opacity=0.3, large=0.05),
        "opacity_weight": 0.01,
        "scale_weight": 0.01,
        "scale_limit": 0.02,
        "near_reach": 1.6,
    }
    found = []
    for device in ("cpu", "cuda"):
        tried, counts, losses = solver(device, **changes), [], []
        for _ in range(2):
            losses.append(tried.run(shots(), 2, of=8, grow_from=10))
            counts.append((len(tried.model), int((tried.model.moments["means"].steps > 0).sum())))
        tried.fix(choose_quantizer(tried.model.gaussians, BOUNDS, 0))
        losses.append(tried.run(shots(), 2, of=8))
        found.append((tried, counts, losses))
    (here, counts, losses), (there, counts_there, losses_there) = found
    assert counts == counts_there == [(12, 8), (15, 12)]  # rows, and those of them that are not new
    assert losses[0].keys() == {"photometric", "depth", "opacity", "scale"}
    for truth, got in zip(losses, losses_there, strict=True):
        assert got == pytest.approx(dict(truth), rel=TOLERANCE, abs=1e-7)
    assert_alike(here, there)
    assert ways == 3 * ["there", "back"]


def test_who_is_supported_is_the_cpus():
    found = []
    for device in ("cpu", "cuda"):
        tried = solver(device, density=DensityOptions(cap=16))
        tried.model.gaussians.means[3] -= 50 * view("a").camera_from_world[2, :3].astype(np.float32)  # behind cameras
        found.append(tried.supported(shots()))
    assert np.array_equal(*found)
    assert found[0][3]
    assert 0 < found[0].sum() < 10


def frame(device: str, quantizer: Any, rows: np.ndarray) -> tuple[Solver, Any, Codes]:
    """A frame over a backdrop, of which some rows may change, one of them empty."""
    tried = solver(device, still=scene(6, degree=0, seed=9), near_jitter=0.0, random_background=False)
    tried.model.gaussians.opacity_logits[4] = -5.6
    tried.fix(quantizer)
    before = codes(tried)
    tried.free(rows)
    options = replace(tried._options, frame_iterations=3)
    return tried, tried.settle(shots(), options, usual=np.inf), before


def test_a_frame_over_a_backdrop_is_the_cpus_and_frozen_rows_keep_every_code(ways):
    rows, quantizer = np.arange(10) % 2 == 0, choose_quantizer(scene(10, degree=0), BOUNDS, 0)
    (here, settled, before), (there, settled_there, _) = (frame(device, quantizer, rows) for device in ("cpu", "cuda"))
    assert settled_there[1] == settled[1]
    assert ways == ["there", "back"]
    assert settled_there[0] == pytest.approx(dict(settled[0]), rel=TOLERANCE)
    assert_alike(here, there)
    after, found = codes(here), codes(there)
    for name in ("xyz", "attributes"):
        assert (np.abs(getattr(found, name).astype(int) - getattr(after, name)) <= 1).mean() >= SHARE
        assert np.array_equal(getattr(found, name)[~rows], getattr(before, name)[~rows])
        assert not np.array_equal(getattr(found, name)[rows], getattr(before, name)[rows])
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(there.model.gaussians, name)[~rows], getattr(here.model.gaussians, name)[~rows])


def test_a_branch_goes_on_by_itself():
    tried = solver("cuda")
    tried.run(shots(), 1, of=10)
    before = [array.copy() for array in arrays(tried.model.gaussians)]
    twin = tried.branch()
    twin.run(shots(), 1, of=10)
    assert all(np.array_equal(a, b) for a, b in zip(arrays(tried.model.gaussians), before, strict=True))
    assert not np.array_equal(twin.model.gaussians.means, tried.model.gaussians.means)
    assert (tried.done, twin.done) == (1, 2)


def test_what_was_drawn_otherwise_than_it_is_stored_stops_the_fit(monkeypatch):
    """As if a card decoded another value than the CPU."""

    class Erring(resident.RowsOnGpu):
        def step(self, *given: Any) -> None:
            super().step(*given)
            self.drawn[1][3, 2] += 1e-6

    monkeypatch.setattr(resident, "RowsOnGpu", Erring)
    tried = solver("cuda")
    tried.fix(choose_quantizer(tried.model.gaussians, BOUNDS, 0))
    with pytest.raises(RuntimeError, match=r"log_scales of 1 of 10 Gaussians were drawn otherwise .*--device cpu"):
        tried.run(shots(), 1, of=10)


def test_a_broken_gaussian_goes_back_and_is_counted(monkeypatch, caplog):
    def erring(rendering: Any, *given: Any) -> Any:
        gradients, overflown = carry(rendering, *given)
        gradients[1][int(rendering.visible.argmax())] = np.nan
        return gradients, overflown

    carry = resident.carry
    monkeypatch.setattr(resident, "carry", erring)
    tried = solver("cuda")
    first = [array.copy() for array in arrays(tried.model.gaussians)]
    with caplog.at_level(logging.WARNING):
        tried.run(shots(), 1, of=10)
    assert tried.guarded == 1
    assert "iteration 0, the gradient of log_scales of Gaussian" in caplog.text
    same = zip(arrays(tried.model.gaussians), first, strict=True)
    unmoved = np.logical_and.reduce([(now == was).reshape(10, -1).all(axis=1) for now, was in same])
    row = int(caplog.text.split("of Gaussian ")[1].split()[0])
    assert unmoved[row]
    assert not unmoved.all()


def test_a_loss_that_is_not_finite_stops_the_fit():
    broken = [replace(shot, source=np.full((3, 16, 16), np.nan, np.float32)) for shot in shots()]
    with pytest.raises(ValueError, match=r"the photometric loss of camera '[ab]' is nan"):
        solver("cuda").run(broken, 1, of=10)


def test_what_was_filmed_takes_a_byte_a_value_and_is_the_same_to_the_bit():
    pixels = np.random.default_rng(0).permutation(np.arange(768) % 256).astype(np.uint8).reshape(16, 16, 3)
    pixels.setflags(write=False)  # as views give them
    here = Shot(view("a"), lambda: pixels)
    for shot in (here, replace(here, sent=send(pixels))):
        held = ShotOnGpu(shot)
        assert held._source.dtype == torch.uint8
        assert held.target.is_contiguous()
        assert np.array_equal(held.target.cpu().numpy(), here.target)
        assert held.void_share == here.void.mean()
    floats = here.target + np.float32(1e-6)
    assert np.array_equal(ShotOnGpu(Shot(view("a"), floats)).target.cpu().numpy(), floats)


def test_a_picture_that_has_been_sent_is_not_read_again():
    def read() -> np.ndarray:
        raise ValueError("it is damaged")

    pixels = np.full((16, 16, 3), 7, np.uint8)
    assert np.all(ShotOnGpu(Shot(view("a"), read, sent=send(pixels))).target.cpu().numpy() == np.float32(7) / 255)
    with pytest.raises(ValueError, match=r"^it is damaged$"):
        solver("cuda").run([Shot(view("a"), read)], 1, of=10)


class Filmed:
    """In place of a `FrameReader`, so that this needs no decoder."""

    def __init__(self, pictures: dict[str, list[np.ndarray]]) -> None:
        self.pictures = pictures

    def read(self, name: str, frame: int) -> np.ndarray:
        return self.pictures[name][frame]


class Everywhere:
    """In place of a `MotionCache`: all moves, but in camera "b" at the second instant nothing does."""

    names = ("a", "b")

    def mask(self, camera: int, instant: int) -> np.ndarray:
        return np.full((16, 16), (camera, instant) != (1, 2))


def test_a_segment_is_the_same_with_pictures_prepared_ahead(tmp_path, monkeypatch):
    """To the byte, for every sum has a fixed order."""
    still, rng = scene(10, degree=0), np.random.default_rng(3)
    pictures = {name: list(rng.integers(0, 256, (3, 16, 16, 3), dtype=np.uint8)) for name in ("a", "b")}
    lenses, frames = [LensCamera(view(name)) for name in pictures], np.arange(3).repeat(2).reshape(3, 2)
    views = Views(dict.fromkeys(pictures, tmp_path), frames, lenses, reader=Filmed(pictures))
    key = KeyState(0, still, 0, choose_quantizer(still, BOUNDS, 0), BOUNDS, {"loss": 1.0})
    options = FitOptions(device="cuda", frame_iterations=1, spare=1, lift=LiftOptions(enabled=False))
    sent = list[int]()

    def counted(array: np.ndarray) -> Any:
        sent.append(array.nbytes)
        return send(array)

    def fitted(name: str) -> Segment:
        (tmp_path / name).mkdir()
        given: Any = {"motion": Everywhere(), "options": options.part(FrameOptions), "scratch": tmp_path / name}
        return fit_segment(key, views, range(3), **given)[0]

    monkeypatch.setattr(frames_module, "_sender", lambda device: counted)
    ahead = fitted("ahead")
    assert sent == 3 * [16 * 16 * 3]
    monkeypatch.setattr(frames_module, "_sender", lambda device: None)
    plain = fitted("plain")
    for name in ("xyz", "attributes"):
        assert np.array_equal(getattr(ahead, name), getattr(plain, name))
        assert np.array_equal(getattr(ahead.key, name), getattr(plain.key, name))
    assert len(plain.xyz) == 2
    assert not np.array_equal(plain.attributes[0], plain.attributes[1])


def test_responses_are_the_cpus():
    rng = np.random.default_rng(0)
    picture = rng.normal(0.5, 0.5, (3, 16, 16)).astype(np.float32)
    held = ShotOnGpu(Shot(view("a"), picture, RESPONSE))
    on_gpu = torch.tensor(picture, device=held.target.device)
    assert held.shown(on_gpu).cpu().numpy() == pytest.approx(RESPONSE.shown(picture), abs=1e-6)
    assert held.carried(on_gpu).cpu().numpy() == pytest.approx(RESPONSE.carried(picture), abs=1e-6)


@pytest.mark.parametrize("bare", [False, True], ids=["a room", "a bare stage"])
def test_what_is_to_be_explained_before_a_colour_is_the_cpus(bare):
    picture = np.random.default_rng(2).random((3, 16, 16)).astype(np.float32)
    picture[:, 4:9] = 0.05
    shot = Shot(view("a"), picture, RESPONSE)
    here, there = solver("cpu"), solver("cuda")
    wanted, behind = here._before_colour(shot, bare)
    held = there._on_gpu(shot)
    target, colour = there._target_before_colour(held, held.target, bare)
    assert target.cpu().numpy() == pytest.approx(wanted.target, abs=1e-6)
    assert colour.cpu().numpy() == pytest.approx(behind, abs=1e-6)
    assert there._void_share(shot) == here._void_share(shot) == 5 / 16


def test_both_devices_have_the_same_terms():
    assert terms_cuda.TERMS.keys() == terms.TERMS.keys()
