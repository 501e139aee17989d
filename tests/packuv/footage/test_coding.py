"""What FFmpeg shows as it is meant keeps the bytes that torchcodec gives it; the rest is taken from it."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from packuv.footage.coding import Coding
from packuv.footage.reader import FrameReader
from packuv.footage.transfer import BT709, BT2020, Transfer
from tests.support.planes import shapes, write_planes

TAGGED = {"matrix": 1, "transfer": 1, "primaries": 1, "range": 1}
UNTAGGED = {"matrix": 2, "transfer": 2, "primaries": 2, "range": 0}


def coding(name: str, bits: int = 8, *, width: int = 640, height: int = 360, **tags: int) -> Coding:
    return Coding(name, bits, width=width, height=height, **{**TAGGED, **tags})


@pytest.mark.parametrize(
    ("found", "said", "plain"),
    [
        (coding("yuv420p"), None, True),
        (coding("yuv420p", matrix=5, transfer=2, primaries=2), None, True),
        (coding("yuvj420p", range=2), None, True),
        (coding("yuv420p", **UNTAGGED), None, True),
        (coding("bgr0", **UNTAGGED), None, True),
        (coding("gray", **UNTAGGED), None, True),
        (coding("yuv420p", **UNTAGGED, width=1920, height=1080), None, False),
        (coding("yuv420p", range=2), None, False),
        (coding("yuv420p10le", 10), None, False),
        (coding("gbrp12le", 12), None, False),
        (coding("yuv420p", transfer=18), None, False),
        (coding("yuv420p", transfer=18), Transfer.SDR, True),
        (coding("yuv420p", primaries=9), None, False),
        (coding("yuv420p"), Transfer.VLOG, False),
    ],
)
def test_who_decodes(found: Coding, said: Transfer | None, plain: bool) -> None:
    assert found.plain(said) is plain


def test_primaries_are_the_cameras_for_log_and_the_tags_for_the_rest() -> None:
    assert coding("yuv420p10le", 10).gamut(Transfer.SLOG3) not in (BT709, BT2020)
    assert coding("yuv420p10le", 10).gamut(Transfer.HLG) == BT709
    assert coding("yuv420p10le", 10, **UNTAGGED).gamut(Transfer.HLG) == BT2020
    assert coding("yuv420p10le", 10, **UNTAGGED).gamut(Transfer.SDR) == BT709


@pytest.mark.parametrize("name", ["yuv420p", "yuv422p", "yuv444p", "yuv440p"])
@pytest.mark.parametrize("matrix", [1, 5])
@pytest.mark.parametrize("size", [(48, 64), (38, 54)])
def test_8_bit_video_keeps_the_bytes_of_torchcodec(
    tmp_path: Path, matrix: int, name: str, size: tuple[int, int]
) -> None:
    from torchcodec.decoders import VideoDecoder  # here, since it takes seconds

    rng = np.random.default_rng(0)
    planes = [rng.integers(16, 235, shape).astype(np.uint8) for shape in shapes(name[3:6], *size)]
    path = write_planes(tmp_path / "a.mkv", name, [planes], (matrix, 1, matrix, matrix))
    plain = VideoDecoder(str(path), dimension_order="NHWC").get_frame_at(0).data.numpy()
    assert np.array_equal(FrameReader({"a": path}).read("a", 0), plain)


def test_a_stream_tells_its_tags(tmp_path: Path) -> None:
    planes = [np.full(shape, 512, np.uint16) for shape in shapes("422", 16, 18)]
    path = write_planes(tmp_path / "a.mkv", "yuv422p10le", [planes], (9, 1, 18, 9))
    with av.open(str(path)) as container:
        found = Coding.of(container.streams.video[0])
    assert found == Coding("yuv422p10le", 10, 9, 18, 9, 1, 18, 16)
