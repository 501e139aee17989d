"""Planes become the picture that the standards' formulas give, to the nearest code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.colour import srgb_from_linear
from packuv.footage.coding import WEIGHTS, Coding
from packuv.footage.develop import Developer
from packuv.footage.reader import FrameReader
from packuv.footage.transfer import BT2020, Transfer, bt709_from, light_from_signal
from tests.support.planes import SUBSAMPLED, UNTAGGED, Tags, filled, shapes, write_planes

NEAREST = 0.51
"""Codes of 255 between a value and the byte that it is rounded to: half, and a step of the tables"""
MIXED = 0.55
"""The same where primaries change: light is tabulated in float32, and in 65,536 steps near black"""


def planes_of(rng: np.random.Generator, sampling: str, bits: int, height: int, width: int) -> list[np.ndarray]:
    kind = np.uint8 if bits == 8 else np.uint16
    return [rng.integers(0, 2**bits, shape).astype(kind) for shape in shapes(sampling, height, width)]


def spread(chroma: np.ndarray, sampling: str, height: int, width: int) -> np.ndarray:
    """Chroma at every pixel: linear between samples that lie left of two columns and between two rows."""
    across, down = SUBSAMPLED[sampling]
    rows, columns = chroma.shape
    wide = [np.interp(np.arange(width), np.arange(columns) << across, row) for row in chroma.astype(float)]
    places = (np.arange(rows) + 0.5) * (1 << down)
    return np.stack([np.interp(np.arange(height) + 0.5, places, column) for column in np.array(wide).T], axis=1)


def signal_of(planes: list[np.ndarray], sampling: str, bits: int, matrix: int, *, full: bool) -> np.ndarray:
    """float64 [H, W, 3]: signals of red, green and blue by ITU-R BT.601, BT.709 and BT.2020."""
    height, width = planes[0].shape
    luma, blue, red = (planes[0].astype(float), *(spread(plane, sampling, height, width) for plane in planes[1:]))
    unit, (kr, kb) = 2 ** (bits - 8), WEIGHTS[matrix]
    if full:
        y, pb, pr = luma / (2**bits - 1), *((chroma - 128 * unit) / (2**bits - 1) for chroma in (blue, red))
    else:
        y, pb, pr = (luma - 16 * unit) / (219 * unit), *((c - 128 * unit) / (224 * unit) for c in (blue, red))
    r, b = y + 2 * (1 - kr) * pr, y + 2 * (1 - kb) * pb
    return np.stack([r, (y - kr * r - kb * b) / (1 - kr - kb), b], axis=-1)


def coding(name: str, bits: int, tags: Tags = UNTAGGED, *, width: int = 64, height: int = 48) -> Coding:
    matrix, span, transfer, primaries = tags
    return Coding(name, bits, matrix, transfer, primaries, span, width, height)


@settings(max_examples=40)
@given(
    sampling=st.sampled_from(sorted(SUBSAMPLED)),
    bits=st.sampled_from([8, 10, 12]),
    matrix=st.sampled_from(sorted(WEIGHTS)),
    full=st.booleans(),
    height=st.integers(2, 9),
    width=st.integers(2, 21),
    seed=st.integers(0, 2**16),
)
def test_every_pixel_is_the_nearest_code(
    sampling: str, bits: int, matrix: int, full: bool, height: int, width: int, seed: int
) -> None:
    name = f"yuv{sampling}p{'' if bits == 8 else f'{bits}le'}"
    tags = (matrix, 2 if full else 1, 2, 2)
    planes = planes_of(np.random.default_rng(seed), sampling, bits, height, width)
    picture = Developer(coding(name, bits, tags), Transfer.SDR).picture(filled(name, planes, tags))
    truth = 255 * np.clip(signal_of(planes, sampling, bits, matrix, full=full), 0, 1)
    assert np.abs(picture - truth).max() <= NEAREST


@pytest.mark.parametrize("matrix", [1, 5, 9])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(("name", "bits"), [("yuv420p10le", 10), ("yuv422p10le", 10), ("yuv444p12le", 12)])
def test_a_video_gives_what_was_put_in(tmp_path: Path, name: str, bits: int, full: bool, matrix: int) -> None:
    planes = planes_of(np.random.default_rng(1), name[3:6], bits, 24, 40)
    path = write_planes(tmp_path / "a.mkv", name, [planes], (matrix, 2 if full else 1, 2, 2))
    truth = 255 * np.clip(signal_of(planes, name[3:6], bits, matrix, full=full), 0, 1)
    assert np.abs(FrameReader({"a": path}).read("a", 0) - truth).max() <= NEAREST


def test_full_range_is_read_where_the_format_does_not_say_it(tmp_path: Path) -> None:
    planes = planes_of(np.random.default_rng(2), "444", 8, 16, 16)
    path = write_planes(tmp_path / "a.mkv", "yuv444p", [planes], (1, 2, 2, 2))
    truth = 255 * np.clip(signal_of(planes, "444", 8, 1, full=True), 0, 1)
    assert np.abs(FrameReader({"a": path}).read("a", 0) - truth).max() <= NEAREST


@pytest.mark.parametrize(("width", "matrix"), [(64, 5), (1280, 1)])
def test_untagged_video_has_the_matrix_of_its_size(tmp_path: Path, width: int, matrix: int) -> None:
    planes = planes_of(np.random.default_rng(3), "444", 8, 8, width)
    path = write_planes(tmp_path / "a.mkv", "yuv444p", [planes])
    truth = 255 * np.clip(signal_of(planes, "444", 8, matrix, full=False), 0, 1)
    assert np.abs(FrameReader({"a": path}).read("a", 0) - truth).max() <= NEAREST


@pytest.mark.parametrize(("name", "bits"), [("gray10le", 10), ("gray12le", 12), ("gbrp10le", 10), ("gbrp12le", 12)])
def test_gray_and_rgb_of_more_bits_are_full_range(tmp_path: Path, name: str, bits: int) -> None:
    count = 1 if name.startswith("gray") else 3
    rng = np.random.default_rng(4)
    planes = [rng.integers(0, 2**bits, (16, 24)).astype(np.uint16) for _ in range(count)]
    path = write_planes(tmp_path / "a.mkv", name, [planes], (0 if count == 3 else 2, 0, 2, 2))
    green, blue, red = planes * (3 // count)
    truth = 255.0 * np.stack([red, green, blue], axis=-1) / (2**bits - 1)
    assert np.abs(FrameReader({"a": path}).read("a", 0) - truth).max() <= NEAREST


def test_other_layouts_of_the_same_values_give_the_same_picture() -> None:
    planes = [
        np.full(shape, value, np.uint16) for shape, value in zip(shapes("420", 16, 24), (400, 480, 600), strict=True)
    ]
    frame = filled("yuv420p10le", planes, (1, 1, 2, 2))
    picture = Developer(coding("yuv420p10le", 10, (1, 1, 2, 2)), Transfer.SDR).picture(frame)
    packed = Developer(coding("p010le", 10, (1, 1, 2, 2)), Transfer.SDR).picture(
        frame.reformat(format="p010le", threads=1)
    )
    assert np.abs(picture.astype(int) - packed).max() <= 1


def test_a_matrix_that_is_none_is_refused(tmp_path: Path) -> None:
    planes = planes_of(np.random.default_rng(5), "420", 10, 16, 16)
    path = write_planes(tmp_path / "a.mkv", "yuv420p10le", [planes], (14, 1, 16, 9))
    with pytest.raises(ValueError, match=r"a\.mkv: .*matrix 14 of ITU-T H\.273.*encode it again"):
        FrameReader({"a": path}).read("a", 0)


@pytest.mark.parametrize("transfer", [*Transfer])
@pytest.mark.parametrize("bits", [10, 12])
def test_a_grey_ramp_becomes_its_light(tmp_path: Path, transfer: Transfer, bits: int) -> None:
    codes = np.arange(2**bits).reshape(2 ** (bits - 7), 128).astype(np.uint16)
    grey = np.full_like(codes, 128 << (bits - 8))
    path = write_planes(tmp_path / "a.mkv", f"yuv444p{bits}le", [[codes, grey, grey]], (1, 1, 2, 2))
    picture = FrameReader({"a": path}, transfer=transfer).read("a", 0)
    signal = (codes.astype(float) - (16 << (bits - 8))) / (219 << (bits - 8))
    light = light_from_signal(transfer, np.clip(signal, -0.125, 1.125))
    truth = 255 * (np.clip(signal, 0, 1) if transfer is Transfer.SDR else srgb_from_linear(light))
    assert np.abs(picture - truth[..., None]).max() <= MIXED


@pytest.mark.parametrize(("tag", "transfer"), [(16, Transfer.PQ), (18, Transfer.HLG)])
def test_tagged_hdr_is_known_unless_told_otherwise(tmp_path: Path, tag: int, transfer: Transfer) -> None:
    planes = planes_of(np.random.default_rng(6), "444", 10, 16, 16)
    path = write_planes(tmp_path / "a.mkv", "yuv444p10le", [planes], (9, 1, tag, 9))
    signal = np.clip(signal_of(planes, "444", 10, 9, full=False), -0.125, 1.125)
    light = light_from_signal(transfer, signal) @ bt709_from(BT2020).T
    truth = 255 * srgb_from_linear(light)
    assert np.abs(FrameReader({"a": path}).read("a", 0) - truth).max() <= MIXED
    told = FrameReader({"a": path}, transfer=Transfer.SDR).read("a", 0)
    assert np.abs(told - truth).max() > 20


def test_bt2020_colours_keep_grey_and_lose_no_range(tmp_path: Path) -> None:
    codes = np.full((8, 8), 512, np.uint16)
    path = write_planes(tmp_path / "a.mkv", "yuv444p10le", [[codes, codes, codes]], (9, 1, 14, 9))
    assert np.abs(FrameReader({"a": path}).read("a", 0) - 255 * (512 - 64) / 876).max() <= MIXED


def test_8_bit_log_is_read_too(tmp_path: Path) -> None:
    codes, grey = np.arange(256, dtype=np.uint8).reshape(2, 128), np.full((2, 128), 128, np.uint8)
    path = write_planes(tmp_path / "a.mkv", "yuv444p", [[codes, grey, grey]], (1, 1, 1, 1))
    picture = FrameReader({"a": path}, transfer=Transfer.VLOG).read("a", 0)
    truth = 255 * srgb_from_linear(light_from_signal(Transfer.VLOG, (codes - 16.0) / 219))
    assert np.abs(picture - truth[..., None]).max() <= MIXED
