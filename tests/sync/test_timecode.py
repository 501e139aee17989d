"""Timecodes from text: exactness, every format, and messages that name the line."""

import doctest
import json
from decimal import ROUND_HALF_UP, Decimal
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sync.timecode.labels
import sync.timecode.rates
import sync.timecode.read
from sync.timecode import (
    Timecodes,
    frame_numbers,
    frame_to_label,
    frames_per_day,
    frames_to_ns,
    label_to_frame,
    labels_to_ns,
    parse_rate,
    read_shared_timecodes,
    read_timecodes,
    ticks_to_ns,
)

NTSC = [Fraction(30000, 1001), Fraction(60000, 1001), Fraction(120000, 1001)]
EPOCH_US = 1734551081929245


def write(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def rig_lines(times_us: list[int], first: int = 0) -> str:
    return "".join(f"frame_{time}_{first + number:012d}\n" for number, time in enumerate(times_us))


def columns(path: Path, **options: object) -> tuple[list[int], list[int]]:
    codes = read_timecodes(path, **options)
    return codes.times_ns.tolist(), codes.indices.tolist()


# The rig's text


@given(st.integers(0, 10**15), st.lists(st.integers(-(10**6), 10**7), max_size=30), st.integers(0, 10**11))
def test_rig_text_round_trips(
    tmp_path_factory: pytest.TempPathFactory, start: int, gaps: list[int], first: int
) -> None:
    times = [abs(int(time)) for time in np.cumsum([start, *gaps])]
    path = write(tmp_path_factory.mktemp("rig") / "a.txt", rig_lines(times, first))
    gaps_us = [abs(gap) for gap in np.diff(times) if gap]
    if gaps_us and np.median(gaps_us) < 10:
        with pytest.raises(ValueError, match="the unit is another"):
            read_timecodes(path)
    else:
        codes, written = read_timecodes(path), np.array(times) * 1000
        assert codes.indices.tolist() == list(range(len(times)))
        off = codes.times_ns - written
        if codes.cycle_ns:  # a step back that a counter makes when it is full
            assert codes.notes
            off %= codes.cycle_ns
        assert not off.any()


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("tail", ["", "END", "END\n\n"])
def test_line_endings_and_a_trailing_blank_line_do_not_matter(tmp_path: Path, ending: str, tail: str) -> None:
    lines = rig_lines([EPOCH_US, EPOCH_US + 20000]).replace("\n", ending)
    text = lines.rstrip() if tail == "" else lines + tail.removeprefix("END")
    assert columns(write(tmp_path / "a.txt", text))[0] == [EPOCH_US * 1000, EPOCH_US * 1000 + 20_000_000]


@pytest.mark.parametrize(
    "bad",
    [
        "",
        "frame_",
        "frame_1734551081929245",
        "frame_1734551081929245_",
        "frame_1734551081929245_00000000012",  # 11 digits: cut short by a crash
        "frame_1734551081929245_0000000000012",  # 13 digits
        "frame_17345510819292x5_000000000001",
        "frame_17345510819292450_000000000001",
        "Frame_1734551081929245_000000000001",
        "frame_-734551081929245_000000000001",
        "frame_1734551081929245_000000000001 ",
        "frame__000000000001",
        "frame_9999999999999999_000000000001",  # beyond the limit of times
    ],
)
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_malformed_line_is_named(tmp_path: Path, bad: str, place: int) -> None:
    lines = rig_lines([EPOCH_US, EPOCH_US + 20000, EPOCH_US + 40000]).splitlines()
    lines.insert(place, bad)
    with pytest.raises(ValueError, match=rf"a\.txt, line {place + 1}: expected .*got '{bad.rstrip()}'"):
        read_timecodes(write(tmp_path / "a.txt", "\n".join(lines)))


@pytest.mark.parametrize("length", range(1, 35))
def test_a_last_line_cut_short_is_noticed(tmp_path: Path, length: int) -> None:
    line = rig_lines([EPOCH_US]).strip()
    with pytest.raises(ValueError, match="line 2"):
        read_timecodes(write(tmp_path / "a.txt", line + "\n" + line[:length]))


def test_an_index_that_starts_over_numbers_nothing(tmp_path: Path) -> None:
    text = rig_lines([EPOCH_US, EPOCH_US + 20000], 70) + rig_lines([EPOCH_US + 40000, EPOCH_US + 60000], 0)
    assert columns(write(tmp_path / "a.txt", text))[1] == [0, 1, 2, 3]


def test_an_index_with_gaps_is_kept(tmp_path: Path) -> None:
    text = rig_lines([EPOCH_US], 70) + rig_lines([EPOCH_US + 40000], 72)
    assert columns(write(tmp_path / "a.txt", text))[1] == [0, 2]


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".json"])
@pytest.mark.parametrize("content", ["", "\n\n", "\ufeff"])
def test_an_empty_file_is_refused(tmp_path: Path, suffix: str, content: str) -> None:
    with pytest.raises(ValueError, match="is empty"):
        read_timecodes(write(tmp_path / f"a{suffix}", content))


def test_missing_files_and_other_suffixes(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_timecodes(tmp_path / "a.txt")
    with pytest.raises(ValueError, match=r"\.csv, \.tsv, \.txt, \.log, \.json, \.jsonl or \.npy"):
        read_timecodes(write(tmp_path / "a.dat", "1"))


# Tables


@given(st.decimals(-4 * 10**9, 4 * 10**9, places=13) | st.decimals(-4, 4, places=25))
def test_decimal_seconds_are_exact(tmp_path_factory: pytest.TempPathFactory, seconds: Decimal) -> None:
    path = write(tmp_path_factory.mktemp("csv") / "a.csv", f"time_s\n{seconds:f}\n")
    expected = int(seconds.scaleb(9).quantize(Decimal(1), ROUND_HALF_UP))
    assert columns(path)[0] == [expected]


@given(st.integers(-(10**18), 10**18), st.integers(-30, 30))
def test_scientific_notation_is_exact(tmp_path_factory: pytest.TempPathFactory, digits: int, power: int) -> None:
    path = write(tmp_path_factory.mktemp("csv") / "a.csv", f"time_ns\n{digits}e{power}\n")
    size = Fraction(abs(digits)) * Fraction(10) ** power
    rounded = int(size + Fraction(1, 2))  # half away from zero
    if rounded >= 2**62:
        with pytest.raises(ValueError, match="expected a number"):
            read_timecodes(path)
    else:
        assert columns(path)[0] == [rounded if digits > 0 else -rounded]


@pytest.mark.parametrize(
    ("header", "value", "nanoseconds"),
    [
        ("device_timestamp_ns", "1770341767841840901", 1770341767841840901),
        ("timestamp_us", "1770341767841840.9014", 1770341767841840901),
        ("Timestamp [ms]", "1770341767841.840901", 1770341767841840901),
        ("time (s)", "1770341767.8418409006", 1770341767841840901),
        ("Time [\u00b5s]", "1770341767841840.9014", 1770341767841840901),
        ("Time (\u03bcs)", "1770341767841840.9014", 1770341767841840901),
        ("Time (\u00b5s)".encode("latin-1"), "1770341767841840.9014", 1770341767841840901),
        ("frame_time", "25.000978699999997", 25000978700),
        ("frame_time", "25", 25000000000),
        ("timestamp", "25.000978699999997", 25000978700),
        ("timestamp", "1770341767", 1770341767000000000),
        ("timestamp", "1753507730865", 1753507730865000000),
        ("timestamp", "1753507730865123", 1753507730865123000),
        ("timestamp", "1770341767841840901", 1770341767841840901),
        ("pts_milliseconds", "-0.0000005", -1),
        ("cam_timestamp", "5e-05", None),
    ],
)
def test_units(tmp_path: Path, header: str | bytes, value: str, nanoseconds: int | None) -> None:
    path = tmp_path / "a.csv"
    name = header if isinstance(header, bytes) else header.encode()
    path.write_bytes(b"frame_number," + name + f"\n00001,{value}\n".encode())
    if nanoseconds is None:
        with pytest.raises(ValueError, match="unit of column 'cam_timestamp' is open"):
            read_timecodes(path)
    else:
        assert columns(path) == ([nanoseconds], [0])


@pytest.mark.parametrize("delimiter", [",", ";", "\t", ", "])
def test_delimiters_quotes_and_byte_order_marks(tmp_path: Path, delimiter: str) -> None:
    rows = [["frame_number", '"timestamp_ns"'], ["00001", "1000000000"], ["00002", "1033333333"]]
    text = "\ufeff" + "\r\n".join(delimiter.join(row) for row in rows) + "\r\n\r\n"
    assert columns(write(tmp_path / "a.csv", text)) == ([1000000000, 1033333333], [0, 1])


def test_comments_may_stand_before_the_header(tmp_path: Path) -> None:
    text = "# recorder 1.2\n\n#take 3\nframe,time_s\n7,1.0\n8,1.1\n"
    assert columns(write(tmp_path / "a.csv", text)) == ([1_000_000_000, 1_100_000_000], [0, 1])
    with pytest.raises(ValueError, match=r"a\.csv, line 6 \('8,x'\): expected a number"):
        read_timecodes(write(tmp_path / "a.csv", text.replace("1.1", "x")))


@pytest.mark.parametrize("head", ["", "# frame,time\n"])
def test_numbers_with_exponents_are_no_header(tmp_path: Path, head: str) -> None:
    """As `numpy.savetxt` writes them."""
    rows = "".join(f"{k:.18e},{1 + k / 10:.18e}\n" for k in range(3))
    assert columns(write(tmp_path / "a.csv", head + rows))[0] == [1_000_000_000, 1_100_000_000, 1_200_000_000]


def test_rows_that_name_another_camera_are_said(tmp_path: Path) -> None:
    path = write(tmp_path / "cam1.csv", "camera,time_s\ncam2,1.0\ncam2,1.1\n")
    (note,) = read_timecodes(path, camera="cam1", others=["cam1", "cam2"]).notes
    assert note == "the rows of cam1.csv say that they are those of cam2; they are taken for cam1's"
    assert not read_timecodes(path, camera="cam1", others=["cam1", "2"]).notes
    assert not read_timecodes(path, camera="cam2", others=["cam1", "cam2"]).notes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2\n3,4\n", "2 columns and no header"),
        ("frame_number,time_s\n", "no rows"),
        ("frame_number,speed\n0,1\n", "one column must hold the time.*none"),
        ("time_s,arrival_time_s\n0,1\n", "2 of them"),
        ("time_s,time_s\n0,1\n", "two columns bear one name"),
        ("frame_number,timestamp\n0,12345\n", "unit of column 'timestamp' is open"),
        ("frame_number,time_s\n0,1\n1\n", "no table of 2 columns"),
        ("frame_number,time_s\n0,1.0\n\n1,abc\n", r"a\.csv, line 4 \('1,abc'\): expected a number in column 'time_s'"),
        ("frame_number,time_s\n0,1.0\n1,\n", "line 3 .* expected a number"),
        ("frame_number,time_s\n0,1.0\n1,1e5000\n", "line 3 .* expected a number"),
        ("frame_number,time_s\n0,1.0\n1,1.0.0\n", "line 3 .* expected a number"),
        ("frame_number,time_s\n0,1.0\n1.5,1.1\n", "line 3 .* expected a whole number in column 'frame_number'"),
        ("frame_number,time_ns\n0,0\n1,33\n2,66\n", "33 ns apart, so the unit is another"),
        ("frame_number,time_s\n0,0\n1,33333\n2,66666\n", "so the unit is another"),
    ],
)
def test_bad_tables_say_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_timecodes(write(tmp_path / "a.csv", text))


def test_the_time_column_can_be_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "pts_ns,arrival_ts_ns\n0,5\n20000000,30000005\n")
    assert columns(path, column="arrival_ts_ns")[0] == [5, 30000005]
    with pytest.raises(ValueError, match="no column 'other'"):
        read_timecodes(path, column="other")


CALISCOPE = "sync_index,port,frame_index,frame_time\n0,2,11,1.5\n0,1,5,1.50000001\n1,1,6,1.6\n1,2,10,1.4\n"


@pytest.mark.parametrize("unit", ["us", "\u00b5s", "\u03bcs"])
def test_columns_of_cameras_may_name_microseconds(tmp_path: Path, unit: str) -> None:
    path = write(tmp_path / "t.csv", f"cam1 [{unit}],cam2 [{unit}]\n0,33333\n33333,66666\n")
    found = read_shared_timecodes(path, ["cam1", "cam2"])
    assert found["cam2"].times_ns.tolist() == [33_333_000, 66_666_000]


def test_shared_tables_are_split_by_camera_and_ordered_by_frame_index(tmp_path: Path) -> None:
    path = write(tmp_path / "timestamps.csv", CALISCOPE)
    found = read_shared_timecodes(path, ["cam_1", "cam_2"])
    assert found["cam_1"].times_ns.tolist() == [1500000010, 1600000000]
    assert found["cam_2"].times_ns.tolist() == [1400000000, 1500000000]
    assert found["cam_2"].indices.tolist() == [0, 1]
    assert columns(path, camera="2")[0] == [1400000000, 1500000000]


def test_shared_tables_without_an_index_are_ordered_by_time(tmp_path: Path) -> None:
    path = write(tmp_path / "timestamps.csv", "cam_id,frame_time\nleft,1.2\nright,1.0\nleft,1.1\n")
    found = read_shared_timecodes(path, ["left", "right"])
    assert found["left"].times_ns.tolist() == [1100000000, 1200000000]


def test_shared_tables_must_tell_cameras_apart(tmp_path: Path) -> None:
    path = write(tmp_path / "timestamps.csv", CALISCOPE)
    with pytest.raises(ValueError, match="holds cameras"):
        read_timecodes(path)
    with pytest.raises(ValueError, match=r"camera 'cam_3' must be one of the table's cameras \['1', '2'\]"):
        read_shared_timecodes(path, ["cam_1", "cam_3"])
    with pytest.raises(ValueError, match=r"would serve cameras \['left1', 'right1'\]"):
        read_shared_timecodes(path, ["left1", "right1"])
    with pytest.raises(ValueError, match="one of its columns must be"):
        read_shared_timecodes(write(tmp_path / "b.csv", "time_s\n1\n"), ["a", "b"])


@pytest.mark.parametrize("names", ["left,right", "left_ms,right [ms]"])
def test_a_shared_table_may_have_a_column_for_each_camera(tmp_path: Path, names: str) -> None:
    path = write(tmp_path / "t.csv", f"frame,{names}\n7,100,\n8,133,130\n9,167,163\n")
    found = read_shared_timecodes(path, ["left", "right"], period_ns=dict.fromkeys(["left", "right"], 33_333_333))
    assert found["left"].times_ns.tolist() == [100_000_000, 133_000_000, 167_000_000]
    assert found["right"].times_ns.tolist() == [130_000_000, 163_000_000]
    assert found["left"].indices.tolist() == [0, 1, 2]
    assert found["right"].indices.tolist() == [0, 1]
    with pytest.raises(ValueError, match="camera 'other' must be one of"):
        read_shared_timecodes(path, ["left", "other"])


@pytest.mark.parametrize("kind", ["columns", "floats", "array", "objects", "nested", "lines", "by number"])
def test_a_count_beside_the_times_is_no_time(tmp_path: Path, kind: str) -> None:
    """Of 0.25, 0.28, 0.34 s, frames 0, 1 and 3 in all the ways in which people write them."""
    frames, times = [0, 1, 2, 4], [0.25, 0.28125, 0.3125, 0.375]
    both = np.stack([frames, times], axis=1)
    rows = [{"frame": frame, "time_s": time} for frame, time in zip(frames, times, strict=True)]
    path = tmp_path / {"array": "t.npy", "columns": "t.csv", "floats": "t.txt", "lines": "t.jsonl"}.get(kind, "t.json")
    match kind:
        case "columns":  # of which none is named as a time
            write(path, "frame,t\n" + "\n".join(f"{frame},{time}" for frame, time in both))
        case "floats":
            np.savetxt(path, both)
        case "array":
            np.save(path, both)
        case "objects":
            write(path, json.dumps(rows))
        case "nested":
            write(path, json.dumps({"camera": "left", "frames": rows}))
        case "lines":
            write(path, "\n".join(json.dumps(row) for row in rows))
        case "by number":
            write(path, json.dumps(dict(zip(map(str, frames), times, strict=True))))
    times_ns, indices = columns(path)
    assert times_ns == [250_000_000, 281_250_000, 312_500_000, 375_000_000]
    assert indices == frames


def test_dates_may_have_slashes(tmp_path: Path) -> None:
    path = write(tmp_path / "t.txt", "1970/01/01 00:00:01.5\n1970/01/01 00:00:02\n")
    assert columns(path)[0] == [1_500_000_000, 2_000_000_000]


@pytest.mark.parametrize(
    "items",
    [
        [1770341767841840901, 1770341767875173901],
        [
            {"frame": 1, "timestamp_ns": 1770341767841840901},
            {"frame": 2, "timestamp_ns": 1770341767875173901, "more": None},
        ],
        [{"time_s": "1770341767.841840901"}, {"time_s": "1770341767.875173901"}],
    ],
)
def test_json(tmp_path: Path, items: list) -> None:
    path = write(tmp_path / "a.json", json.dumps(items))
    assert columns(path) == ([1770341767841840901, 1770341767875173901], [0, 1])


def test_json_numbers_never_become_floats(tmp_path: Path) -> None:
    path = write(tmp_path / "a.json", '[{"time_s": 1770341767.841840901}]')
    assert columns(path)[0] == [1770341767841840901]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is no JSON"),
        ("{}", "must hold a list"),
        ("[]", "must hold a list"),
        ("[1, null]", "item 1: expected a number or text"),
        ('[{"time_s": 1}, {"time": 2}]', "item 1: expected a number or text for 'time_s'"),
        ('[{"time_s": 1}, 2]', "item 1: expected"),
        ("[0, Infinity]", "item 1: expected a number"),
        ("[0, true]", "item 1: expected"),
    ],
)
def test_bad_json_says_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_timecodes(write(tmp_path / "a.json", text))


# SMPTE


@pytest.mark.parametrize("rate", NTSC)
@pytest.mark.parametrize("drop_frame", [True, False])
def test_labels_round_trip(rate: Fraction, drop_frame: bool) -> None:
    day = frames_per_day(rate, drop_frame=drop_frame)
    rng = np.random.default_rng(1)
    frames = [*range(4000), *rng.integers(0, day, 3000).tolist(), *range(day - 2000, day)]
    labels = [frame_to_label(frame, rate, drop_frame=drop_frame) for frame in frames]
    assert [label_to_frame(label, rate) for label in labels] == frames
    assert len(set(labels)) == len(set(frames))


@pytest.mark.parametrize("rate", NTSC)
def test_a_drop_frame_day_is_short_by_86_ms(rate: Fraction) -> None:
    assert frames_per_day(rate, drop_frame=True) / rate == Fraction("86399.9136")


def test_known_drop_frame_labels() -> None:
    rate = NTSC[0]
    assert label_to_frame("00:00:59;29", rate) == 1799
    assert label_to_frame("00:01:00;02", rate) == 1800
    assert label_to_frame("00:10:00;00", rate) == 17982
    assert label_to_frame("01:00:00;00", rate) == 107892
    with pytest.raises(ValueError, match="skips"):
        label_to_frame("00:01:00;00", rate)
    with pytest.raises(ValueError, match="but not at 25"):
        label_to_frame("00:01:00;02", Fraction(25))


@pytest.mark.parametrize("label", ["24:00:00:00", "00:60:00:00", "00:00:60:00", "00:00:00:30", "0:00:00:00", "x", ""])
def test_labels_that_do_not_exist(label: str) -> None:
    with pytest.raises(ValueError, match="no SMPTE label"):
        label_to_frame(label, Fraction(30))


@pytest.mark.parametrize("drop_frame", [True, False])
def test_midnight_adds_the_frames_of_a_day(drop_frame: bool) -> None:
    rate = NTSC[0]
    day = frames_per_day(rate, drop_frame=drop_frame)
    frames = np.arange(day - 50, day + 50)
    labels = [frame_to_label(int(frame), rate, drop_frame=drop_frame) for frame in frames]
    assert np.array_equal(labels_to_ns(labels, rate), frames_to_ns(frames, rate))


def test_label_files(tmp_path: Path) -> None:
    rate = NTSC[0]
    path = write(tmp_path / "a.txt", "01:00:00;00\n01:00:00;01\n01:00:00;03\n")
    times = read_timecodes(path, rate=rate).times_ns
    assert times.tolist() == frames_to_ns(np.array([107892, 107893, 107895]), rate).tolist()
    csv = write(tmp_path / "a.csv", "frame,timecode\n0,01:00:00;00\n1,01:00:00;01\n2,01:00:00;03\n")
    assert np.array_equal(read_timecodes(csv, rate=rate).times_ns, times)
    listed = write(tmp_path / "a.json", '["01:00:00;00", "01:00:00;01", "01:00:00;03"]')
    assert np.array_equal(read_timecodes(listed, rate=rate).times_ns, times)
    with pytest.raises(ValueError, match="need the frame rate"):
        read_timecodes(path)
    with pytest.raises(ValueError, match=r"line 2: .*no SMPTE label"):
        read_timecodes(write(tmp_path / "b.txt", "01:00:00;00\n01:00:00;77\n"), rate=rate)
    with pytest.raises(ValueError, match="all be drop-frame"):
        read_timecodes(write(tmp_path / "c.txt", "01:00:00;00\n01:00:00:01\n"), rate=rate)


@given(st.integers(-(10**15), 10**15), st.fractions(Fraction(1, 10**6), 10**3, max_denominator=10**6))
def test_ticks_are_rounded_half_up(ticks: int, unit: Fraction) -> None:
    exact = ticks * unit * 10**9
    if abs(exact) < 2**62:
        expected = (2 * exact.numerator + exact.denominator) // (2 * exact.denominator)
        assert ticks_to_ns(np.array([ticks]), unit)[0] == expected


@pytest.mark.parametrize(
    ("value", "rate"),
    [
        (30, Fraction(30)),
        ("29.97", NTSC[0]),
        (29.97, NTSC[0]),
        ("23.98", Fraction(24000, 1001)),
        ("23.976", Fraction(24000, 1001)),
        (Decimal("59.94"), NTSC[1]),
        ("30000/1001", NTSC[0]),
        ("12.5", Fraction(25, 2)),
        (24, Fraction(24)),
    ],
)
def test_rates(value: object, rate: Fraction) -> None:
    assert parse_rate(value) == rate


@pytest.mark.parametrize("value", [0, -1, "fast", "30/0", "nan", True])
def test_bad_rates(value: object) -> None:
    with pytest.raises(ValueError, match="frame rate"):
        parse_rate(value)


# Frame numbers


def codes(indices: list[int]) -> Timecodes:
    return Timecodes(np.arange(len(indices)) * 20_000_000, np.array(indices))


def test_as_many_lines_as_frames_number_themselves() -> None:
    assert frame_numbers(codes([5, 6, 9]), 3).tolist() == [0, 1, 2]
    assert frame_numbers(codes([5, 3, 3]), 3).tolist() == [0, 1, 2]


def test_an_index_that_spans_the_video_is_believed() -> None:
    assert frame_numbers(codes([5, 6, 9]), 5).tolist() == [0, 1, 4]
    assert codes([5, 6, 9]).numbered(5).indices.tolist() == [0, 1, 4]


@pytest.mark.parametrize(("indices", "frames"), [([5, 6, 9], 4), ([5, 6, 9], 6), ([0, 1], 1), ([0, 4, 2, 4], 5)])
def test_anything_else_is_refused(indices: list[int], frames: int) -> None:
    with pytest.raises(ValueError, match=f"camera 'left' has {frames} frames .* {len(indices)} timecodes"):
        frame_numbers(codes(indices), frames, camera="left")


@pytest.mark.parametrize(
    ("times", "indices", "message"),
    [
        (np.zeros(0, np.int64), np.zeros(0, np.int64), "at least one"),
        (np.zeros(2), np.zeros(2, np.int64), "two int64 arrays"),
        (np.zeros(2, np.int64), np.zeros(3, np.int64), "two int64 arrays"),
        (np.array([2**62]), np.zeros(1, np.int64), "146 years"),
    ],
)
def test_timecodes_check_themselves(times: np.ndarray, indices: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Timecodes(times, indices)


@pytest.mark.parametrize("module", [sync.timecode.labels, sync.timecode.rates, sync.timecode.read])
def test_docstring_examples_hold(module: ModuleType) -> None:
    results = doctest.testmod(module)
    assert results.failed == 0
    assert results.attempted > 0
