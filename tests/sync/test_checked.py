"""Time is checked, not believed: every way to write times, counters and days that start over, units, drift."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sync.align import AlignOptions, SyncReport, align
from sync.capture import find_capture, load_timecodes, probe_capture
from sync.probe import container_timecodes, probe_video
from sync.timecode import Timecodes, frame_to_label, label_to_frame, read_timecodes, together
from sync.timecode.series import CYCLES, DAY_NS, unwrapped
from tests.sync.test_capture import make_capture, make_info
from tests.sync.test_probe import make_video

EPOCH_NS = 1_770_000_000_000_000_000
PERIOD_NS = 33_333_333


def codes(times: np.ndarray, cycle: int = 0) -> Timecodes:
    times = np.asarray(times, np.int64)
    return Timecodes(times, np.arange(len(times), dtype=np.int64), cycle)


# Ways to write the same times

TIMES = EPOCH_NS + 1000 * np.array([0, 33_333, 66_667, 133_333], np.int64)  # ns, whole microseconds
SECONDS = [f"{time // 10**9}.{time % 10**9:09}" for time in TIMES.tolist()]
ISO = [f"{np.datetime64(time, 'ns')}" for time in TIMES.tolist()]
WRITTEN = {
    "a.tsv": "timestamp_ns\n" + "\n".join(map(str, TIMES.tolist())) + "\n",
    "exponent.csv": "time_s\n" + "\n".join(f"{int(time)}e-9" for time in TIMES) + "\n",
    "comma.csv": "frame;time_s\n" + "\n".join(f"{k};{s.replace('.', ',')}" for k, s in enumerate(SECONDS)) + "\n",
    "plain.txt": "\n".join(SECONDS) + "\n",
    "comma.txt": "\n".join(second.replace(".", ",") for second in SECONDS) + "\n",
    "counted.log": "# frame time\n" + "\n".join(f"{k} {second}" for k, second in enumerate(SECONDS)) + "\n",
    "tum.txt": "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(f"{second} 0 0 0 0 0 0 1" for second in SECONDS) + "\n",
    "epoch.txt": "\n".join(str(time // 1000) for time in TIMES.tolist()) + "\n",
    "iso.txt": "\n".join(ISO) + "\n",
    "zone.csv": "timestamp\n" + "\n".join(f"{i.replace('T', ' ')}+00:00" for i in ISO) + "\n",
    "list.json": json.dumps(TIMES.tolist()),
    "rows.json": json.dumps([[k, time] for k, time in enumerate(TIMES.tolist())]),
    "columns.json": json.dumps({"frame": list(range(4)), "timestamp_ns": TIMES.tolist()}),
    "dates.json": json.dumps(ISO),
}


@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_the_same_times_are_read_however_they_are_written(tmp_path: Path, name: str, encoding: str) -> None:
    (tmp_path / name).write_text(WRITTEN[name], encoding=encoding)
    assert read_timecodes(tmp_path / name).times_ns.tolist() == TIMES.tolist()


def test_arrays_and_milliseconds_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "whole.npy", TIMES)
    np.save(tmp_path / "dates.npy", TIMES.view("datetime64[ns]"))
    for name in ("whole.npy", "dates.npy"):
        assert read_timecodes(tmp_path / name).times_ns.tolist() == TIMES.tolist()
    np.save(tmp_path / "floats.npy", np.array([0.5, 1.0, 1.25]))
    assert read_timecodes(tmp_path / "floats.npy").times_ns.tolist() == [500_000_000, 10**9, 1_250_000_000]
    np.save(tmp_path / "table.npy", np.zeros((2, 2)))
    with pytest.raises(ValueError, match="2 columns and no header; say which"):
        read_timecodes(tmp_path / "table.npy")
    (tmp_path / "v2.txt").write_text("# timecode format v2\n0\n33.366667\n66.733333\n")
    assert read_timecodes(tmp_path / "v2.txt").times_ns.tolist() == [0, 33_366_667, 66_733_333]


def test_a_column_without_a_name_is_taken_by_its_number(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("7,1.5\n7,1.6\n")
    with pytest.raises(ValueError, match="timecode_column = '1'"):
        read_timecodes(path)
    assert read_timecodes(path, column="2").times_ns.tolist() == [1_500_000_000, 1_600_000_000]
    with pytest.raises(ValueError, match="1 to 2, but is '3'"):
        read_timecodes(path, column="3")


WHATEVER = st.text(alphabet="0123456789.,;:-+eET#Z \t\nfrm_a", max_size=60)


@given(WHATEVER, st.sampled_from([".txt", ".csv", ".json", ".log"]))
def test_no_text_is_more_than_refused(tmp_path_factory: pytest.TempPathFactory, text: str, suffix: str) -> None:
    path, problem = tmp_path_factory.mktemp("any") / f"a{suffix}", ""
    path.write_text(text)
    try:
        read_timecodes(path, rate=Fraction(30), period_ns=PERIOD_NS)
    except ValueError as error:
        problem = str(error)
    assert not problem or str(path) in problem


def test_a_file_with_another_ending_is_never_passed_over(tmp_path: Path) -> None:
    videos = ("videos/cam1.mp4", "videos/cam2.mp4")
    for name in ("cam1.dat", "times.bin"):
        with pytest.raises(ValueError, match=f"but .*{name} does not"):
            find_capture(make_capture(tmp_path / name, *videos, f"timecodes/{name}"))
    assert find_capture(make_capture(tmp_path / "notes", *videos, "timecodes/README.md")).timecodes == {}


# Units


@pytest.mark.parametrize("power", [0, 3, 6, 9])
def test_where_nothing_names_the_unit_the_frame_rate_tells(tmp_path: Path, power: int) -> None:
    path = tmp_path / "a.csv"
    rows = (f"{k},{(1000 + 33.5 * k) * 10.0 ** (6 - power):.6f}" for k in range(9))
    path.write_text("frame,timestamp\n" + "\n".join(rows))
    found = read_timecodes(path, period_ns=PERIOD_NS)
    assert np.diff(found.times_ns).tolist() == [33_500_000] * 8


def test_a_named_unit_that_the_video_refutes_is_refused_and_another_rate_is_said(tmp_path: Path) -> None:
    folder = make_capture(tmp_path, "videos/a.mp4", "videos/b.mp4", "timecodes/a.csv", "timecodes/b.csv")
    capture, infos = find_capture(folder), {"a": make_info(5), "b": make_info(5)}  # 40 ms apart

    def write(step: float) -> None:
        for name in ("a", "b"):
            lines = "\n".join(f"{k * step:.6f}" for k in range(5))
            (folder / f"timecodes/{name}.csv").write_text(f"time_s\n{lines}\n")

    write(40.0)
    with pytest.raises(ValueError, match="so the unit is another; name the right one"):
        load_timecodes(capture, infos)
    write(0.08)
    assert "80 ms apart, the frames of its video 40 ms" in load_timecodes(capture, infos)["a"].notes[0]
    write(0.04)
    found = load_timecodes(capture, infos)["a"]
    assert (found.notes, found.source) == ((), "timecodes/a.csv")


@pytest.mark.parametrize("lost", [1, 5, 12])
def test_a_last_row_without_its_digits_is_refused(tmp_path: Path, lost: int) -> None:
    path = tmp_path / "a.csv"
    path.write_text(("timestamp_ns\n" + "\n".join(str(EPOCH_NS + k * PERIOD_NS) for k in range(9)))[:-lost])
    with pytest.raises(ValueError, match=r"line 10 .* the last line is cut short"):
        read_timecodes(path)


def test_a_last_row_without_a_line_break_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time_s\n" + "\n".join(f"{k * 0.5:g}" for k in range(9)))
    assert len(read_timecodes(path)) == 9


# What starts over


@given(
    st.sampled_from([cycle * unit for cycle in CYCLES[2:6] for unit in (1000, 1_000_000)] + [DAY_NS]),
    st.integers(1, 199),
    st.integers(2, 3),
)
def test_a_counter_that_starts_over_is_carried_on(cycle: int, ahead: int, turns: int) -> None:
    """Unwrapping undoes wrapping, up to whole turns, wherever in a recording the counter starts over."""
    unit = 1000 if cycle % 1000 == 0 and cycle != DAY_NS else 1
    unit = 1_000_000 if cycle % 1_000_000 == 0 and cycle // 1_000_000 in CYCLES else unit
    period = cycle // 200 // unit * unit
    times = np.arange(200 * (turns - 1) + 1, dtype=np.int64) * period + (cycle - ahead * period)
    found, seen, count = unwrapped(times % cycle, unit)
    assert seen == cycle
    assert count == len(np.flatnonzero(np.diff(times // cycle)))
    assert np.array_equal(np.diff(found), np.diff(times))


@pytest.mark.parametrize("seconds", [60, 128, 3600, 7 * 86_400])
def test_a_clock_without_its_hours_is_carried_on(seconds: int) -> None:
    cycle = seconds * 10**9
    times = cycle - 30 * PERIOD_NS + np.arange(60, dtype=np.int64) * PERIOD_NS
    found, seen, count = unwrapped(times % cycle, 1)
    assert (seen, count) == (cycle, 1)
    assert np.array_equal(found, times)


def test_a_clock_that_was_set_back_is_left_alone() -> None:
    """By a minute, beyond which it had counted before: no counter of minutes does."""
    times = EPOCH_NS + np.arange(60, dtype=np.int64) * PERIOD_NS
    times[30:] -= 60 * 10**9
    found, *turns = unwrapped(times, 1)
    assert turns == [0, 0]
    assert np.array_equal(found, times)


@given(st.lists(st.integers(0, 10**12), min_size=2, max_size=40, unique=True), st.sampled_from([1, 1000, 10**6]))
def test_times_that_go_forward_are_left_alone(times: list[int], unit: int) -> None:
    ordered = np.array(sorted(times), np.int64) * unit
    found, cycle, count = unwrapped(ordered, unit)
    assert np.array_equal(found, ordered)
    assert (cycle, count) == (0, 0)


@given(st.lists(st.integers(0, 20 * 60 * 10**9), min_size=1, max_size=6), st.integers(0, DAY_NS))
def test_cameras_on_both_sides_of_midnight_lie_as_they_were_taken(starts: list[int], evening: int) -> None:
    times = {str(number): np.array([evening + start], np.int64) for number, start in enumerate(starts)}
    found = together({name: codes(own % DAY_NS, DAY_NS) for name, own in times.items()})
    shift = {int(found[name].times_ns[0] - own[0]) for name, own in times.items()}
    assert len(shift) == 1, "all are moved alike"
    assert shift.pop() % DAY_NS == 0


def test_labels_before_and_after_midnight_are_matched(tmp_path: Path) -> None:
    rate = Fraction(30)
    videos = [make_video(tmp_path / f"videos/{name}.mp4", 20, metadata={"timecode": label})
              for name, label in (("a", "23:59:59:25"), ("b", "00:00:00:02"))
              if (tmp_path / "videos").mkdir(exist_ok=True) is None]  # fmt: skip
    infos = {path.stem: probe_video(path) for path in videos}
    groups, report = align(load_timecodes(find_capture(tmp_path), infos), AlignOptions(reference="a"))
    assert groups.frames[7].tolist() == [7, 0]
    assert report.complete == 13
    assert any("starts over" in note or "start over" in note for note in report.notes)
    assert label_to_frame(frame_to_label(5, rate), rate) == 5


def test_a_time_of_day_with_decimals_is_no_label(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("23:59:59.980\n00:00:00.013333\n")
    found = read_timecodes(path)
    assert found.times_ns.tolist() == [86_399_980_000_000, 86_400_013_333_000]
    assert found.cycle_ns == DAY_NS


def test_labels_of_two_kinds_are_said() -> None:
    found = together({"a": codes([0, 1], DAY_NS), "b": codes([0, 1], DAY_NS), "c": codes([0, 1], DAY_NS - 86_400_000)})
    assert "drop-frame" in found["c"].notes[0]
    assert found["a"].notes == ()


def test_labels_of_two_kinds_are_said_where_they_lie_apart() -> None:
    """Drop-frame labels of 10 o'clock are 36 s from others of 29.97 frames."""
    times = 36_000 * 10**9 + np.arange(20, dtype=np.int64) * PERIOD_NS
    found = together({"a": codes(times, DAY_NS - 86_400_000), "b": codes(times + 36 * 10**9, DAY_NS + 86_400_000)})
    with pytest.raises(ValueError, match=r"an epoch and a unit\? b: its times start over .* drop-frame and the others"):
        align(found)


# Containers


@pytest.mark.parametrize("suffix", ["mkv", "mov", "mp4"])
def test_a_label_is_found_whatever_the_container_calls_it(tmp_path: Path, suffix: str) -> None:
    info = probe_video(make_video(tmp_path / f"a.{suffix}", metadata={"timecode": "10:00:00:07"}))
    assert info.start_label == "10:00:00:07"
    assert container_timecodes(info).times_ns[0] == (36_000 * 30 + 7) * 10**9 // 30


def test_a_label_counts_at_its_tracks_own_rate(tmp_path: Path) -> None:
    """FFmpeg writes the track at the video's rate; cameras that film 50 frames count 25 labels."""
    path = make_video(tmp_path / "a.mov", rate=Fraction(50), metadata={"timecode": "10:00:00:20"})
    data = path.read_bytes()
    place = data.index(b"tmcd", data.index(b"stsd", data.rindex(b"tmcd") - 200)) + 4 + 6 + 2 + 4 + 4
    scale = int.from_bytes(data[place : place + 4], "big")
    assert Fraction(scale, int.from_bytes(data[place + 4 : place + 8], "big")) == 50
    half = (scale // 25).to_bytes(4, "big") + (25).to_bytes(1, "big")
    path.write_bytes(data[: place + 4] + half + data[place + 9 :])
    info = probe_video(path)
    assert (info.label_rate, info.rate) == (25, 50)
    assert container_timecodes(info).times_ns[0] == (36_000 * 50 + 20) * 10**9 // 25, "the track counts from midnight"


def test_times_that_begin_at_0_wherever_a_recording_began_are_said(tmp_path: Path) -> None:
    info = probe_video(make_video(tmp_path / "a.mp4"))
    _, report = align({name: container_timecodes(info) for name in "ab"})
    assert report.notes[0].startswith("times of a, b are those of the containers")
    assert SyncReport.from_json(json.loads(json.dumps(report.to_json()))) == report


def test_labels_that_nobody_set_tell_no_start(tmp_path: Path) -> None:
    """Of all cameras 00:00:00:00 is where each began; beside another label it is midnight."""

    def noted(**labels: str) -> str:
        for name, label in labels.items():
            make_video(tmp_path / "videos" / f"{name}.mov", metadata={"timecode": label})
        capture = find_capture(tmp_path)
        _, report = align(load_timecodes(capture, probe_capture(capture)))
        return " ".join(report.notes)

    (tmp_path / "videos").mkdir()
    assert noted(a="00:00:00:00", b="00:00:00:00").startswith("times of a, b are those of the containers")
    assert "those of the containers" not in noted(a="00:00:00:00", b="00:00:00:01")
    assert "those of the containers" not in noted(a="10:00:00:00", b="10:00:00:00")


# Clocks and instants


@pytest.mark.parametrize(
    ("ppm", "seconds", "said"), [(30, 900, True), (-20, 900, True), (2, 900, False), (30, 20, False)]
)
def test_a_drift_that_makes_pairs_wrong_is_said(ppm: float, seconds: float, said: bool) -> None:
    rng = np.random.default_rng(1)
    ticks = np.arange(int(30 * seconds), dtype=np.int64) * PERIOD_NS
    noise = rng.normal(0, 2e5, (2, len(ticks))).astype(np.int64)
    timecodes = {
        "a": codes(EPOCH_NS + ticks + noise[0]),
        "b": codes(EPOCH_NS + ticks + np.rint(ppm * 1e-6 * ticks).astype(np.int64) + noise[1]),
    }
    _, report = align(timecodes, AlignOptions(reference="a"))
    found = [note for note in report.notes if "drift" in note]
    assert bool(found) == said
    if said:
        assert found[0].startswith(f"b: its frames drift by {ppm:+.1f} ppm")
        assert SyncReport.from_json(json.loads(json.dumps(report.to_json()))) == report
    assert not any("drift" in note for note in align(timecodes, AlignOptions("a", clock="triggered"))[1].notes)  # type: ignore[arg-type]  # options take text


def test_no_complete_instant_is_an_error() -> None:
    times = np.arange(10) * PERIOD_NS
    with pytest.raises(ValueError, match=r"no instant has a frame of every camera .* c has one at 0 of 10"):
        align({"a": codes(times), "b": codes(times), "c": codes(times + 10**12)}, AlignOptions(reference="a"))


# Found by trying


def labelled(rate: int, count: int, start: int = 3000) -> str:
    return "\n".join(frame_to_label(start + k, Fraction(rate)) for k in range(count)) + "\n"


def test_labels_count_at_the_rate_of_their_own_video(tmp_path: Path) -> None:
    """One of 25 beside one of 30, both from 00:01:40:00 on."""
    folder = make_capture(tmp_path, "videos/a.mp4", "videos/b.mp4")
    (folder / "timecodes").mkdir()
    (folder / "timecodes/a.txt").write_text(labelled(30, 60, 3000))
    (folder / "timecodes/b.txt").write_text(labelled(25, 50, 2500))
    (folder / "capture.toml").write_text("fps = 30\n")
    infos = {
        name: replace(make_info(count), rate=Fraction(rate), pts_ns=np.arange(count) * 10**9 // rate)
        for name, count, rate in (("a", 60, 30), ("b", 50, 25))
    }
    found = load_timecodes(find_capture(folder), infos)
    for name, rate in (("a", 30), ("b", 25)):
        assert found[name].times_ns[rate] - found[name].times_ns[0] == 10**9
    assert found["a"].times_ns[0] == found["b"].times_ns[0] == 100 * 10**9
    assert found["a"].notes == ()
    assert "counted at 25 per second" in found["b"].notes[0]


@pytest.mark.parametrize(("rate", "said"), [(25, True), (24, True), (30, False)])
def test_labels_that_start_each_second_early_are_said(tmp_path: Path, rate: int, said: bool) -> None:
    (tmp_path / "a.txt").write_text(labelled(rate, 90))
    (tmp_path / "b.csv").write_text("timecode\n" + labelled(rate, 90))
    for name in ("a.txt", "b.csv"):
        notes = read_timecodes(tmp_path / name, rate=Fraction(30)).notes
        assert bool(notes) == said
        assert not said or f"end each second at :{rate - 1}" in notes[0]


def test_rows_in_another_order_are_put_in_that_of_their_index(tmp_path: Path) -> None:
    rows = [f"{k},{k * PERIOD_NS}" for k in range(9)]
    (tmp_path / "a.csv").write_text("frame,time_ns\n" + "\n".join(rows[::-1]) + "\n")
    found = read_timecodes(tmp_path / "a.csv")
    assert found.times_ns.tolist() == [k * PERIOD_NS for k in range(9)]
    assert found.indices.tolist() == list(range(9))


@pytest.mark.parametrize("suffix", ["csv", "txt"])
def test_a_last_row_that_lost_digits_before_its_line_break_is_refused(tmp_path: Path, suffix: str) -> None:
    rows = [str(EPOCH_NS // 1000 + k * 33_333) for k in range(9)]
    text = ("time_us\n" if suffix == "csv" else "") + "\n".join([*rows[:-1], rows[-1][:-3]]) + "\n"
    (tmp_path / f"a.{suffix}").write_text(text)
    with pytest.raises(ValueError, match="the last line is cut short"):
        read_timecodes(tmp_path / f"a.{suffix}")


def test_odd_ways_to_write_times(tmp_path: Path) -> None:
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="is no JSON"):
        read_timecodes(tmp_path / "deep.json")
    (tmp_path / "clock.txt").write_text("23:59:59,700\n00:00:00,033\n")
    assert np.diff(read_timecodes(tmp_path / "clock.txt").times_ns).tolist() == [333_000_000]
    (tmp_path / "zone.txt").write_text("2026-11-28T12:00:00.5+01\n2026-11-28T11:00:00.6Z\n")
    assert np.diff(read_timecodes(tmp_path / "zone.txt").times_ns).tolist() == [100_000_000]
    for encoding in ("utf-16-le", "utf-16-be"):
        (tmp_path / "wide.csv").write_bytes("time_s\n1.5\n1.6\n".encode(encoding))
        assert read_timecodes(tmp_path / "wide.csv").times_ns.tolist() == [1_500_000_000, 1_600_000_000]
