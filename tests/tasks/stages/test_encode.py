"""The proof that a scene file holds what was fitted."""

import hashlib
import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from packuv.fit.keyframe import KeyState
from packuv.fit.start.bounds import Bounds
from packuv.footage import Light
from packuv.gaussians.codes import OPACITY, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.scene import EncodeOptions, SceneHeader, Tolerance, open_scene, write_scene
from packuv.scene.sound import RATE
from sync.align import AlignOptions, align
from sync.timecode import Timecodes
from tasks.artefacts.stage import Site
from tasks.stages.encode import SCENE, Encode, Verify, scene_header
from tasks.stages.evaluate import _lenses as filmed_lenses
from tasks.stages.evaluate import known_cameras
from tasks.stages.fitting import SEGMENT
from tasks.stages.footage import RIG, Footage, Take, lens_camera
from tests.support.artefacts import build_here, put
from tests.support.calibration_scene import ring
from tests.support.sounds import write_video

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
def site(tmp_path):
    return Site(tmp_path / "store", tmp_path, 1)


@pytest.fixture
def fitted(site):
    return fit(site, segments())


def fit(site, parts):
    """Artefacts that hold these segments."""
    return tuple(
        put(site, "segment", lambda out, part=part: part.save(out / SEGMENT), content=digest(part)) for part in parts
    )


def digest(segment):
    arrays = (segment.key.xyz, segment.key.attributes, segment.dynamic, segment.xyz, segment.attributes)
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


QUANTIZER = Quantizer(np.zeros(3), 1.0, np.ones(3), np.full(COLUMNS, -1.0), np.full(COLUMNS, 1.0))


def film(site, names, **sounds):
    """A capture of these cameras, with what some of them heard, at 48,000 samples a second."""
    (site.capture / "videos").mkdir(exist_ok=True)
    for name in names:
        write_video(site.capture / f"videos/{name}.mkv", sounds.get(name), rate=RATE)


@pytest.fixture
def take(site):
    """Six instants of three cameras, calibrated, that heard nothing."""
    rig = ring(3)
    film(site, rig.names)
    stamps = Timecodes(np.arange(6, dtype=np.int64) * 10**8, np.arange(6))
    groups, report = align(dict.fromkeys(rig.names, stamps), AlignOptions())

    def synchronized(out):
        groups.save(out, report)
        (out / "videos.json").write_text('{"rate": "10/1"}')

    points = put(site, "points", lambda out: rig.save(out / RIG))
    return Take(groups=put(site, "sync", synchronized), rig=points, cameras=rig.names)


@pytest.fixture
def key(site):
    """The first keyframe."""
    state = KeyState(0, QUANTIZER.decode(segments()[0].key), 0, QUANTIZER, Bounds(np.zeros(3), 3.0, 0.1), {})
    return put(site, "key", state.save)


def test_the_scene_says_how_it_was_filmed(site, take, key, fitted, tmp_path):
    steps = []
    options = EncodeOptions(Tolerance(10, 1))
    stage = Encode(take=take, held_out=("cam01",), key=key, segments=fitted, options=options)
    notes, out = build_here(stage, site, tmp_path, lambda done, total, note="": steps.append(done))
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


def test_the_header_takes_light_of_the_instants(site, take, key):
    footage, state = Footage(take, site), KeyState.load(site.path(key))
    light = np.linspace(-0.2, 0.2, 18).reshape(6, 3).round(5)
    assert np.array_equal(scene_header(footage, (), state, Light(light.astype(np.float32))).light, light)
    plain = scene_header(footage, (), state)
    assert not plain.light.any()
    assert "up" not in plain.extra


def test_the_header_says_where_up_is_where_that_is_known(site, take, key):
    rig = replace(Footage(take, site).load_rig(), up=(0.0, -0.6, 0.8), metric=True)
    upright = replace(take, rig=put(site, "rig", lambda out: rig.save(out / RIG), up="known"))
    header = scene_header(Footage(upright, site), (), KeyState.load(site.path(key)))
    assert header.up == (0.0, -0.6, 0.8)
    assert header.extra["metric"] is True


def test_the_header_says_of_lenses_what_cameras_do_not_and_older_ones_all(site, take, key):
    footage = Footage(take, site)
    rig = footage.load_rig()
    bent = replace(rig, cameras=(replace(rig.cameras[0], distortion=(-0.05, 0.0, 0.0, 0.0)), *rig.cameras[1:]))
    header = scene_header(
        Footage(replace(take, rig=put(site, "rig", lambda out: bent.save(out / RIG), bent="one")), site),
        (),
        KeyState.load(site.path(key)),
    )
    assert [set(entry) for entry in header.extra["lenses"]] == [{"name", "fx", "fy", "distortion"}, {"name"}, {"name"}]
    wanted = [lens_camera(camera).to_json() for camera in bent.cameras]
    for extra in (header.extra, {**header.extra, "lenses": wanted}):
        found = filmed_lenses(replace(header, extra=extra))
        assert [lens.to_json() for lens in found.values()] == wanted
    lost = replace(header, extra={**header.extra, "lenses": [{"name": "other"}]})
    with pytest.raises(ValueError, match="extra: lenses must name cameras of the scene, each once, but names 'other'"):
        known_cameras(lost)


def test_what_is_fitted_so_far_plays_and_grows_into_the_whole(site, take, key, fitted, tmp_path):
    path = tmp_path / "so_far.mkv"
    whole = Encode(take=take, held_out=(), key=key, segments=fitted, options=EncodeOptions())
    assert replace(whole, segments=fitted[:1]).write_finished(path, site) == 3
    with open_scene(path) as scene:
        assert len(scene) == 3
    _, out = build_here(whole, site, tmp_path)
    assert whole.write_finished(path, site) == 6
    assert path.read_bytes() == (out / SCENE).read_bytes()


def test_the_scene_sounds_as_the_reference_camera_heard_it(site, take, key, fitted, tmp_path):
    stage = Encode(take=replace(take, first=2), held_out=(), key=key, segments=fitted[:1], options=EncodeOptions())
    _, out = build_here(replace(stage, take=replace(take, first=2, stop=5)), site, tmp_path)
    silent = (out / SCENE).read_bytes()
    rng = np.random.default_rng(0)
    sounds = [rng.integers(-9000, 9000, (2, 2 * RATE)) / 2**15 for _ in range(3)]
    reference = Footage(take, site).load_groups().reference
    for heard in range(3):  # by the last cameras, and at last by all
        film(site, take.cameras, **dict(zip(take.cameras[::-1], sounds[: heard + 1], strict=False)))
        _, out = build_here(replace(stage, take=replace(take, first=2, stop=5)), site, tmp_path)
        with open_scene(out / SCENE) as scene:
            sound = scene.sound()
        first = next(name for name in (reference, *take.cameras) if name in take.cameras[2 - heard :])
        assert sound.camera == first
        whole = sounds[2 - take.cameras.index(first)]
        assert np.array_equal(sound.samples(), whole[:, RATE // 5 : RATE // 2])  # from the third of ten frames a second
    mute = replace(stage, take=replace(take, first=2, stop=5), options=EncodeOptions(sound=False))
    _, out = build_here(mute, site, tmp_path)
    assert (out / SCENE).read_bytes() == silent


def write(site, keys, tolerance=None):
    """A scene file of these segments, as an artefact."""
    header = SceneHeader(QUANTIZER, np.arange(6, dtype=np.int64) * 10**8, Fraction(10))
    paths = [site.path(key) / SEGMENT for key in keys]
    options = EncodeOptions(tolerance or Tolerance())
    return put(site, "encode", lambda out: write_scene(out / SCENE, paths, header, options=options))


def verify(site, scene, keys, folder):
    steps = []
    stage = Verify(scene=scene, segments=keys)
    notes, out = build_here(stage, site, folder, lambda done, total, note="": steps.append((done, total)))
    assert steps == [(done, 6) for done in range(1, 7)]
    assert json.loads((out / "verify.json").read_text()) == notes
    return notes


def test_a_lossless_scene_holds_every_integer(site, fitted, tmp_path):
    notes = verify(site, write(site, fitted), fitted, tmp_path)
    assert notes == {"frames": 6, "exact": True, "largest_error": {"position": 0, "attribute": 0}}


def test_a_lossy_scene_stays_within_what_it_states(site, fitted, tmp_path):
    notes = verify(site, write(site, fitted, Tolerance(10, 1)), fitted, tmp_path)
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
def test_anything_else_is_refused(site, fitted, tmp_path, change):
    scene = write(site, fitted, Tolerance(10, 1))
    first, other = segments()
    change(other)
    with pytest.raises(RuntimeError, match="does not decode to what was fitted"):
        build_here(Verify(scene=scene, segments=fit(site, [first, other])), site, tmp_path)


def test_another_number_of_segments_or_frames_is_refused(site, fitted, tmp_path):
    scene = write(site, fitted)
    with pytest.raises(RuntimeError, match="has 2 segments, but 1 were fitted"):
        build_here(Verify(scene=scene, segments=fitted[:1]), site, tmp_path)
