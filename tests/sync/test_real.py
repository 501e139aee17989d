"""Recordings of real cameras; skipped where the data is not there (environment variable PACKUV_DATA)."""

from pathlib import Path

import numpy as np
import pytest

from sync.align import AlignOptions, align, build_index
from sync.capture import find_capture, load_timecodes
from sync.clock import ClockMode, ClockState
from sync.probe import probe_video
from sync.timecode import Timecodes, read_shared_timecodes, read_timecodes
from tests.support.needs import needs_data
from tests.support.places import DATA

BASKETBALL, BRICS, LOGS, WEBCAMS = (
    DATA / name for name in ("basketball", "timecodes/brics", "timecodes/webcams", "webcams/calibration/extrinsic")
)


@pytest.fixture(scope="module")
def basketball() -> dict[str, Timecodes]:
    capture = find_capture(BASKETBALL)
    return load_timecodes(capture, {camera: probe_video(path) for camera, path in capture.videos.items()})


def true_steps(timecodes: dict[str, Timecodes]) -> dict[str, np.ndarray]:
    """Time step of each frame, from the clock alone: all cameras share a 30 fps trigger.

    Stamps lie 0.18 of a frame after the grid in the median, and within 0.34 of that: rounding is unambiguous.
    """
    start = min(int(codes.times_ns.min()) for codes in timecodes.values())
    frames = {camera: (codes.times_ns - start) * 30 / 1e9 for camera, codes in timecodes.items()}
    phase = np.median(np.concatenate([values % 1 for values in frames.values()]))
    steps = {camera: np.rint(values - phase).astype(int) for camera, values in frames.items()}
    assert max(np.abs(values - phase - steps[camera]).max() for camera, values in frames.items()) < 0.4
    return steps


@needs_data(BASKETBALL)
@pytest.mark.parametrize("clock", [ClockMode.TRUSTED, ClockMode.TRIGGERED])
@pytest.mark.parametrize("reference", [None, "cam14", "cam22", "cam29"])
def test_basketball_frames_have_their_true_time_step(
    basketball: dict[str, Timecodes], clock: ClockMode, reference: str | None
) -> None:
    steps = true_steps(basketball)
    groups, report = align(basketball, AlignOptions(reference=reference, clock=clock))
    instants = steps[groups.reference]
    missed = 0
    for column, camera in enumerate(groups.cameras):
        frames = groups.frames[:, column]
        matched = frames >= 0
        assert np.array_equal(steps[camera][frames[matched]], instants[matched])
        missed += int((np.isin(instants, steps[camera]) & ~matched).sum())
        lost = steps[camera][-1] - steps[camera][0] + 1 - len(steps[camera])
        assert report.cameras[column].drops == lost
    # 2 of 4,000 frames come more than half a frame from the reference's, by jitter and latency together
    assert missed <= (2 if clock is ClockMode.TRUSTED else 0)
    assert len(groups) == (150 if reference is None else len(basketball[reference]))
    # frame number and time step differ in most videos, or the test would show nothing
    assert sum(not np.array_equal(own, np.arange(len(own))) for own in steps.values()) > 10


@needs_data(BASKETBALL)
def test_basketball_frame_counts_equal_the_timecode_lines(basketball: dict[str, Timecodes]) -> None:
    assert len(basketball) == 27
    assert all(np.array_equal(codes.indices, np.arange(len(codes))) for codes in basketball.values())
    assert min(len(codes) for codes in basketball.values()) == 143


@needs_data(BRICS)
def test_the_rig_of_the_paper() -> None:
    (path,) = BRICS.glob("*.txt")
    codes = read_timecodes(path)
    lines = path.read_text().split()
    assert codes.times_ns.tolist() == [int(line.split("_")[1]) * 1000 for line in lines]
    _, report = align({"cam1": codes})
    (camera,) = report.cameras
    assert (camera.lines, camera.duplicates, camera.reversals, camera.jumps) == (9000, 0, 0, 0)
    assert camera.period_ns == 20_009_000


@needs_data(BRICS)
@pytest.mark.parametrize("drift_ppm", [0.0, 60.0])
def test_free_running_copies_of_the_rig_are_told_from_triggered_ones(drift_ppm: float) -> None:
    (path,) = BRICS.glob("*.txt")
    codes = read_timecodes(path)
    rng = np.random.default_rng(0)
    since = codes.times_ns - codes.times_ns[0]
    triggered = codes.times_ns + 1_500_000 + np.rint(since * drift_ppm * 1e-6 + rng.normal(0, 1e5, 9000)).astype(int)
    free = codes.times_ns[0] + 5_000_000 + np.append(0, np.cumsum(rng.permutation(np.diff(codes.times_ns))))
    rig = {"a": codes, "b": Timecodes(triggered, codes.indices), "c": Timecodes(free, codes.indices)}
    groups, report = align(rig, AlignOptions(reference="a", clock=ClockMode.TRIGGERED))
    clocks = report.clocks
    assert (clocks["b"].state, clocks["c"].state) == (ClockState.CORRECTED, ClockState.FREE_RUNNING)
    assert abs(clocks["b"].drift_ppm - drift_ppm) < 0.1
    assert np.array_equal(groups.frames[:, 1], groups.frames[:, 0])
    assert 0.95 < report.cameras[2].matched_share < 0.999  # mutual matches of independent cameras: 98.1 % measured


@needs_data(LOGS)
def test_every_webcam_log_can_be_aligned() -> None:
    paths = sorted(LOGS.glob("*.csv"))
    assert len(paths) > 50
    for path in paths:
        names = sorted({line.split(",")[1] for line in path.read_text().split()[1:]})
        timecodes = read_shared_timecodes(path, names)
        for clock in ClockMode:
            groups, report = align(timecodes, AlignOptions(clock=clock))
            assert sum(camera.lines for camera in report.cameras) == len(path.read_text().split()) - 1
            assert 0 < report.complete <= len(groups)
        groups, report = align(timecodes)
        index = build_index(timecodes)
        instants, numbers = index[groups.reference].items()
        for column, camera in enumerate(groups.cameras):
            found, residuals = index[camera].nearest(instants, report.tolerance_ns)
            matched = groups.frames[:, column] >= 0
            assert np.array_equal(found[matched], groups.frames[matched, column])
            assert np.array_equal(residuals[matched], groups.residuals_ns[matched, column])
        assert np.array_equal(numbers, groups.frames[:, groups.cameras.index(groups.reference)])


@needs_data(WEBCAMS)
def test_webcam_videos_form_a_capture(tmp_path: Path) -> None:
    for folder, pattern in (("videos", "*.mp4"), ("timecodes", "timestamps.csv")):
        (tmp_path / folder).mkdir()
        for path in WEBCAMS.glob(pattern):
            (tmp_path / folder / path.name).symlink_to(path)
    capture = find_capture(tmp_path)
    assert capture.cameras == ("cam_0", "cam_1", "cam_2", "cam_3")
    infos = {camera: probe_video(path) for camera, path in capture.videos.items()}
    groups, report = align(load_timecodes(capture, infos))
    # the recorder's own sync_index says that frame k of each video belongs to frame k of the others
    assert np.array_equal(groups.frames, np.repeat(np.arange(111), 4).reshape(111, 4))
    assert all(camera.residual_p95_ns < 25_000_000 for camera in report.cameras)
