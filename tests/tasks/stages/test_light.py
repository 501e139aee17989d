"""Light and exposures go from videos through the store to views, points and the scene's header."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.accept import MatchesReport, Verdict
from calibration.triangulate import SparsePoints
from packuv.colour import lit
from packuv.fit.keyframe import KeyState
from packuv.fit.start.bounds import Bounds
from packuv.footage import FrameReader, Light, LightOptions
from packuv.gaussians.codes import Codes, Quantizer, attribute_count
from packuv.scene import SceneHeader
from sync.align import AlignOptions
from tasks.artefacts.stage import Files, Notes, Site
from tasks.artefacts.store import Key
from tasks.stages.calibrate import _steady
from tasks.stages.encode import scene_header
from tasks.stages.evaluate import _light
from tasks.stages.footage import LIGHT, RIG, Footage, Take
from tasks.stages.light import MeasureLight, is_steady, read_steady, why_steady
from tasks.stages.synchronize import Synchronize
from tests.support.artefacts import build_here, put
from tests.support.calibration_scene import ring
from tests.support.pictures import write_picture
from tests.support.planes import write_planes

HEIGHT, WIDTH, INSTANTS, JUMP = 64, 96, 10, 6
NAMES = ("cam00", "cam01", "cam02", "cam03", "cam04")
NEAR = 0.004
"""Share of light: grey levels of 8-bit video in limited range are coarse, and pictures without noise do not help"""


def exposure() -> np.ndarray:
    """float64 [T] of mean 0: a fifth brighter from an instant on."""
    level = np.where(np.arange(INSTANTS) < JUMP, 0, np.log(1.2))
    return np.asarray(level - level.mean())


def fading() -> np.ndarray:
    return np.linspace(0.05, -0.05, INSTANTS)


def write_capture(folder: Path, light: np.ndarray) -> None:
    """Five cameras that look at soft patterns of grey; the last one jumps."""
    videos = folder / "videos"
    videos.mkdir(parents=True)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    for number, name in enumerate(NAMES):
        pattern = 0.45 + 0.15 * np.sin(x / 13 + number) + 0.15 * np.cos(y / 11 - number * x / 40)
        logs = light + (exposure() if name == "cam04" else 0)
        pictures = [lit(np.broadcast_to(pattern, (3, HEIGHT, WIDTH)), np.full(3, log))[0] for log in logs]
        grey = np.full((HEIGHT, WIDTH), 128, np.uint8)
        planes = [[np.rint(16 + 219 * picture).astype(np.uint8), grey, grey] for picture in pictures]
        write_planes(videos / f"{name}.mkv", "yuv444p", planes, (1, 1, 2, 1))


def measured(
    tmp_path: Path, light: np.ndarray, fitted: tuple[str, ...] = NAMES
) -> tuple[Take, Site, MeasureLight, Notes]:
    """A take with its light, as a sequence makes them."""
    write_capture(tmp_path / "capture", light)
    site = Site(tmp_path / "store", tmp_path / "capture", 2)
    videos = Files({name: "content" for name in NAMES})
    sync = Synchronize(videos=videos, timecodes=Files({}), fps=None, timecode_column=None, options=AlignOptions())
    _, folder = build_here(sync, site, tmp_path / "sync")
    groups = put(site, "sync", lambda out: shutil.copytree(folder, out, dirs_exist_ok=True))
    stage = MeasureLight(take=Take(groups=groups, cameras=NAMES), fitted=fitted, options=LightOptions())
    notes, made = build_here(stage, site, tmp_path / "light")
    key = put(site, "light", lambda out: shutil.copytree(made, out, dirs_exist_ok=True))
    points = put(site, "points", lambda out: ring(len(NAMES), size=(WIDTH, HEIGHT)).save(out / RIG))
    return Take(groups=groups, rig=points, light=key, cameras=NAMES), site, stage, notes


def key_of(take: Take) -> Key:
    assert take.light is not None
    return take.light


def header_of(take: Take, site: Site) -> SceneHeader:
    columns = attribute_count(0)
    quantizer = Quantizer(np.zeros(3), 1.0, np.ones(3), np.full(columns, -1.0), np.full(columns, 1.0))
    key = KeyState(
        0,
        quantizer.decode(Codes(np.zeros((1, 3), np.uint16), np.zeros((1, columns), np.uint8))),
        0,
        quantizer,
        Bounds(np.zeros(3), 3.0, 0.1),
        {},
    )
    footage = Footage(take, site)
    return scene_header(footage, (), key, footage.load_light())


def test_views_show_steady_light_and_the_scene_keeps_what_was_taken_out(tmp_path):
    take, site, stage, notes = measured(tmp_path, fading(), fitted=NAMES[1:])
    assert not is_steady(site.path(key_of(take)))
    assert list(stage.spared(site.path(key_of(take)), notes)) == []
    assert notes["exposures"].keys() == {"cam04"}
    light = Light.load(site.path(key_of(take)) / LIGHT)
    assert np.abs(light.light - fading()[:, None]).max() < NEAR
    assert np.abs(light.exposures["cam04"] - exposure()[:, None]).max() < NEAR
    views = Footage(take, site).open_views(("cam04", "cam00"))
    for camera in range(2):
        filmed = np.stack([views.filmed(camera, t) for t in range(INSTANTS)])
        plain = np.stack([views.picture(camera, t) for t in range(INSTANTS)])
        assert np.ptp(filmed, axis=0).mean() > 0.015
        assert (
            np.ptp(plain, axis=0).max() < 0.012
        )  # a grey level of limited range either way, and what undoing makes of it
    header = header_of(take, site)
    again = _light(SceneHeader.from_json(header.to_json()))
    assert np.array_equal(again.of(NAMES, INSTANTS), light.of(NAMES, INSTANTS))
    cut = _light(header.first(7))
    assert np.array_equal(cut.of(NAMES, 7), light.of(NAMES, 7))


def test_a_part_of_the_capture_that_ends_later_is_steady_from_there_on(tmp_path):
    take, site, _, _ = measured(tmp_path, fading())
    first = replace(take, stop=4)
    assert len(Footage(first, site).open_views()) == 4
    views = Footage(first, site).open_views()
    assert np.array_equal(views.light, Footage(take, site).open_views().light[:4])


def test_steady_light_spares_a_line_and_changes_nothing(tmp_path):
    take, site, stage, notes = measured(tmp_path, np.zeros(INSTANTS))
    folder = site.path(key_of(take))
    told = dict(stage.spared(folder, notes))
    assert told == {"light of the instant": read_steady(folder)}
    assert told["light of the instant"].endswith("less than 0.20%")
    light = Light.load(folder / LIGHT)
    assert not light.light.any()
    assert light.exposures.keys() == {"cam04"}
    assert "light" not in header_of(take, site).to_json()
    plain = header_of(replace(take, light=None), site)
    assert "exposure" not in plain.extra
    assert Footage(replace(take, light=None), site).open_views().light is None


def test_points_have_the_colours_of_steady_light():
    light = Light(
        np.log([[1.0] * 3, [0.5] * 3, [2.0] * 3]).astype(np.float32), {"b": np.log(np.full((3, 3), 4.0, np.float32))}
    )
    report = MatchesReport(2, 2, 1.0, 0.1, {}, (), None, Verdict.ACCEPTED, "")
    points = SparsePoints(
        cameras=("a", "b"),
        xyz=np.zeros((2, 3)),
        rgb=np.zeros((2, 3), np.uint8),
        views=np.full(2, 2, np.int32),
        error_px=np.zeros(2),
        instant=np.array([0, 1], np.int32),
        point=np.array([0, 0, 1, 1], np.int32),
        camera=np.array([0, 1, 0, 1], np.int32),
        xy=np.zeros((4, 2)),
        colour=np.array([[0.2] * 3, [0.8] * 3, [0.4] * 3, [np.nan] * 3], np.float32),
        matches=report,
    )
    factors = light.of(("c", "a", "b"), 3)[[0, 2]]
    steady = _steady(points, ("c", "a", "b"), factors)
    assert np.allclose(steady.colour[:, 0], [0.2, 0.2, 0.2, np.nan], equal_nan=True)
    assert _steady(points, ("c", "a", "b"), None) is points
    assert steady.colour.dtype == points.colour.dtype


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"spread": 0.0005, "left": 0.8, "least": 0.002}, "it changes by 0.05%, less than 0.20%"),
        ({"spread": 0.05, "left": None, "least": 0.002}, "fewer than two fitted cameras"),
        ({"spread": 0.05, "left": 1.1, "least": 0.002}, "light that some cameras see leaves 110%"),
    ],
)
def test_why_light_is_steady(facts, said):
    assert why_steady(facts).startswith(said)


def test_damaged_pictures_count_as_missing_from_then_on(tmp_path):
    write_capture(tmp_path / "capture", np.zeros(INSTANTS))
    videos = tmp_path / "capture" / "videos"
    pictures = [FrameReader({"a": videos / "cam01.mkv"}).read("a", t) for t in range(INSTANTS)]
    (videos / "cam01.mkv").unlink()
    for t, picture in enumerate(pictures):
        write_picture(videos / "cam01" / f"{t:04d}.png", picture)
    for t in (3, 4, 7):
        (videos / "cam01" / f"{t:04d}.png").write_bytes(b"content")
    site = Site(tmp_path / "store", tmp_path / "capture", 2)
    sync = Synchronize(
        videos=Files({name: f"content of {name}" for name in NAMES}),
        timecodes=Files({}),
        fps=None,
        timecode_column=None,
        options=AlignOptions(),
    )
    told, folder = build_here(sync, site, tmp_path / "sync")
    assert "times of cam01 are the numbers of their pictures" in told["footage"][0]
    groups = put(site, "sync", lambda out: shutil.copytree(folder, out, dirs_exist_ok=True))
    take = Take(groups=groups, cameras=NAMES)
    stage = MeasureLight(take=take, fitted=NAMES, options=LightOptions())
    notes, made = build_here(stage, site, tmp_path / "light")
    assert not is_steady(made)
    wanted = "cam01: 3 pictures are damaged (3 lost), frames 3-4, 7; they count as missing"
    assert ("damaged pictures", wanted) in list(stage.spared(made, notes))
    key = put(site, "light", lambda out: shutil.copytree(made, out, dirs_exist_ok=True))
    frames = Footage(replace(take, light=key), site).load_frames()
    assert frames["cam01"].tolist() == [-1 if t in (3, 4, 7) else t for t in range(INSTANTS)]
    assert frames["cam00"].tolist() == list(range(INSTANTS))
    assert Footage(take, site).load_frames()["cam01"].tolist() == list(range(INSTANTS))
