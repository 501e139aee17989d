"""Short headers: as float32 tells them, of the same pictures, and lenses that say nothing twice."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from packuv.camera import PinholeCamera
from packuv.compress import Goal, compress
from packuv.compress.brief import brief
from packuv.footage.lens import LensCamera, abridged, unabridged, undistorted_camera
from packuv.metrics import decibels
from packuv.raster import RasterOptions, render
from packuv.scene import open_scene, write_scene
from tests.support.small_scene import small_scene, small_segments

CLOCK = 1700000000.123
"""A number that nobody here knows the meaning of, and float32 would lose"""


def camera(number, away):
    """Before the small scene, which is this far away along each axis; turned a little, in no round numbers."""
    rng = np.random.default_rng(number)
    turn, _ = np.linalg.qr(np.eye(3) + rng.normal(0, 0.05, (3, 3)))
    turn *= np.sign(np.diag(turn))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, rng.normal(0, 0.2, 3) - turn @ np.full(3, away)
    return PinholeCamera(f"cam{number}", 96, 64, 80 * 1.1**0.5, 80 * 1.2**0.5, 48 + 1 / 3, 32 - 1 / 3, pose)


def filmed(header, *, away=0.0, whole=False):
    """A header as if real cameras had filmed the scene; whole entries are those of older files."""
    straight, distorted, round_ = (camera(number, away) for number in range(3))
    gains, shading = (0.85072774123456, 1.0, 1.1), (-0.01234567890123, 0.0)
    lenses = [
        LensCamera(straight),
        LensCamera(distorted, (-0.0712345678901, 0.01, 0.0, 0.0), gains, shading),
        LensCamera(round_, (0.0123456789012, 0.0, 0.0, 0.0), fisheye=True),
    ]
    cameras = tuple(map(undistorted_camera, lenses))
    entries = [lens.to_json() for lens in lenses] if whole else abridged(lenses, cameras)
    quantizer = replace(header.quantizer, centre=header.quantizer.centre + away, unit=1.1385163774)
    extra = {**header.extra, "near": 0.1 + 1 / 3**9, "lenses": entries, "clock": CLOCK}
    return replace(header, cameras=cameras, quantizer=quantizer, extra=extra)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    with open_scene(small_scene(tmp_path_factory.mktemp("scene") / "scene.mkv")) as opened:
        yield opened


@pytest.fixture(scope="module")
def header(scene):
    return filmed(scene.header)


def floats(value):
    """Those of JSON, in order."""
    if isinstance(value, (dict, list)):
        return [number for item in (value.values() if isinstance(value, dict) else value) for number in floats(item)]
    return [value] if isinstance(value, float) else []


def lenses_of(header):
    return list(unabridged(header.extra["lenses"], header.cameras, "lenses").values())


def told(header):
    """All numbers of cameras and lenses, and near."""
    known = [item.to_json() for item in (*header.cameras, *lenses_of(header))]
    return [*floats(known), header.near]


def test_cameras_and_lenses_are_as_float32_in_nine_digits_at_most(header):
    short = brief(header)
    assert np.array_equal(np.float32(told(short)), np.float32(told(header)))
    digits = [json.dumps(number).split("e")[0].strip("-").replace(".", "").strip("0") for number in told(short)]
    assert max(map(len, digits)) <= 9
    assert brief(short).to_json() == short.to_json()
    assert len(json.dumps(short.to_json())) < 0.8 * len(json.dumps(header.to_json()))


def test_what_decodes_and_what_nobody_knows_stay_as_they_are(header):
    before, after = header.to_json(), brief(header).to_json()
    for data in (before, after):
        del data["cameras"], data["extra"]["lenses"], data["extra"]["near"]
    assert before == after
    assert after["extra"]["clock"] == CLOCK


def test_older_headers_get_as_short(scene, header):
    older = filmed(scene.header, whole=True)
    assert "width" in older.extra["lenses"][0]
    assert brief(older).to_json() == brief(header).to_json()
    assert brief(header).extra["lenses"][0] == {"name": "cam0"}


def test_pictures_stay(scene, header):
    gaussians = scene.gaussians(0)
    for before, after in zip(header.cameras, brief(header).cameras, strict=True):
        one, other = (render(gaussians, each, options=RasterOptions(near=0.1)).colour for each in (before, after))
        # 1e-4 of 255 levels in the mean. Where a Gaussian fades below 1/255, and ends, a pixel may differ by that.
        assert np.abs(one - other).mean() < 1e-4 / 255
        assert decibels(float(np.square(one - other, dtype=np.float64).mean())) > 90


def test_cameras_far_from_the_origin_keep_their_digits_and_lenses_are_short_all_the_same(scene):
    far = filmed(scene.header, away=3e3, whole=True)
    short = brief(far)
    assert [item.to_json() for item in short.cameras] == [item.to_json() for item in far.cameras]
    assert [item.to_json() for item in lenses_of(short)] == [item.to_json() for item in lenses_of(far)]
    assert short.extra["lenses"][0] == {"name": "cam0"}


def test_scenes_of_no_lenses_and_numbers_beyond_float32_are_no_trouble(scene):
    extra = {"near": 0.1, "scene_radius": 1e300, "up": [0.6, 0.0, -0.8], "compression": {"rows": 1e-300}}
    plain = replace(scene.header, extra=extra)
    assert brief(plain).to_json() == plain.to_json()


def test_a_compressed_scene_has_a_short_header(scene, tmp_path):
    parts = [tmp_path / f"{number}.npz" for number in range(2)]
    for part, segment in zip(parts, small_segments(), strict=True):
        segment.save(part)
    older = replace(filmed(scene.header, whole=True), quantizer=scene.header.quantizer)
    write_scene(tmp_path / "scene.mkv", parts, older)
    compress(tmp_path / "scene.mkv", tmp_path / "small.mkv", Goal(ratio=2.5), iterations=0)
    with open_scene(tmp_path / "small.mkv") as small:
        assert small.header.extra["lenses"] == brief(older).extra["lenses"]
        assert brief(small.header).to_json() == small.header.to_json()
        assert small.header.extra["clock"] == CLOCK


def test_lenses_that_contradict_the_cameras_are_refused(header):
    with pytest.raises(ValueError, match="extra: lenses must name cameras of the scene, each once, but names 'other'"):
        brief(replace(header, extra={**header.extra, "lenses": [{"name": "other"}]}))
