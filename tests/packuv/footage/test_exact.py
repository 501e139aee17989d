"""Frames by number: the frame asked for, in whatever order, or an error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import av
import numpy as np
import pytest

from packuv.footage.coding import Coding
from packuv.footage.develop import Developer
from packuv.footage.reader import FrameReader
from packuv.footage.transfer import Transfer
from sync.probe import probe_video
from tests.support.planes import shapes, write_planes

COUNT = 48
OPEN = {"x265-params": "open-gop=1:keyint=12:min-keyint=12:bframes=4:b-adapt=0:log-level=none:pools=1:frame-threads=1"}
CODECS: dict[str, tuple[str, str, Mapping[str, str]]] = {
    "hevc.mp4": ("libx265", "yuv422p10le", OPEN),
    "hevc.mkv": ("libx265", "yuv420p10le", OPEN),
    "avc.mp4": ("libx264", "yuv422p10le", {"g": "12", "bf": "3", "flags": "-cgop", "x264-params": "open-gop=1"}),
    "prores.mov": ("prores_ks", "yuv422p10le", {}),
    "ffv1.mkv": ("ffv1", "yuv444p12le", {"g": "5"}),
}


def sliding(name: str) -> list[list[np.ndarray]]:
    """Frames that differ everywhere from each other."""
    unit = 4 if "10" in name else 16
    frames = []
    for number in range(COUNT):
        y, x = np.mgrid[0:64, 0:96]
        luma = (120 + 50 * np.sin((x + 5 * number) / 11) + 50 * np.cos((y - 3 * number) / 9)) * unit
        chroma = [np.full(shape, (100 + number) * unit, np.uint16) for shape in shapes(name[3:6], 64, 96)[1:]]
        frames.append([luma.astype(np.uint16), *chroma])
    return frames


@pytest.mark.parametrize("file", sorted(CODECS))
def test_any_order_gives_what_one_pass_gives(tmp_path: Path, file: str) -> None:
    codec, name, options = CODECS[file]
    path = write_planes(tmp_path / file, name, sliding(name), (1, 1, 1, 1), codec=codec, options=options)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        developer = Developer(Coding.of(stream), Transfer.SDR)
        truth = [developer.picture(frame) for frame in container.decode(stream)]
    assert len(truth) == COUNT
    reader = FrameReader({"a": path}, threads=2)
    order = [*range(6), *np.random.default_rng(0).permutation(COUNT).tolist(), 47, 0, *range(9, 15)]
    for number in order:
        assert np.array_equal(reader.read("a", number), truth[number]), f"frame {number}"


def test_8_bit_frames_in_any_order_are_those_of_torchcodec(tmp_path: Path) -> None:
    from torchcodec.decoders import VideoDecoder  # here, since it takes seconds

    frames = [[plane // 4 for plane in planes] for planes in sliding("yuv420p10le")]
    frames = [[plane.astype(np.uint8) for plane in planes] for planes in frames]
    options = {"g": "12", "bf": "3", "flags": "-cgop", "x264-params": "open-gop=1"}
    path = write_planes(tmp_path / "a.mp4", "yuv420p", frames, (1, 1, 1, 1), codec="libx264", options=options)
    decoder, reader = VideoDecoder(str(path), dimension_order="NHWC", seek_mode="exact"), FrameReader({"a": path})
    for number in [*range(6), *np.random.default_rng(0).permutation(COUNT).tolist(), 47, 0, *range(9, 15)]:
        wanted = decoder.get_frame_at(number).data.numpy()
        assert np.array_equal(reader.read("a", number), wanted), f"frame {number}"


def test_a_cut_file_gives_true_frames_or_an_error(tmp_path: Path) -> None:
    frames = sliding("yuv444p12le")
    path = write_planes(tmp_path / "a.mkv", "yuv444p12le", frames, codec="ffv1", options={"g": "5"})
    whole = [FrameReader({"a": path}).read("a", number) for number in range(COUNT)]
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    reader, right = FrameReader({"a": cut}), 0
    for number in range(reader.frame_count("a")):
        try:
            picture = reader.read("a", number)
        except ValueError:
            continue
        assert np.array_equal(picture, whole[number])
        right += 1
    assert right > COUNT // 3


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_videos_are_turned_as_they_are_shown(tmp_path: Path, degrees: int) -> None:
    picture = np.random.default_rng(0).integers(16, 235, (48, 64, 3)).astype(np.uint8)
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=30, options={"qp": "0"})
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "bgr24"
        stream.set_display_rotation(degrees)
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode(None))
    shown = FrameReader({"a": path}).read("a", 1)
    info = probe_video(path)
    assert shown.shape[:2] == (info.height, info.width)
    assert info.rotation_deg == degrees
    assert np.array_equal(shown, np.rot90(picture, degrees // 90))


@pytest.mark.parametrize("default", [0, 1])
def test_of_several_streams_the_one_that_is_probed_is_read(tmp_path: Path, default: int) -> None:
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        streams = []
        for number, side in enumerate((32, 64)):
            stream = container.add_stream("ffv1", rate=30)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height, stream.pix_fmt = side, side, "yuv420p"
            stream.disposition = av.stream.Disposition.default if number == default else av.stream.Disposition(0)
            streams.append(stream)
        for _ in range(4):
            for stream in streams:
                plain = np.full((stream.height, stream.width, 3), 100, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(plain, "rgb24")))
        for stream in streams:
            container.mux(stream.encode(None))
    info, reader = probe_video(path), FrameReader({"a": path})
    assert (info.frame_count, info.width) == (reader.frame_count("a"), reader.read("a", 3).shape[1])
    assert info.width == (32, 64)[default]
    assert f"of 2 video streams #{default}" in info.notes[0]
