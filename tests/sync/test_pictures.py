"""Cameras that are folders of pictures: which are found, in which order, and what their numbers tell."""

from __future__ import annotations

import doctest
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sync.natural
import sync.pictures
from packuv.footage.pictures import picture_names
from sync.align import align
from sync.capture import find_capture, load_timecodes, picture_notes, probe_capture
from sync.pictures import list_pictures
from sync.probe import probe_video
from tests.support.pictures import write_exr, write_picture

PICTURE = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)


def fill(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True)
    for name in names:
        (folder / name).write_bytes(b"content")
    return folder


def write_video(path: Path, frames: int, rate: int) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(PICTURE, "rgb24")))
        container.mux(stream.encode())


TEXTS = st.text("abC_ .-", max_size=6)


@settings(max_examples=40)
@given(
    prefix=TEXTS.filter(lambda text: not text.startswith(".")),
    suffix=TEXTS,
    numbers=st.sets(st.integers(0, 2000), min_size=1, max_size=12),
    width=st.sampled_from([0, 4, 6]),
    kind=st.sampled_from([".png", ".PNG", ".jpg", ".JPEG", ".exr"]),
)
def test_frames_are_in_order_of_their_numbers_whatever_stands_around_them(
    tmp_path_factory, prefix: str, suffix: str, numbers: set[int], width: int, kind: str
) -> None:
    folder = tmp_path_factory.mktemp("camera")
    names = {number: f"{prefix}{number:0{width}d}{suffix}{kind}" for number in numbers}
    for number in sorted(numbers, reverse=True):
        (folder / names[number]).write_bytes(b"content")
    found = list_pictures(folder)
    assert found.numbers.tolist() == sorted(numbers)
    assert found.names == tuple(names[number] for number in sorted(numbers))
    assert list(found.names) == picture_names(folder)


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("Cam001_rgb000000.jpg", "Cam001_rgb000001.jpg"), [0, 1]),
        (("scene7_00002_03.png", "scene7_00010_03.png"), [2, 10]),
        (("cam.mp4_9.jpg", "cam.mp4_10.jpg"), [9, 10]),
        (("2026-11-28_7.png", "2026-11-29_8.png"), [7, 8]),
        (("7.png",), [7]),
        (("IMG_10.png", "img_9.PNG"), [9, 10]),
    ],
)
def test_published_names(tmp_path: Path, names: tuple[str, ...], numbers: list[int]) -> None:
    assert list_pictures(fill(tmp_path / "a", *names)).numbers.tolist() == numbers


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("a1.png", "b2.png"), "named alike but for their number.*a1.png and b2.png"),
        (("1.png", "01.png"), "a number of its own.*01.png and 1.png"),
        (("1.png", "1.jpg"), "a number of its own.*1.jpg and 1.png"),
    ],
)
def test_names_that_tell_no_order_are_refused(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        list_pictures(fill(tmp_path / "a", *names))


def test_missing_numbers_are_dropped_frames(tmp_path: Path) -> None:
    folder = fill(tmp_path / "cam1", *(f"{number}.png" for number in (1, 2, 4, 5, 9, 10)))
    (folder / "11.png").touch()
    (folder / "cover.png").write_bytes(b"content")
    (folder / "notes1.txt").write_bytes(b"content")
    found = list_pictures(folder)
    assert found.times_ns(Fraction(10), 1).tolist() == [
        0,
        100_000_000,
        300_000_000,
        400_000_000,
        800_000_000,
        900_000_000,
    ]
    missing, empty, other = found.notes("cam1")
    assert missing == "cam1: 4 of 10 pictures are missing, taken for dropped frames: numbers 3, 6 to 8"
    assert "1 pictures are empty files, left out: 11.png" in empty
    assert "cover.png" in other


def test_numbers_in_steps_lose_nothing_and_times_are_no_numbers(tmp_path: Path) -> None:
    assert list_pictures(fill(tmp_path / "a", "0.png", "10.png", "20.png")).notes("a") == ()
    found = list_pictures(
        fill(tmp_path / "b", *(f"{1_403_636_579_763_555_584 + 49_999_000 * k + k * k}.png" for k in range(5)))
    )
    assert not found.counted
    assert found.times_ns(Fraction(10), 0).tolist() == [100_000_000 * k for k in range(5)]
    assert "count no frames" in found.notes("b")[0]


def test_a_picture_is_probed_as_it_is_shown(tmp_path: Path) -> None:
    for number, orientation in enumerate((6, 6)):
        write_picture(tmp_path / "cam1" / f"{number}.jpg", PICTURE, orientation=orientation)
    info = probe_video(tmp_path / "cam1", rate=Fraction(25))
    assert (info.width, info.height, info.codec, info.rate) == (48, 64, "jpeg", 25)
    write_picture(tmp_path / "cam1" / "2.jpg", PICTURE)
    with pytest.raises(ValueError, match=r"must have one size, but in .*0.jpg is 48x64 and 2.jpg 64x48"):
        probe_video(tmp_path / "cam1")


def test_kinds_of_pictures_are_told(tmp_path: Path) -> None:
    write_picture(tmp_path / "deep" / "0.png", PICTURE.astype(np.uint16) * 257)
    write_exr(tmp_path / "light" / "0.exr", PICTURE.astype(np.float32))
    assert probe_video(tmp_path / "deep").colour.bit_depth == 16
    assert probe_video(tmp_path / "light").codec == "exr"
    (tmp_path / "deep" / "0.png").write_bytes(b"content")
    with pytest.raises(ValueError, match=r"0.png is no picture"):
        probe_video(tmp_path / "deep")


@pytest.mark.parametrize("place", ["videos", "images", "rgbs", "ims"])
def test_folders_of_pictures_are_cameras(tmp_path: Path, place: str) -> None:
    for camera in ("Cam10", "Cam2"):
        fill(tmp_path / place / camera, "000000.jpg", "000001.jpg")
    capture = find_capture(tmp_path)
    assert capture.cameras == ("Cam2", "Cam10")
    assert capture.videos["Cam2"] == tmp_path / place / "Cam2"
    assert capture.notes == ()


def test_what_is_passed_over_is_said(tmp_path: Path) -> None:
    for camera in ("cam1", "cam2"):
        fill(tmp_path / "images" / camera, "0.png")
    videos = fill(
        tmp_path / "videos", "cam1.MP4", "CAM2.mov", "cam1.jpg", "cam1.mp4.jpg", "cam_000001.jpg", "notes.txt"
    )
    fill(videos / "old", "cam3.mp4")
    capture = find_capture(tmp_path)
    assert capture.cameras == ("cam1", "CAM2")
    old, loose, others = capture.notes
    assert "videos/old/ is passed over: it holds no numbered pictures" in old
    assert "1 pictures that belong to no video (cam_000001.jpg)" in loose
    assert "images/ holds 2 cameras, too" in others
    (videos / "CAM2.mov").unlink()
    with pytest.raises(ValueError, match=r"at least two cameras.*cam_000001\.jpg.*folder of its own"):
        find_capture(tmp_path)


@pytest.mark.parametrize("first", [0, 1, 57])
def test_pictures_beside_videos_run_at_their_rate(tmp_path: Path, first: int) -> None:
    (tmp_path / "videos").mkdir()
    write_video(tmp_path / "videos" / "cam1.mp4", 6, 25)
    for number in (0, 1, 2, 4):
        write_picture(tmp_path / "videos" / "cam2" / f"{first + number:04d}.png", PICTURE)
    capture = find_capture(tmp_path)
    infos = probe_capture(capture)
    groups, report = align(load_timecodes(capture, infos))
    assert groups.frames[:, 1].tolist() == [0, 1, 2, -1, 3, -1]
    assert report.cameras[1].drops == 1
    assert "25 per second" in report.cameras[1].source
    assert "25 per second (the videos' rate)" in picture_notes(capture, infos)[0]


def test_numbers_of_all_cameras_count_from_the_same_one(tmp_path: Path) -> None:
    for camera, numbers in {"a": (10, 11, 12), "b": (11, 12)}.items():
        for number in numbers:
            write_picture(tmp_path / "images" / camera / f"{number}.png", PICTURE)
    capture = find_capture(tmp_path)
    infos = probe_capture(capture)
    assert align(load_timecodes(capture, infos))[0].frames.tolist() == [[0, -1], [1, 0], [2, 1]]
    rate, late = picture_notes(capture, infos)
    assert "set fps in capture.toml" in rate
    assert "begin at number 10, but b at 11" in late


@pytest.mark.parametrize("lines", [(0, 1, 3), (0, 1, 2, 3)])
def test_a_timecode_file_has_a_line_for_each_picture_or_for_each_number(tmp_path: Path, lines: tuple[int, ...]) -> None:
    (tmp_path / "timecodes").mkdir()
    for camera in ("a", "b"):
        for number in (4, 5, 7):
            write_picture(tmp_path / "images" / camera / f"{number}.png", PICTURE)
        text = "timestamp_ns\n" + "".join(f"{1_700_000_000_000_000_000 + 40_000_000 * line}\n" for line in lines)
        (tmp_path / "timecodes" / f"{camera}.csv").write_text(text)
    capture = find_capture(tmp_path)
    times = load_timecodes(capture, probe_capture(capture))
    assert times["a"].indices.tolist() == [0, 1, 2]
    assert ((times["a"].times_ns - times["a"].times_ns[0]) // 40_000_000).tolist() == [0, 1, 3]


def test_examples() -> None:
    for module in (sync.natural, sync.pictures):
        assert doctest.testmod(module).failed == 0
