"""The proof that a scene file holds what was fitted."""

import json
from fractions import Fraction

import numpy as np
import pytest

from packuv.fit.keyframe import KeyState
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.codes import OPACITY, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.scene import EncodeOptions, SceneHeader, Tolerance, open_scene, write_scene
from sync.align import AlignOptions, align
from sync.timecode import Timecodes
from tasks.stages.encode import SCENE, build_scene, build_verification, write_finished
from tasks.stages.footage import RIG, Footage
from tests.support.calibration_scene import ring

COLUMNS = attribute_count(0)


def segments():
    """Two segments of three frames; the second keeps most rows of the first one's key."""
    rng = np.random.default_rng(0)
    result = []
    key = Codes(rng.integers(0, 65536, (400, 3), np.uint16), rng.integers(1, 256, (400, COLUMNS), np.uint8))
    for number in range(2):
        dynamic = rng.random(400) < 0.4
        steps = rng.integers(-90, 90, (2, int(dynamic.sum()), 3))
        xyz = (key.xyz[dynamic] + np.cumsum(steps, axis=0)).astype(np.uint16)
        attributes = np.repeat(key.attributes[None, dynamic], 2, axis=0)
        attributes[:, :, :3] += rng.integers(0, 3, attributes[:, :, :3].shape).astype(np.uint8)
        result.append(Segment(3 * number, key, dynamic, xyz, attributes))
        key = Codes(key.xyz.copy(), key.attributes.copy())
        key.attributes[:50, OPACITY] ^= 1
    return result


@pytest.fixture
def fitted(tmp_path):
    paths = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for path, segment in zip(paths, segments(), strict=True):
        segment.save(path)
    return paths


QUANTIZER = Quantizer(np.zeros(3), 1.0, np.ones(3), np.full(COLUMNS, -1.0), np.full(COLUMNS, 1.0))


@pytest.fixture
def footage(tmp_path):
    """Six instants of three cameras, calibrated."""
    rig = ring(3)
    stamps = Timecodes(np.arange(6, dtype=np.int64) * 10**8, np.arange(6))
    groups, report = align(dict.fromkeys(rig.names, stamps), AlignOptions())
    groups.save(tmp_path / "groups", report)
    (tmp_path / "groups/videos.json").write_text('{"rate": "10/1"}')
    (tmp_path / "points").mkdir()
    rig.save(tmp_path / "points" / RIG)
    return Footage(tmp_path, tmp_path / "groups", tmp_path / "points", rig.names, 0, None)


@pytest.fixture
def key(tmp_path, fitted):
    """The folder of the first keyframe."""
    folder = tmp_path / "key"
    folder.mkdir()
    gaussians = QUANTIZER.decode(Segment.load(fitted[0]).key)
    KeyState(0, gaussians, QUANTIZER, Bounds(np.zeros(3), 3.0, 0.1), {}).save(folder)
    return folder


def test_the_scene_says_how_it_was_filmed(footage, key, fitted, tmp_path):
    steps, out = [], tmp_path / "out"
    out.mkdir()
    options = EncodeOptions(Tolerance(10, 1))
    notes = build_scene(footage, ("cam01",), key, fitted, options, out, lambda done, total, _: steps.append(done))
    assert notes == json.loads((out / "encode.json").read_text())
    assert notes["frames"] == 6
    assert steps == list(range(1, 13))
    with open_scene(out / SCENE) as scene:
        assert notes["bytes"] == (out / SCENE).stat().st_size
        assert scene.index.tolerance == options.tolerance
        assert scene.header.times_ns.tolist() == [k * 10**8 for k in range(6)]
        assert [camera.name for camera in scene.header.cameras] == ["cam00", "cam01", "cam02"]
        assert scene.header.held_out == ("cam01",)
        assert scene.header.extra["near"] == 0.1


def test_what_is_fitted_so_far_plays_and_grows_into_the_whole(footage, key, fitted, tmp_path):
    path = tmp_path / "so_far.mkv"
    assert write_finished(path, footage, (), key, fitted[:1]) == 3
    with open_scene(path) as scene:
        assert len(scene) == 3
    out = tmp_path / "out"
    out.mkdir()
    build_scene(footage, (), key, fitted, EncodeOptions(), out, lambda *_: None)
    assert write_finished(path, footage, (), key, fitted) == 6
    assert path.read_bytes() == (out / SCENE).read_bytes()


def write(path, paths, tolerance=None):
    header = SceneHeader(QUANTIZER, np.arange(6, dtype=np.int64) * 10**8, Fraction(10))
    write_scene(path, paths, header, options=EncodeOptions(tolerance or Tolerance()))
    return path


def verify(scene, paths, out):
    steps = []
    notes = build_verification(scene, paths, out, lambda done, total, note: steps.append((done, total)))
    assert steps == [(done, 6) for done in range(1, 7)]
    assert json.loads((out / "verify.json").read_text()) == notes
    return notes


def test_a_lossless_scene_holds_every_integer(fitted, tmp_path):
    notes = verify(write(tmp_path / "scene.mkv", fitted), fitted, tmp_path)
    assert notes == {"frames": 6, "exact": True, "largest_error": {"position": 0, "attribute": 0}}


def test_a_lossy_scene_stays_within_what_it_states(fitted, tmp_path):
    notes = verify(write(tmp_path / "scene.mkv", fitted, Tolerance(10, 1)), fitted, tmp_path)
    assert notes == {"frames": 6, "exact": False, "largest_error": {"position": 10, "attribute": 1}}


@pytest.mark.parametrize(
    "change",
    [
        lambda segment: segment.xyz.__setitem__((1, 0, 0), segment.xyz[1, 0, 0] ^ 64),
        lambda segment: segment.attributes.__setitem__((0, 0, 0), segment.attributes[0, 0, 0] ^ 16),
        lambda segment: segment.attributes.__setitem__((0, 3, OPACITY), 0),
        lambda segment: segment.key.attributes.__setitem__((7, 0), segment.key.attributes[7, 0] ^ 1),
    ],
)
def test_anything_else_is_refused(fitted, tmp_path, change):
    scene = write(tmp_path / "scene.mkv", fitted, Tolerance(10, 1))
    other = segments()[1]
    change(other)
    other.save(fitted[1])
    with pytest.raises(RuntimeError, match="does not decode to what was fitted"):
        build_verification(scene, fitted, tmp_path, lambda *_: None)


def test_another_number_of_segments_or_frames_is_refused(fitted, tmp_path):
    scene = write(tmp_path / "scene.mkv", fitted)
    with pytest.raises(RuntimeError, match="has 2 segments, but 1 were fitted"):
        build_verification(scene, fitted[:1], tmp_path, lambda *_: None)
