"""Whole captures: the same bytes every time, complete or absent, true, and readable by the rest of the project."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from calibration.importers import load_rig
from studio.capture import (
    CalibrationKind,
    ColourOptions,
    SimulateOptions,
    TruthKind,
    draw_gains,
    quaternion,
    simulate,
    srgb_picture,
)
from studio.clocks import EPOCH_NS, SECOND_NS, ClockOptions
from studio.film_set import FilmSet, build_set
from studio.raycast import cast, follow, look_once, render
from studio.rig import PlacementOptions, RigKind, place_cameras
from studio.truth import Truth, read_truth
from studio.video import yuv_from_srgb
from sync.capture import find_capture, load_timecodes
from sync.clock import ClockMode
from sync.probe import probe_video

SMALL = SimulateOptions(
    cameras=4, frames=8, size="96x54", seed=7, clock=ClockOptions(drop_share=0.2, max_late_frames=2)
)


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("studio") / "capture"
    simulate(folder, SMALL)
    return folder


@pytest.fixture(scope="module")
def truth(capture: Path) -> Truth:
    return read_truth(capture)


@pytest.fixture(scope="module")
def film_set() -> FilmSet:
    return build_set(7, SMALL.entrance_share * SMALL.frames / 30)


def seconds(time_ns: int) -> float:
    return int(time_ns - EPOCH_NS) / SECOND_NS


def test_same_options_same_bytes(capture: Path, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    simulate(tmp_path / "another name", SMALL, progress=lambda done, total: calls.append((done, total)))
    first = digests(capture)
    assert digests(tmp_path / "another name") == first
    assert len(first) == 3 * 4 + 5
    total = sum(len(camera) for camera in read_truth(capture).cameras.values())
    assert calls == [(done, total) for done in range(total + 1)]
    assert [path.name for path in tmp_path.iterdir()] == ["another name"]


@pytest.mark.slow
def test_another_seed_is_another_capture(capture: Path, tmp_path: Path) -> None:
    other = SimulateOptions(cameras=4, frames=8, size="96x54", seed=8, clock=SMALL.clock, truth=TruthKind.LIGHT)
    simulate(tmp_path / "other", other)
    one, two = digests(capture), digests(tmp_path / "other")
    for name in ("videos/cam01.mp4", "timecodes/cam01.txt", "calibration/images.txt", "truth/truth.json"):
        assert one[name] != two[name]


def test_a_parcel_is_there_from_its_tick_on_and_changes_nothing_before(tmp_path: Path) -> None:
    plain = SimulateOptions(cameras=2, frames=6, size="96x54", seed=7, clock=ClockOptions(0, 0), entrance_share=1.0)
    simulate(tmp_path / "without", plain)
    simulate(tmp_path / "with", replace(plain, parcel_share=0.5))
    truth = read_truth(tmp_path / "with")
    assert truth.parcel_ns == truth.tick_times_ns[3]
    assert read_truth(tmp_path / "without").parcel_ns is None
    parcel = truth.objects.index("parcel")
    for name, camera in truth.cameras.items():
        shown = [bool((camera.frame(frame).object == parcel).any()) for frame in range(6)]
        assert shown == [False] * 3 + [True] * 3, name
        before, after = (camera.frame(frame) for frame in (2, 4))
        without = read_truth(tmp_path / "without").cameras[name]
        assert np.array_equal(before.object, without.frame(2).object)
        assert not after.moves[after.object == parcel].any()


def test_the_project_reads_it(capture: Path, truth: Truth) -> None:
    found = find_capture(capture)
    assert found.name == "studio"
    assert found.settings.fps == 30
    assert found.settings.clock is ClockMode.TRIGGERED
    assert found.settings.held_out == ("cam03",)
    assert found.cameras == tuple(truth.cameras) == ("cam01", "cam02", "cam03", "cam04")
    infos = {camera: probe_video(path) for camera, path in found.videos.items()}
    codes = load_timecodes(found, infos)
    for name, camera in truth.cameras.items():
        assert infos[name].frame_count == len(camera)
        assert (infos[name].width, infos[name].height, infos[name].codec, infos[name].rate) == (96, 54, "h264", 30)
        assert np.array_equal(codes[name].times_ns, camera.times.stamps_ns)
    assert any(len(camera.times.dropped) for camera in truth.cameras.values())


def test_calibration_is_the_rig_that_filmed(capture: Path, truth: Truth) -> None:
    rig = load_rig(capture / "calibration", names=None)
    placed = place_cameras(list(truth.cameras), 96, 54, SMALL.seed, SMALL.rig)
    for camera, placing in zip(rig.cameras, placed, strict=True):
        true = truth.cameras[camera.name].camera
        assert np.array_equal(true.camera_from_world, placing.camera_from_world)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (true.fx, true.fy, true.cx, true.cy)
        # through a quaternion and back
        assert np.abs(camera.camera_from_world - true.camera_from_world).max() < 1e-14


def test_pictures_are_the_room_at_the_true_time_with_the_camera_s_gains(
    capture: Path, truth: Truth, film_set: FilmSet
) -> None:
    for name in ("cam01", "cam04"):
        camera = truth.cameras[name]
        view = camera.camera.view
        backdrop = look_once(view, film_set.standing, film_set.light, film_set.colours, samples=2)
        with av.open(str(capture / "videos" / f"{name}.mp4")) as container:
            pictures = [frame.to_ndarray(format="yuv420p") for frame in container.decode(video=0)]
            stream = container.streams.video[0].codec_context
            assert (stream.colorspace, stream.color_primaries, stream.color_range) == (1, 1, 1)
        for index in (0, len(camera) - 1):
            moment = film_set.at(seconds(camera.times.times_ns[index]))
            light = render(
                view, backdrop, film_set.standing, moment.movers, moment.blockers, film_set.light, film_set.colours
            )
            expected = yuv_from_srgb(srgb_picture(light, camera.gains))
            error = pictures[index].astype(float) - expected
            # what H.264 loses at crf 14; measured: 1.2 to 2.0
            assert np.sqrt((error**2).mean()) < 2.6
            assert abs(error.mean()) < 0.2


def test_video_colours_are_bt709_limited_range() -> None:
    """Against the standard's own matrix, on flat colours."""
    colours = np.random.default_rng(0).integers(0, 256, (50, 3))
    for colour in colours:
        planes = yuv_from_srgb(np.broadcast_to(colour.astype(np.uint8), (2, 2, 3)).copy())
        r, g, b = colour / 255
        y = 0.2126 * r + 0.7152 * g + 0.0722 * b
        expected = 16 + 219 * y, 128 + 224 * (b - y) / 1.8556, 128 + 224 * (r - y) / 1.5748
        assert np.abs([planes[0, 0], planes[2, 0], planes[2, 1]] - np.array(expected)).max() <= 0.5 + 1e-9


def test_truth_per_pixel_is_the_ray_caster_s(truth: Truth, film_set: FilmSet) -> None:
    camera = truth.cameras["cam02"]
    view = camera.camera.view
    backdrop = look_once(view, film_set.standing, film_set.light, film_set.colours, samples=1)
    for index in (0, len(camera) - 1):
        now, later = (film_set.at(seconds(t[index])) for t in (camera.times.times_ns, camera.times.next_times_ns))
        hits = cast(view, backdrop, now.movers)
        motion = follow(view, hits, film_set.standing, now.movers, later.movers)
        frame = camera.frame(index)
        assert np.array_equal(frame.depth, hits.depth.astype(np.float32))
        assert np.array_equal(frame.object, hits.owner)
        assert np.array_equal(frame.flow, motion.flow.astype(np.float32))
        assert np.array_equal(frame.moves, motion.moves)
        assert np.array_equal(frame.seen, motion.seen)


def test_flow_leads_to_the_next_recorded_frame(truth: Truth) -> None:
    """Over a lost frame the flow is twice as long: the truth follows what was recorded."""
    camera = next(camera for camera in truth.cameras.values() if (np.diff(camera.times.ticks) == 2).any())
    step = np.diff(camera.times.ticks)
    long, short = (np.mean([mean_flow(camera, i) for i in np.flatnonzero(step == n)]) for n in (2, 1))
    assert 1.6 < long / short < 2.4


def mean_flow(camera, index: int) -> float:
    frame = camera.frame(int(index))
    return float(np.hypot(*frame.flow[frame.moves].T).mean())


def test_free_running_cameras_film_between_the_ticks(tmp_path: Path) -> None:
    clock = ClockOptions(0.0, 0, 0, 0, 0, free_running=True)
    options = SimulateOptions(cameras=3, frames=4, size="64x36", seed=7, clock=clock, truth=TruthKind.LIGHT)
    simulate(tmp_path / "free", options)
    assert find_capture(tmp_path / "free").settings.clock is ClockMode.TRUSTED
    cameras = read_truth(tmp_path / "free").cameras.values()
    assert len({camera.times.phase_ns for camera in cameras}) == 3
    for camera in cameras:
        # an exact clock shows the exposure's time, in whole microseconds
        assert np.abs(camera.times.stamps_ns - camera.times.times_ns).max() <= 500


def test_light_truth_and_no_calibration(tmp_path: Path) -> None:
    options = SimulateOptions(
        cameras=2,
        frames=3,
        size="64x36",
        seed=7,
        clock=ClockOptions(max_late_frames=1),
        truth=TruthKind.LIGHT,
        calibration=CalibrationKind.NONE,
        fps=Fraction(30000, 1001),
        name="bare",
    )
    simulate(tmp_path / "bare", options)
    found = find_capture(tmp_path / "bare")
    assert found.calibration is None
    assert (found.name, found.settings.fps, found.settings.held_out) == ("bare", Fraction(30000, 1001), ())
    truth = read_truth(tmp_path / "bare")
    assert truth.fps == Fraction(30000, 1001)
    with pytest.raises(FileNotFoundError, match=r"simulate with truth 'full'"):
        truth.cameras["cam01"].frame(0)
    with pytest.raises(IndexError, match=r"recorded [23] frames"):
        truth.cameras["cam01"].frame(3)


def test_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path / "out", SMALL, progress=interrupt)
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    for place in (tmp_path / "mine", tmp_path / "mine" / "file"):
        with pytest.raises(ValueError, match="must be a new or an empty folder"):
            simulate(place, SMALL)
    (tmp_path / "empty").mkdir()
    options = SimulateOptions(
        cameras=2, frames=2, size="64x36", seed=7, clock=ClockOptions(0, 0), truth=TruthKind.LIGHT
    )
    simulate(tmp_path / "empty", options)
    assert (tmp_path / "empty" / "capture.toml").is_file()
    with pytest.raises(FileNotFoundError, match="only captures made by `packuv simulate` have truth"):
        read_truth(tmp_path / "mine")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cameras": 1}, "2 to 999 cameras, but got 1"),
        ({"frames": 1}, "at least 2 frames, but got 1"),
        ({"size": "640"}, "WIDTHxHEIGHT in pixels, as 640x360, but is '640'"),
        ({"size": "641x360"}, "sides must be even.*641x360"),
        ({"fps": Fraction(0)}, "fps must be 1 to 1000, but is 0"),
        ({"seed": -1}, "seed must be 0 or more, but is -1"),
        ({"samples": 0}, "samples must be 1 to 8"),
        ({"entrance_share": 2.0}, "entrance_share must be 0 to 1"),
        ({"held_out": 7}, "0 to 6 of 8, but is 7"),
        ({"name": "a/b"}, "letters, digits"),
    ],
)
def test_bad_options_are_refused(options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SimulateOptions(**options)


def test_gains_have_mean_one_and_stay_in_their_spread() -> None:
    gains = draw_gains(50, 3, ColourOptions(0.2, 0.1))
    assert np.allclose(np.exp(np.log(gains).mean(axis=0)), 1)
    assert gains.max() / gains.min() < (1.2 * 1.1) ** 2
    assert gains.max() > 1.1
    assert np.allclose(draw_gains(5, 3, ColourOptions(0.0, 0.0)), 1)


def test_quaternions_give_back_the_rotation() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.linalg.det(rotation)
        w, x, y, z = quaternion(rotation)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        assert w >= 0
        assert np.allclose(np.eye(3) + 2 * w * cross + 2 * cross @ cross, rotation, atol=1e-14)


@pytest.mark.slow
def test_pictures_have_features_that_match(film_set: FilmSet) -> None:
    """At 640x360 there are SIFT features in plenty, and neighbours of a ring share them at the true place."""
    moment = film_set.at(0.1)
    found = []
    for camera in place_cameras([f"cam{k}" for k in range(16)], 640, 360, 7, PlacementOptions(RigKind.RING))[:4]:
        view = camera.view
        backdrop = look_once(view, film_set.standing, film_set.light, film_set.colours, samples=2)
        light = render(
            view, backdrop, film_set.standing, moment.movers, moment.blockers, film_set.light, film_set.colours
        )
        grey = cv2.cvtColor(srgb_picture(light, np.ones(3)), cv2.COLOR_RGB2GRAY)
        points, descriptors = cv2.SIFT_create().detectAndCompute(grey, None)
        assert len(points) >= 300
        found.append((view, cast(view, backdrop, moment.movers).depth, points, descriptors))
    for (view, depth, points, descriptors), (other, _, there, others) in pairwise(found):
        pairs = cv2.BFMatcher().knnMatch(descriptors, others, k=2)
        best = [first for first, second in pairs if first.distance < 0.8 * second.distance]
        # OpenCV's first pixel has its centre at 0, ours at 0.5
        here = np.array([points[match.queryIdx].pt for match in best]) + 0.5
        target = np.array([there[match.trainIdx].pt for match in best]) + 0.5
        column, row = here.astype(int).T
        fx, fy, cx, cy = view.intrinsics
        directions = np.stack([(here[:, 0] - cx) / fx, (here[:, 1] - cy) / fy, np.ones(len(here))], axis=1)
        local = (
            view.centre + depth[row, column, None] * (directions @ view.rotation) - other.centre
        ) @ other.rotation.T
        fx, fy, cx, cy = other.intrinsics
        projected = np.stack([fx * local[:, 0] / local[:, 2] + cx, fy * local[:, 1] / local[:, 2] + cy], axis=1)
        right = np.linalg.norm(projected - target, axis=1) < 2
        # measured: 421, 330 and 263 of 350 to 580
        assert right.sum() > 150
        assert right.mean() > 0.6
