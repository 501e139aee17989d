"""Light that fades, flickers, falls off in the corners, jumps in one camera and clips: the filmed pictures obey their
truth, to the rounding of 8 bits."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from studio.capture import ColourOptions, SimulateOptions, TruthKind, film, simulate
from studio.clocks import ClockOptions
from studio.film_set import OBJECTS, FilmSet, build_set
from studio.light import LensShading, LightOptions, draw_shading, exposure_over_time, light_over_time
from studio.raycast import Backdrop, View, look_once
from studio.rig import PlacementOptions, StudioCamera, place_cameras
from studio.srgb import LINEAR, linear_from_srgb, srgb_from_linear
from studio.truth import Recording, Truth, read_truth

LIGHT = LightOptions(fade=0.1, flicker=0.05, shading=0.35, exposure_jump=1.25, shine=0.1, wall_lamps=3.0)
LIT = SimulateOptions(
    cameras=5,
    frames=10,
    size="128x72",
    seed=7,
    clock=ClockOptions(drop_share=0.2, max_late_frames=2),
    colour=ColourOptions(0.2, 0.1),
    light=LIGHT,
    truth=TruthKind.LIGHT,
)
JUMPS = "cam02"
"""The second fitted camera: of five, cam03 is held out"""
ROUNDING = 0.51
"""Half a code, the rounding of a picture to 8 bits, and that of floats"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("light") / "capture"
    simulate(folder, LIT)
    return folder


@pytest.fixture(scope="module")
def truth(capture: Path) -> Truth:
    return read_truth(capture)


@pytest.fixture(scope="module")
def shiny() -> FilmSet:
    return build_set(7, LIT.entrance_share * LIT.frames / 30, shine=LIGHT.shine, wall_lamps=LIGHT.wall_lamps)


Pictures = dict[str, np.ndarray]
"""By camera, uint8 [F, H, W, 3]"""


def filmed(folder: Path, film_set: FilmSet, light: np.ndarray, recordings: list[Recording]) -> Pictures:
    (folder / "videos").mkdir(parents=True)
    return {r.camera.name: np.stack(list(film(folder, film_set, light, r, LIT))) for r in recordings}


@pytest.fixture(scope="module")
def pictures(
    capture: Path, truth: Truth, shiny: FilmSet, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Pictures, Pictures]:
    """Filmed as the truth says, to the byte of the video; and by ideal cameras under steady light."""
    folder = tmp_path_factory.mktemp("pictures")
    real = [Recording(c.camera, c.times, c.gains, c.exposure, c.shading) for c in truth.cameras.values()]
    ideal = [Recording(r.camera, r.times, np.ones(3), np.ones(len(r.exposure)), LensShading()) for r in real]
    lit = filmed(folder / "lit", shiny, truth.light, real)
    steady = filmed(folder / "steady", shiny, np.ones_like(truth.light), ideal)
    for name in lit:
        video = Path("videos") / f"{name}.mp4"
        assert (folder / "lit" / video).read_bytes() == (capture / video).read_bytes()
    return lit, steady


def log_offsets(truth: Truth, name: str) -> np.ndarray:
    """ln of the factors that hold for whole frames, [F, 3]."""
    camera = truth.cameras[name]
    logs: np.ndarray = np.log(camera.gains * truth.light[camera.times.ticks] * camera.exposure[:, None])
    return logs


def radii2(camera: StudioCamera) -> np.ndarray:
    """r^2 by pixel, [H, W]."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    across, down = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    corner = np.hypot(camera.width / 2 / camera.fx, camera.height / 2 / camera.fy)
    r2: np.ndarray = (across**2 + down**2) / corner**2
    return r2


def test_each_code_is_the_law_s_and_light_above_one_is_clipped(
    truth: Truth, pictures: tuple[Pictures, Pictures]
) -> None:
    lit, steady = pictures
    for name, camera in truth.cameras.items():
        factors = np.exp(log_offsets(truth, name))[:, None, None] * camera.shading.factors(camera.camera)[..., None]
        codes = steady[name].astype(float)
        # light within half a code; all of what the steady picture clips may be any brighter
        low, high = (linear_from_srgb(np.maximum(codes + end, 0) / 255) for end in (-ROUNDING, ROUNDING))
        high[codes == 255] = np.inf
        least, most = (255 * srgb_from_linear(np.clip(light * factors, 0, 1)) for light in (low, high))
        assert (lit[name] >= least - ROUNDING).all()
        assert (lit[name] <= most + ROUNDING).all()


def test_gains_light_exposure_and_shading_come_back_from_the_pictures(
    truth: Truth, pictures: tuple[Pictures, Pictures]
) -> None:
    lit, steady = pictures
    offsets = {}
    for name, camera in truth.cameras.items():
        offsets[name], shading = fit(lit[name], steady[name], camera.camera)
        # measured: 0.0003 and 0.0007 at most
        assert np.abs(offsets[name] - log_offsets(truth, name)).max() < 0.0006
        assert np.abs(shading - [camera.shading.k1, camera.shading.k2]).max() < 0.0015
    # with gains known, each factor alone: steady cameras tell the light, and that tells the exposure of the other one
    beside = {name: offsets[name] - np.log(camera.gains) for name, camera in truth.cameras.items()}
    for tick in range(LIT.frames):
        seen = [beside[name][c.times.ticks == tick] for name, c in truth.cameras.items() if name != JUMPS]
        assert np.abs(np.concatenate(seen).mean(axis=0) - np.log(truth.light[tick])).max() < 0.0006
    jumps = truth.cameras[JUMPS]
    own = (beside[JUMPS] - np.log(truth.light[jumps.times.ticks])).mean(axis=1)
    late = jumps.times.ticks >= LIT.frames // 2
    assert abs(own[late].mean() - own[~late].mean() - np.log(1.25)) < 0.0006


def fit(lit: np.ndarray, steady: np.ndarray, camera: StudioCamera) -> tuple[np.ndarray, np.ndarray]:
    """Offsets [F, 3] and k1, k2 by least squares on the ratios of light, from pixels neither dark nor near clipping."""
    r2 = radii2(camera)
    fourth = LensShading(0, 1).factors(camera)
    basis = np.stack([r2 - 1 / 3, np.log(fourth)], axis=-1)
    frame, row, column, channel = np.nonzero((steady > 60) & (steady < 150) & (lit < 250))
    ratio = np.log(LINEAR[lit].astype(float) / LINEAR[steady])[frame, row, column, channel]
    group, columns = 3 * frame + channel, basis[row, column]
    count = np.bincount(group, minlength=3 * len(lit))
    means = np.stack([np.bincount(group, v, 3 * len(lit)) / count for v in (ratio, *columns.T)], axis=-1)
    spread = np.concatenate([ratio[:, None], columns], axis=1) - means[group]
    shading = np.linalg.lstsq(spread[:, 1:], spread[:, 0], rcond=None)[0]
    return (means[:, 0] - means[:, 1:] @ shading).reshape(-1, 3), shading


def test_wall_lamps_clip_whatever_the_camera_s_factors(
    truth: Truth, pictures: tuple[Pictures, Pictures], shiny: FilmSet
) -> None:
    lit, _ = pictures
    seen = 0
    for name, camera in truth.cameras.items():
        backdrop = look_once(camera.camera.view, shiny.standing, shiny.light, shiny.colours, samples=2)
        light = backdrop.ambient + backdrop.key
        lamps = (backdrop.centre_owner == OBJECTS.index("lamp")) & (light.min(axis=(2, 3)) > 2.5)
        clipped = (lit[name] == 255).all(axis=-1)
        # what moves may stand before a lamp for some frames; measured: 0.99 to 1
        assert clipped[:, lamps].mean() > 0.9
        seen += lamps.sum()
    assert seen > 100


def test_factors_have_a_geometric_mean_of_one() -> None:
    assert np.exp(np.log(light_over_time(40, LIGHT)).mean(axis=0)) == pytest.approx(1)
    fading = light_over_time(40, LightOptions(fade=0.1))
    assert fading[-1] / fading[0] == pytest.approx(0.9)
    ticks = np.array([2, 3, 5, 6, 7, 8])
    exposure = exposure_over_time(ticks, 6, 1.25)
    assert np.exp(np.log(exposure).mean()) == pytest.approx(1)
    assert exposure[3:] / exposure[:3] == pytest.approx(1.25)
    rig = place_cameras(["a"], 640, 360, 7, PlacementOptions(jitter_m=0.0))
    # sampled at the pixels' centres; measured: 3e-7
    assert abs(np.log(LensShading(-0.35, 0.06).factors(rig[0])).mean()) < 1e-5


def test_without_options_every_factor_is_exactly_one(tmp_path: Path) -> None:
    plain = replace(LIT, light=LightOptions(), frames=4, cameras=2)
    simulate(tmp_path / "plain", plain)
    truth = read_truth(tmp_path / "plain")
    assert (truth.light == 1).all()
    for camera in truth.cameras.values():
        assert (camera.exposure == 1).all()
        assert (camera.shading.factors(camera.camera) == 1).all()


def test_two_thirds_of_the_cameras_have_lens_shading() -> None:
    shading = draw_shading(27, 7, LIGHT)
    falls = np.array([-s.k1 for s in shading])
    assert ((falls >= 0.7 * 0.35) & (falls <= 0.35)).sum() == 18
    assert (np.abs(falls) <= 0.15 * 0.35).sum() == 9
    assert all(abs(s.k2) <= 0.2 * abs(s.k1) for s in shading)
    assert draw_shading(27, 7, LIGHT) == shading != draw_shading(27, 8, LIGHT)


def test_only_the_second_fitted_camera_jumps(truth: Truth) -> None:
    jumped = {name for name, camera in truth.cameras.items() if (camera.exposure != 1).any()}
    assert jumped == {JUMPS}
    light = truth.light[:, 1]
    assert not np.allclose(light, light[0])
    assert any(later > now for now, later in pairwise(light))


def test_a_shiny_floor_mirrors_the_room(shiny: FilmSet) -> None:
    """Against cameras of one pixel that look along the mirrored rays."""
    dull = build_set(7, shiny.entrance_s, wall_lamps=LIGHT.wall_lamps)
    camera = place_cameras(["a", "b"], 96, 54, 7, PlacementOptions())[1]
    views = [look_once(camera.view, s.standing, s.light, s.colours, samples=1) for s in (shiny, dull)]
    gain = (views[0].ambient - views[1].ambient)[:, :, 0]
    rows, columns = np.nonzero(gain.max(axis=-1) > 0)
    assert len(rows) > 500
    for place in np.random.default_rng(0).choice(len(rows), 40, replace=False):
        row, column = rows[place], columns[place]
        direction, depth = ray(camera, row, column), views[0].centre_depth[row, column]
        cosine = -direction[2] / np.linalg.norm(direction)
        share = LIGHT.shine + (1 - LIGHT.shine) * (1 - cosine) ** 5
        floor = camera.centre + depth * direction
        assert abs(floor[2]) < 1e-9
        assert np.allclose(gain[row, column], share * mirrored(shiny, camera, floor, direction, depth), rtol=1e-4)


def ray(camera: StudioCamera, row: int, column: int) -> np.ndarray:
    local = [(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1]
    direction: np.ndarray = np.array(local) @ camera.camera_from_world[:3, :3]
    return direction


def mirrored(
    film_set: FilmSet, camera: StudioCamera, floor: np.ndarray, direction: np.ndarray, depth: float
) -> np.ndarray:
    """Radiance that comes to a point of the floor from where its mirror looks, [3]."""
    forward = direction * [1, 1, -1] / np.linalg.norm(direction)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    rotation = np.stack([right, np.cross(forward, right), forward])

    def look(focal: float) -> Backdrop:
        view = View(1, 1, np.array([focal, focal, 0.5, 0.5]), rotation, floor + np.array([0, 0, 1e-4]))
        return look_once(view, film_set.standing, film_set.light, film_set.colours, samples=1)

    away = look(camera.fx).centre_depth[0, 0]
    # a pixel of the camera covers as much paint at the end of both ways as this one does at the end of the second
    seen = look(camera.fx * away / (depth + away))
    radiance: np.ndarray = (seen.ambient + seen.key)[0, 0, 0]
    return radiance


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fade": 1.0}, "fade must be -1 to 0.95, but is 1.0"),
        ({"flicker": 0.9}, "flicker must be 0 to 0.8"),
        ({"shading": -0.1}, "shading must be 0 to 2"),
        ({"exposure_jump": -1.0}, "a factor of 0.1 to 10, or 0 for none, but is -1.0"),
        ({"shine": 2.0}, "shine must be 0 to 1"),
        ({"wall_lamps": -1.0}, "wall_lamps must be 0 to 100"),
    ],
)
def test_bad_options_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LightOptions(**options)
