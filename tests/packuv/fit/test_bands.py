"""View dependence is carried where cameras that were left out see it, and nowhere else."""

import dataclasses
from pathlib import Path

import av
import numpy as np
import pytest

from packuv.fit import bands
from packuv.fit.density import DensityOptions
from packuv.fit.frames import fit_segment
from packuv.fit.keyframe import KeyState, choose_quantizer, fit_first, fit_next
from packuv.fit.model import Model, Rates
from packuv.fit.options import FitOptions
from packuv.fit.shots import find_shots
from packuv.fit.solver import Solver
from packuv.fit.start.bounds import find_bounds
from packuv.fit.start.first import StartOptions, round_gaussians
from packuv.footage import LensCamera, Views
from packuv.gaussians.floats import Gaussians, rows_of
from packuv.motion import MotionCache, MotionOptions, find_background, measure_motion
from packuv.raster import RasterOptions, render

CAMERAS, FRAMES = 12, 4
OPTIONS = FitOptions(
    sh_degree=1, iterations=300, key_iterations=60, frame_iterations=24, spare=20, key_births=40, near_jitter=0.0,
    random_background=False, start=StartOptions(count=500), density=DensityOptions(cap=900, every=25),
    rates=Rates(sh_rest=5e-3),  # so that a short fit may find bands at all
)  # fmt: skip
MOTION = MotionOptions(width=96, flow_width=96, least_area_px=4, closing_px=1, dilation_px=1)
SHINE = 0.3
"""Of each band of the shiny scene: colours that change by half from one side to the other"""
SHINY_GAIN, SHINY_GAIN_DB, MATTE_GAIN = 0.1, 1.0, 0.02
"""What bands save of the loss at least, measured 0.78, and their dB, measured 11.2; at most without shine, measured
-0.55"""


def cloud(instant: int, shine: float) -> Gaussians:
    """250 still Gaussians, shiny or not, and a matte ball that travels."""
    rng = np.random.default_rng(5)
    xyz, rgb, scale = rng.uniform(-1, 1, (250, 3)) * [1, 1, 0.3], rng.random((250, 3)), rng.uniform(0.05, 0.2, 250)
    xyz = np.vstack([xyz, [[-0.6 + 0.3 * instant, 0.0, 0.75]]])
    made = round_gaussians(xyz, np.vstack([rgb, [[1, 0.1, 0.1]]]), np.append(scale, 0.2), opacity=0.9, sh_degree=1)
    made.sh[:-1, 1:] = shine * np.sign(xyz[:-1, :1, None])
    return made


def film(folder: Path, cameras, shine: float) -> Views:
    for camera in cameras:
        with av.open(str(folder / f"{camera.name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "bgr0"
            for instant in range(FRAMES):
                picture = render(cloud(instant, shine), camera, options=RasterOptions(0.1)).colour
                pixels = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8).transpose(1, 2, 0)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")))
            container.mux(stream.encode())
    videos = {camera.name: folder / f"{camera.name}.mkv" for camera in cameras}
    frames = np.tile(np.arange(FRAMES)[:, None], (1, len(cameras)))
    return Views(videos, frames, [LensCamera(camera) for camera in cameras])


@pytest.fixture(scope="module")
def shiny(ring, tmp_path_factory) -> Views:
    return film(tmp_path_factory.mktemp("shiny"), ring(CAMERAS), SHINE)


@pytest.fixture(scope="module")
def matte(ring, tmp_path_factory) -> Views:
    return film(tmp_path_factory.mktemp("matte"), ring(CAMERAS), 0.0)


def judged(views: Views) -> tuple[bands.Judgement, Solver]:
    """What bands are worth to Gaussians that stand in their places, and learn colours from ten cameras, then bands."""
    bounds = find_bounds(views.cameras, near_share=OPTIONS.near_share)
    matt = cloud(0, 0.0)
    model = Model(dataclasses.replace(matt, sh=matt.sh[:, :1]))
    solver = Solver(model, bounds, OPTIONS, np.random.default_rng(0))
    shots, judges = find_shots(views, 0), bands.left_out(views.cameras)
    solver.run([shot for index, shot in enumerate(shots) if index not in judges], 200, of=300)
    found, best = bands.judge(
        solver, shots, judges, (0, 1), Solver.give_bands, share=0.1, of=300, gain=OPTIONS.sh_gain,
        options=OPTIONS.photometric,
    )  # fmt: skip
    assert found.cameras == tuple(views.names[index] for index in judges)
    assert (solver.done, best.done) == (200, 230)
    return found, best


def test_bands_of_a_shiny_scene_are_carried(shiny):
    found, best = judged(shiny)
    assert found.degree == 1
    assert best.model.gaussians.sh.shape[1] == 4
    assert found.gain > SHINY_GAIN
    assert found.gain_db > SHINY_GAIN_DB


def test_bands_of_a_matte_scene_are_not_carried(matte):
    found, best = judged(matte)
    assert found.degree == 0
    assert best.model.gaussians.sh.shape[1] == 1
    assert found.gain < MATTE_GAIN
    text = bands.told(found.to_json())
    assert "degree 0 of 1 is carried" in text
    assert all(name in text for name in found.cameras)


def test_a_first_fit_tells_on_what_evidence_it_chose(matte):
    fitted = fit_first(matte, 0, points=None, options=dataclasses.replace(OPTIONS, iterations=60))
    found = fitted.figures["sh"]
    assert len(found["left_out"]) == 2
    assert fitted.gaussians.sh.shape[1] == (found["degree"] + 1) ** 2 == (fitted.quantizer.sh_degree + 1) ** 2


def test_what_moves_before_a_shiny_backdrop_may_be_matte(shiny, tmp_path):
    stills, motion = find_background(shiny, OPTIONS.background), tmp_path / "motion"
    bounds = find_bounds(shiny.cameras, near_share=OPTIONS.near_share)
    still = rows_of(cloud(0, SHINE), slice(0, 250))
    backdrop = KeyState(None, still, 250, choose_quantizer(cloud(0, SHINE), bounds, 1), bounds, {})
    key = fit_next(backdrop, shiny, 0, stills=stills, motion=MOTION, options=OPTIONS)
    assert key.figures["sh"]["degree"] == 0
    assert key.still_bands
    assert len(key.foreground)
    assert not key.foreground.sh[:, 1:].any()
    measure_motion(shiny, motion, options=MOTION)
    segment, _ = fit_segment(key, shiny, range(FRAMES), motion=MotionCache.load(motion), options=OPTIONS,
                             scratch=tmp_path)  # fmt: skip
    assert segment.dynamic.any()
    own = segment.attributes[..., 10:]
    assert (own == own[:1, :1, :1]).all()  # constant columns, which cost nothing in the file


def test_with_few_cameras_no_band_is_carried_unless_asked_for(ring, tmp_path):
    few = film(tmp_path, ring(6), 0.0)
    fitted = fit_first(few, 0, points=None, options=dataclasses.replace(OPTIONS, iterations=60))
    assert fitted.figures["sh"]["left_out"] == []
    assert fitted.quantizer.sh_degree == 0
    assert "fewer than 8 cameras film" in bands.told(fitted.figures["sh"])
    options = dataclasses.replace(OPTIONS, iterations=60, sh_gain=-1.0)
    assert fit_first(few, 0, points=None, options=options).quantizer.sh_degree == 1


@pytest.mark.parametrize(("count", "expected"), [(7, 0), (8, 2), (14, 2), (24, 4), (88, 15)])
def test_cameras_left_out_are_spread_over_the_rig(ring, count, expected):
    cameras = ring(count)
    chosen = bands.left_out(cameras)
    assert len(chosen) == expected
    assert chosen == sorted(set(chosen))
    if not chosen:
        return
    places = np.stack([camera.centre for camera in cameras])
    far = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1).max()
    evenly = np.linspace(0, count, expected, endpoint=False).astype(int)
    best = np.linalg.norm(places[:, None] - places[evenly], axis=2).min(axis=1).max()
    assert far <= 2 * best  # farthest-point choices are within a factor of two of the best cover


def test_cameras_in_one_place_have_one_judge(ring):
    assert len(bands.left_out([ring(12)[0]] * 12)) == 1
