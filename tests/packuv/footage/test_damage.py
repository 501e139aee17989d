"""Damage: what differs from the whole video is told, in whatever order frames are read, and nothing else is."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from packuv.footage.damage import Damage, DamagedPictureError, DamageLog, without
from packuv.footage.jpeg import jpeg_fault
from packuv.footage.reader import FrameReader
from packuv.footage.watching import WatchingReader
from tests.support.pictures import write_picture

COUNT, KEYS = 60, 15
CODECS = {
    "closed.mp4": ("libx264", {"g": str(KEYS), "bf": "3"}),
    "open.mp4": ("libx264", {"g": str(KEYS), "bf": "3", "flags": "-cgop", "x264-params": "open-gop=1"}),
    "open.mkv": ("libx264", {"g": str(KEYS), "bf": "3", "flags": "-cgop", "x264-params": "open-gop=1"}),
    "jpeg.mov": ("mjpeg", {"qscale": "3"}),
}


def write_video(path: Path, codec: str, options: dict[str, str]) -> Path:
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=30, options=options)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height = 128, 96
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.thread_count = 1
        for number in range(COUNT):
            y, x = np.mgrid[0:96, 0:128]
            wave = 120 + 60 * np.sin((x + 5 * number) / 11) + 50 * np.cos((y - 3 * number) / 9)
            noise = np.random.default_rng(number).integers(0, 12, (96, 128, 3))
            frame = av.VideoFrame.from_ndarray((wave[..., None] + noise).clip(0, 255).astype(np.uint8), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def damaged(source: Path, target: Path, seed: int, hits: int = 1) -> list[int]:
    """Copy a video with wrong bytes in a few packets; the frames that these hold."""
    rng, struck = np.random.default_rng(seed), list[int]()
    with av.open(str(source)) as inside, av.open(str(target), "w") as out:
        origin = inside.streams.video[0]
        stream = out.add_stream_from_template(origin)
        packets = [packet for packet in inside.demux(origin) if packet.size]
        chosen = set(rng.choice(np.arange(2, len(packets)), hits, replace=False).tolist())
        for number, packet in enumerate(packets):
            if number in chosen:
                content = bytearray(bytes(packet))
                at = int(rng.integers(len(content) // 3, max(len(content) // 3 + 1, len(content) - 12)))
                content[at : at + 10] = rng.integers(0, 255, 10).astype(np.uint8).tobytes()
                assert packet.pts is not None
                struck.append(round(packet.pts * origin.time_base * 30))
                twin = av.Packet(bytes(content))
                twin.pts, twin.dts, twin.time_base = packet.pts, packet.dts, packet.time_base
                twin.is_keyframe = packet.is_keyframe
                packet = twin
            packet.stream = stream
            out.mux(packet)
    return struck


def read_all(path: Path, order: list[int]) -> tuple[dict[int, np.ndarray | None], dict[int, Damage]]:
    reader, found = FrameReader({"a": path}, careful=True), dict[int, np.ndarray | None]()
    for number in order:
        try:
            found[number] = reader.read("a", number)
        except DamagedPictureError:
            found[number] = None
    return found, dict(reader.damage("a"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("whole")
    return {name: write_video(folder / name, *said) for name, said in CODECS.items()}


@pytest.mark.parametrize("name", CODECS)
def test_a_whole_video_has_no_damage(whole: dict[str, Path], name: str) -> None:
    order = [*np.random.default_rng(1).permutation(COUNT).tolist(), *range(COUNT)]
    found, damage = read_all(whole[name], order)
    assert damage == {}
    assert len(found) == COUNT


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", CODECS)
def test_what_differs_is_told_in_whatever_order_frames_are_read(
    whole: dict[str, Path], tmp_path: Path, name: str, seed: int
) -> None:
    path = tmp_path / name
    struck = damaged(whole[name], path, seed)
    truth, _ = read_all(whole[name], list(range(COUNT)))
    passed, told = read_all(path, list(range(COUNT)))
    sought, told_too = read_all(path, np.random.default_rng(seed).permutation(COUNT).tolist())
    assert told == told_too
    for number in range(COUNT):
        one, other = passed[number], sought[number]
        assert (one is None) == (other is None), f"{struck=} {number=} {told=}"
        # What a decoder conceals is made of what it showed before.
        assert one is None or number in told or np.array_equal(one, other), f"{struck=} {number=} {told=}"
    wrong = {k for k in range(COUNT) if passed[k] is None or not np.array_equal(passed[k], truth[k])}
    silent = wrong - told.keys()
    # What still decodes to the right number of blocks is seen by nobody.
    assert not silent or not told, f"{struck=} {wrong=} {told=}"
    reach = {k for s in struck for k in range(s - 5, s // KEYS * KEYS + 2 * KEYS)}
    assert told.keys() <= reach


def test_videos_that_were_cut_anywhere_give_one_answer(whole: dict[str, Path], tmp_path: Path) -> None:
    for keep in (33, 41, 46, 47, 48, 49):
        path = tmp_path / f"{keep}.mp4"
        with av.open(str(whole["open.mp4"])) as inside, av.open(str(path), "w") as out:
            origin = inside.streams.video[0]
            stream = out.add_stream_from_template(origin)
            for packet in [packet for packet in inside.demux(origin) if packet.size][:keep]:
                packet.stream = stream
                out.mux(packet)
        count = FrameReader({"a": path}).frame_count("a")
        passed, told = read_all(path, list(range(count)))
        sought, told_too = read_all(path, list(range(count))[::-1])
        assert told == told_too
        assert all(np.array_equal(passed[k], sought[k]) for k in range(count) if passed[k] is not None)


def test_a_watching_reader_goes_on_and_remembers_after_a_kill(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (16, 24, 3)).astype(np.uint8) for _ in range(5)]
    for number, picture in enumerate(pictures):
        write_picture(tmp_path / "a" / f"{number}.png", picture)
    for number in (1, 2):
        (tmp_path / "a" / f"{number}.png").write_bytes(b"content")
    reader = WatchingReader({"a": tmp_path / "a"}, DamageLog(tmp_path / "log.json"))
    assert np.array_equal(reader.read("a", 1), pictures[0])
    assert np.array_equal(reader.read("a", 2), pictures[3])
    facts = DamageLog(tmp_path / "log.json").facts()
    assert facts == {"a": {"lost": 2, "concealed": 0, "follows": 0, "frames": [(1, 2)]}}
    assert without(np.array([0, 1, -1, 2, 3]), facts["a"]).tolist() == [0, -1, -1, -1, 3]


@pytest.mark.parametrize("kind", ["plain", "restart", "progressive"])
def test_whole_jpegs_are_whole(tmp_path: Path, kind: str) -> None:
    options = {"restart": [cv2.IMWRITE_JPEG_RST_INTERVAL, 3], "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]}
    rng = np.random.default_rng(0)
    for size in ((40, 56, 3), (37, 51, 3), (8, 8), (120, 9)):
        picture = rng.integers(0, 256, size).astype(np.uint8)
        for quality in (20, 75, 100):
            content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality, *options.get(kind, [])])[
                1
            ].tobytes()
            assert jpeg_fault(content) == ""
            assert jpeg_fault(content[: len(content) * 2 // 3]) or kind == "progressive" or len(content) < 700
