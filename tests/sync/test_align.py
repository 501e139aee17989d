"""Frame groups: the laws of matching, then what a report counts."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sync.align import (
    AlignOptions,
    FrameGroups,
    SyncReport,
    align,
    build_index,
    choose_reference,
    load_index,
    save_index,
)
from sync.clock import ClockMode, ClockState
from sync.timecode import Timecodes
from sync.tree import FrameTree

PERIOD = 33_333_333
EPOCH = 1734551081929245000


def codes(times: list[int] | np.ndarray, frames: list[int] | None = None) -> Timecodes:
    numbers = np.arange(len(times)) if frames is None else np.array(frames)
    return Timecodes(np.array(times, dtype=np.int64), numbers.astype(np.int64))


def rig(seed: int, cameras: int = 5, steps: int = 200, jitter_ns: float = 1e6) -> tuple[dict[str, Timecodes], dict]:
    """Cameras of one trigger that start late and drop frames; also the true step of each frame."""
    rng = np.random.default_rng(seed)
    timecodes, truth = {}, {}
    for number in range(cameras):
        steps_taken = np.flatnonzero((np.arange(steps) >= rng.integers(0, 10)) & (rng.random(steps) > 0.05))
        times = EPOCH + steps_taken * PERIOD + rng.normal(0, jitter_ns, len(steps_taken)).astype(np.int64)
        timecodes[f"cam{number}"], truth[f"cam{number}"] = codes(times), steps_taken
    return timecodes, truth


MESSY = st.lists(st.integers(0, 3000), min_size=1, max_size=40)


def align_if_any(files: list[list[int]], **options: object) -> tuple[dict[str, Timecodes], FrameGroups | None]:
    """Camera "0" is the reference; None if nothing matches it."""
    timecodes = {str(number): codes(times) for number, times in enumerate(files)}
    try:
        return timecodes, align(timecodes, AlignOptions(reference="0", **options))[0]
    except ValueError:
        return timecodes, None


@given(st.lists(MESSY, min_size=2, max_size=4), st.integers(0, 200), st.booleans())
def test_matching_equals_a_search_in_the_index(files: list[list[int]], tolerance: int, mutual: bool) -> None:
    timecodes, groups = align_if_any(files, tolerance_ns=tolerance, mutual=mutual)
    index = build_index(timecodes)
    instants, numbers = index["0"].items()
    complete = np.ones(len(instants), bool)
    for column, camera in enumerate(timecodes):
        frames, residuals = index[camera].nearest(instants, tolerance)
        if mutual:
            times = timecodes[camera].times_ns[frames]
            # read backwards, so that a tie goes to the later instant
            back, _ = FrameTree(-instants[::-1], numbers[::-1]).nearest(-times, tolerance)
            keep = (frames >= 0) & (back == numbers)
            frames, residuals = np.where(keep, frames, -1), np.where(keep, residuals, 0)
        if groups is not None:
            assert np.array_equal(groups.times_ns, instants)
            assert np.array_equal(groups.frames[:, column], frames)
            assert np.array_equal(groups.residuals_ns[:, column], residuals)
        complete &= frames >= 0
    assert (groups is None) == (not complete.any())


@given(st.lists(MESSY, min_size=2, max_size=4), st.integers(0, 3000))
def test_no_frame_serves_two_instants(files: list[list[int]], tolerance: int) -> None:
    timecodes, groups = align_if_any(files, tolerance_ns=tolerance)
    if groups is None:
        return
    assert (groups.frames[:, 0] >= 0).all()
    assert not groups.residuals_ns[:, 0].any()
    for column, camera in enumerate(groups.cameras):
        there = groups.frames[:, column] >= 0
        used = groups.frames[there, column]
        assert len(set(used.tolist())) == len(used)
        times = timecodes[camera].times_ns[used]
        assert np.array_equal(times - groups.times_ns[there], groups.residuals_ns[there, column])
        assert (np.abs(groups.residuals_ns[:, column]) <= tolerance).all()


@pytest.mark.parametrize("clock", list(ClockMode))
@pytest.mark.parametrize("seed", range(4))
def test_frames_of_one_trigger_meet(seed: int, clock: ClockMode) -> None:
    timecodes, truth = rig(seed)
    groups, report = align(timecodes, AlignOptions(clock=clock))
    instants = truth[groups.reference]
    for column, camera in enumerate(groups.cameras):
        frames = groups.frames[:, column]
        expected = np.isin(instants, truth[camera])  # a camera has a frame exactly where it took one
        assert np.array_equal(frames >= 0, expected)
        assert np.array_equal(truth[camera][frames[expected]], instants[expected])
        drops = truth[camera][-1] - truth[camera][0] + 1 - len(truth[camera])
        assert report.cameras[column].drops == drops
    assert report.complete == np.mean([(groups.frames >= 0).all(axis=1)]) * len(groups)


def test_triggered_clocks_follow_a_drift_of_many_frames() -> None:
    rng = np.random.default_rng(0)
    steps = np.arange(30 * 60 * 10)
    taken = EPOCH + steps * PERIOD
    kept = np.flatnonzero(rng.random(len(steps)) > 0.02)
    slow = taken[kept] + ((taken[kept] - EPOCH) * 200e-6).astype(np.int64) + rng.normal(0, 5e5, len(kept)).astype(int)
    timecodes = {"a": codes(taken), "b": codes(slow)}
    groups, report = align(timecodes, AlignOptions(reference="a", clock=ClockMode.TRIGGERED))
    b = groups.frames[:, 1]
    assert np.array_equal(b >= 0, np.isin(steps, kept))
    assert np.array_equal(kept[b[b >= 0]], steps[b >= 0])
    assert abs(report.clocks["b"].drift_ppm - 200) < 5 * report.clocks["b"].drift_error_ppm
    assert report.clocks["a"].state is ClockState.REFERENCE
    trusted, _ = align(timecodes, AlignOptions(reference="a"))
    wrong = trusted.frames[:, 1] >= 0
    assert (kept[trusted.frames[wrong, 1]] != steps[wrong]).mean() > 0.5  # what the correction is for


def test_a_tie_goes_to_the_earlier_frame() -> None:
    groups, _ = align({"a": codes([0, 100]), "b": codes([-50, 50])}, AlignOptions(reference="a", tolerance_ns=50))
    assert groups.frames[:, 1].tolist() == [0, 1]
    groups, _ = align({"a": codes([0]), "b": codes([-50, 50])}, AlignOptions(reference="a", tolerance_ns=50))
    assert groups.frames[0].tolist() == [0, 0]


def test_cameras_exactly_half_a_frame_apart_meet() -> None:
    times = np.arange(50) * 100
    for shift in (-50, 50):
        groups, _ = align({"a": codes(times), "b": codes(times + shift)}, AlignOptions(reference="a"))
        assert (groups.frames[1:, 1] >= 0).all()
        assert len(set(groups.frames[1:, 1].tolist())) == 49


def test_without_mutual_a_frame_may_serve_twice() -> None:
    timecodes = {"a": codes([0, 60, 120]), "b": codes([50])}
    options = AlignOptions(reference="a", tolerance_ns=70, mutual=False)
    assert align(timecodes, options)[0].frames[:, 1].tolist() == [0, 0, 0]
    assert align(timecodes, AlignOptions(reference="a", tolerance_ns=70))[0].frames[:, 1].tolist() == [-1, 0, -1]


def test_frame_numbers_are_those_of_the_video() -> None:
    timecodes = {"a": codes([0, 100, 200], [4, 5, 9]), "b": codes([0, 200, 100], [7, 8, 9])}
    groups, _ = align(timecodes, AlignOptions(reference="a", tolerance_ns=10))
    assert groups.frames.tolist() == [[4, 7], [5, 9], [9, 8]]


def test_the_default_tolerance_is_half_a_frame() -> None:
    times = EPOCH + np.arange(10) * 1000
    late = codes(np.append(times[:9] + 499, times[9] + 501))
    groups, report = align({"a": codes(times), "b": late}, AlignOptions(reference="a"))
    assert report.tolerance_ns == 500
    assert groups.frames[:, 1].tolist() == [*range(9), -1]


def test_a_long_recording_is_paired_as_its_trigger_fired() -> None:
    """Clocks are fitted to some of its frames, drift takes them over several periods."""
    rng = np.random.default_rng(5)
    taken = 10**18 + np.arange(60_000) * 11_111_111 + rng.normal(0, 2e5, 60_000)
    cameras = {}
    for camera, drift_ppm in {"a": 0, "b": 60, "c": -45}.items():
        stamped = taken + (taken - taken[0]) * drift_ppm * 1e-6 + rng.normal(0, 2e5, len(taken))
        there = np.flatnonzero(rng.random(len(taken)) > 0.002)
        cameras[camera] = Timecodes(times_ns=np.rint(stamped[there]).astype(np.int64), indices=there)
    groups, _ = align(cameras, AlignOptions(reference="a", clock=ClockMode.TRIGGERED))
    for column in range(3):
        there = groups.frames[:, column] >= 0
        assert there.mean() > 0.99
        assert np.array_equal(groups.frames[there, column], groups.frames[there, 0])


# The reference


def test_coverage_prefers_the_camera_that_ran_all_along() -> None:
    full = EPOCH + np.arange(100) * PERIOD
    times = {"late": full[20:], "gaps": full[np.arange(100) % 10 != 0], "full": full + 100, "short": full[:50]}
    assert choose_reference(times) == "full"


def test_coverage_prefers_no_camera_that_ran_alone() -> None:
    full = EPOCH + np.arange(100) * PERIOD
    alone = EPOCH + np.arange(-5000, 90) * PERIOD
    assert choose_reference({"alone": alone, "b": full, "c": full[1:]}) == "b"


def test_coverage_prefers_the_rate_of_the_many() -> None:
    full = EPOCH + np.arange(100) * PERIOD
    fast = EPOCH + np.arange(300) * (PERIOD // 3)
    slow = full[::3]
    assert choose_reference({"fast": fast, "slow": slow, "c": full, "d": full + 1000}) == "c"


def test_a_named_reference_is_used() -> None:
    timecodes, _ = rig(1)
    groups, report = align(timecodes, AlignOptions(reference="cam3"))
    assert groups.reference == "cam3"
    assert report.reference_named


# The report


def test_faults_in_a_file_are_counted() -> None:
    times = EPOCH + np.arange(60) * PERIOD
    broken = times.copy()
    broken[10] = broken[9]  # a duplicate
    broken[[20, 21]] = broken[[21, 20]]  # a reversal
    broken[30:] += 3 * PERIOD  # three frames lost (and three unmatched at the end)
    broken[50:] += 20 * PERIOD  # a pause
    groups, report = align({"a": codes(times), "b": codes(broken)}, AlignOptions(reference="a"))
    b = report.cameras[1]
    assert (b.lines, b.duplicates, b.reversals, b.jumps) == (60, 1, 1, 1)
    assert b.drops == 3 + 1  # the duplicate stands for a frame that has no time of its own
    assert b.matched == 30 - 1 + 20
    assert b.matched_share == b.matched / 60
    assert groups.frames[20:22, 1].tolist() == [21, 20]
    assert report.notes == (
        "b: 1 duplicate timecodes",
        "b: 1 reversed timecodes",
        "b: 1 pauses of more than 10 frame periods",
    )


def test_residuals_are_reported_on_trusted_clocks() -> None:
    times = EPOCH + np.arange(60) * PERIOD
    groups, report = align({"a": codes(times), "b": codes(times + 12_000_000)}, AlignOptions(reference="a"))
    b = report.cameras[1]
    assert (groups.residuals_ns[:, 1] == 12_000_000).all()
    assert b.residual_median_ns == b.residual_p95_ns == 12_000_000
    assert b.histogram[17] == 60  # 12 ms of 16.7 ms
    assert b.clock.state is ClockState.TRUSTED
    assert b.clock.offset_ns == pytest.approx(12_000_000)
    assert "+12.0 ms" in report.notes[0]


def test_a_single_camera_and_a_single_instant() -> None:
    groups, report = align({"a": codes([EPOCH])})
    assert groups.frames.tolist() == [[0]]
    assert report.complete == 1
    groups, _ = align({"a": codes([EPOCH]), "b": codes([EPOCH + 5])}, AlignOptions(tolerance_ns=10))
    assert groups.frames.tolist() == [[0, 0]]


# Errors


@pytest.mark.parametrize(
    ("timecodes", "options", "message"),
    [
        ({}, AlignOptions(), "at least one camera"),
        ({"a": codes([0, 10])}, AlignOptions(reference="c"), r"'c' must be one of \['a'\]"),
        ({"a": codes([0]), "b": codes([0])}, AlignOptions(), "give the tolerance"),
        ({"a": codes([0, 10]), "b": codes([10**9, 10**9 + 10])}, AlignOptions(), "do they share a clock"),
        ({"a": codes([0, 10], [-1, 0])}, AlignOptions(), "camera 'a': frame numbers must be 0"),
    ],
)
def test_bad_input_says_what_must_hold(timecodes: dict, options: AlignOptions, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        align(timecodes, options)


def test_options_check_themselves() -> None:
    assert AlignOptions(clock="triggered").clock is ClockMode.TRIGGERED
    with pytest.raises(ValueError, match="0 ns or more"):
        AlignOptions(tolerance_ns=-1)
    with pytest.raises(ValueError, match="ClockMode"):
        AlignOptions(clock="sundial")


# Files


@pytest.mark.parametrize("clock", list(ClockMode))
def test_groups_report_and_index_survive_saving(tmp_path: Path, clock: ClockMode) -> None:
    timecodes, _ = rig(7)
    groups, report = align(timecodes, AlignOptions(clock=clock))
    groups.save(tmp_path, report)
    save_index(timecodes, report.clocks, tmp_path)
    loaded = FrameGroups.load(tmp_path)
    assert (loaded.cameras, loaded.reference) == (groups.cameras, groups.reference)
    for name in ("times_ns", "frames", "residuals_ns"):
        assert np.array_equal(getattr(loaded, name), getattr(groups, name))
        assert getattr(loaded, name).dtype == getattr(groups, name).dtype
    assert SyncReport.load(tmp_path) == report
    index = load_index(tmp_path)
    for column, camera in enumerate(groups.cameras):
        frames, residuals = index[camera].nearest(groups.times_ns, report.tolerance_ns)
        there = groups.frames[:, column] >= 0
        assert np.array_equal(frames[there], groups.frames[there, column])
        assert np.array_equal(residuals[there], groups.residuals_ns[there, column])


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        timecodes, _ = rig(7)
        groups, report = align(timecodes, AlignOptions(clock=ClockMode.TRIGGERED))
        groups.save(tmp_path / name, report)
        save_index(timecodes, report.clocks, tmp_path / name)
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file())
    assert len(files) == 2 + 5
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_sync_json_is_small_and_holds_no_instants(tmp_path: Path) -> None:
    timecodes, _ = rig(1, steps=5000)
    groups, report = align(timecodes)
    groups.save(tmp_path, report)
    assert (tmp_path / "sync.json").stat().st_size < 8000
    data = json.loads((tmp_path / "sync.json").read_text())
    assert data["instants"] == len(groups)
    assert data["report"]["cameras"][0]["clock"]["state"] in ("trusted", "reference")


def test_wide_residuals_are_kept(tmp_path: Path) -> None:
    timecodes = {"a": codes([0, 10**10]), "b": codes([4 * 10**9, 12 * 10**9])}
    groups, _ = align(timecodes, AlignOptions(reference="a"))
    groups.save(tmp_path)
    assert FrameGroups.load(tmp_path).residuals_ns[:, 1].tolist() == [4 * 10**9, 2 * 10**9]


def test_missing_and_damaged_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="run sync first"):
        FrameGroups.load(tmp_path)
    with pytest.raises(FileNotFoundError, match="no frame index"):
        load_index(tmp_path)
    timecodes, _ = rig(1)
    groups, _ = align(timecodes)
    groups.save(tmp_path)
    with pytest.raises(ValueError, match="without a report"):
        SyncReport.load(tmp_path)
    table = (tmp_path / "groups.arrow").read_bytes()
    (tmp_path / "groups.arrow").write_bytes(table[: len(table) // 2])
    with pytest.raises(ValueError, match="damaged"):
        FrameGroups.load(tmp_path)
    align(rig(2)[0])[0].save(tmp_path / "other")
    (tmp_path / "groups.arrow").write_bytes((tmp_path / "other" / "groups.arrow").read_bytes())
    with pytest.raises(ValueError, match="does not belong"):
        FrameGroups.load(tmp_path)
    (tmp_path / "groups.arrow").unlink()
    with pytest.raises(FileNotFoundError, match=r"groups\.arrow is missing"):
        FrameGroups.load(tmp_path)
    (tmp_path / "sync.json").write_text('{"schema": 99}')
    with pytest.raises(ValueError, match="schema 1"):
        FrameGroups.load(tmp_path)
    (tmp_path / "sync.json").write_text("{")
    with pytest.raises(ValueError, match="damaged"):
        FrameGroups.load(tmp_path)


def test_groups_check_their_shapes() -> None:
    times = np.zeros(3, np.int64)
    with pytest.raises(ValueError, match="3 instants of 2 cameras"):
        FrameGroups(("a", "b"), "a", times, np.zeros((3, 1), np.int32), np.zeros((3, 2), np.int64))
    with pytest.raises(ValueError, match="'c' must be one of"):
        FrameGroups(("a",), "c", times, np.zeros((3, 1), np.int32), np.zeros((3, 1), np.int64))


def test_a_clock_that_stood_still_is_named():
    still = Timecodes(np.full(20, 5_000, np.int64), np.arange(20))
    moving = Timecodes(np.arange(20) * 33_000_000, np.arange(20))
    with pytest.raises(
        ValueError, match=r"^b must have a timecode for each frame, but all lines .* 5000 ns: its clock"
    ):
        align({"a": moving, "b": still, "c": moving})
