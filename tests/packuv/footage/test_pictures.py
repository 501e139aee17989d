"""Folders of pictures are read as videos are: by number of the frame, turned, in sRGB, damage told."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from packuv.colour import srgb_from_linear
from packuv.footage.damage import Damage, DamagedPictureError
from packuv.footage.pictures import PICTURE_SUFFIXES
from packuv.footage.reader import FrameReader
from packuv.footage.transfer import BT2020, CAMERA_PRIMARIES, D65, Transfer, bt709_from, light_from_signal
from packuv.footage.turn import Turn, exif_orientation
from sync import pictures as sync_pictures
from tests.support.pictures import exif, write_exr, write_picture

RNG = np.random.default_rng(0)
ROUNDED = 0.01
"""Codes by which the table of signals, 1/200 of a code fine, may miss the border of two codes"""
PICTURE = cv2.resize(RNG.integers(0, 256, (12, 16, 3)).astype(np.uint8), (64, 48), interpolation=cv2.INTER_CUBIC)


def reader_of(folder: Path, **options) -> FrameReader:
    return FrameReader({"a": folder}, **options)


def test_the_same_suffixes_are_read_as_are_found() -> None:
    assert PICTURE_SUFFIXES == sync_pictures.PICTURE_SUFFIXES


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(48, 64, 3), (48, 64)])
def test_png_keeps_its_values(tmp_path: Path, kind: type, shape: tuple[int, ...]) -> None:
    most = np.iinfo(kind).max
    pictures = [RNG.integers(0, most, shape, endpoint=True).astype(kind) for _ in range(3)]
    for number, picture in enumerate(pictures):
        write_picture(tmp_path / f"{number:03d}.png", picture)
    reader = reader_of(tmp_path)
    assert reader.frame_count("a") == 3
    for number in (2, 0, 1):
        wanted = pictures[number] / most * 255
        wanted = wanted if len(shape) == 3 else np.repeat(wanted[..., None], 3, axis=2)
        assert np.abs(reader.read("a", number) - wanted).max() <= 0.5 + ROUNDED
    with pytest.raises(ValueError, match="frames 0 to 2"):
        reader.read("a", 3)


def test_alpha_is_passed_over(tmp_path: Path) -> None:
    content = np.dstack([PICTURE[..., ::-1], RNG.integers(0, 256, PICTURE.shape[:2]).astype(np.uint8)])
    cv2.imwrite(str(tmp_path / "1.png"), content)
    assert np.array_equal(reader_of(tmp_path).read("a", 0), PICTURE)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_exif_says(tmp_path: Path, orientation: int) -> None:
    upright = write_picture(tmp_path / "a" / "0.jpg", PICTURE)
    turned = write_picture(tmp_path / "b" / "0.jpg", PICTURE, orientation=orientation)
    assert exif_orientation(turned.read_bytes()) == orientation
    shown = cv2.imread(str(turned))  # which turns pictures
    stored = cv2.imread(str(upright))
    assert np.array_equal(Turn.of_orientation(orientation).shown(stored), shown)
    plain = reader_of(upright.parent).read("a", 0)
    assert np.array_equal(reader_of(turned.parent).read("a", 0), Turn.of_orientation(orientation).shown(plain))
    info = sync_pictures_size(turned.parent)
    assert info == shown.shape[1::-1]


def sync_pictures_size(folder: Path) -> tuple[int, int]:
    from sync.probe import probe_video

    info = probe_video(folder)
    return info.width, info.height


def test_exif_of_png_and_of_both_byte_orders() -> None:
    little = b"II\x2a\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    for tiff, code in ((exif(5), 5), (little, 6), (little[:17], 1), (b"", 1)):
        png = b"\x89PNG\r\n\x1a\n" + len(tiff).to_bytes(4) + b"eXIf" + tiff + b"\0\0\0\0"
        assert exif_orientation(png) == code


def test_exr_is_light(tmp_path: Path) -> None:
    light = np.linspace(-0.1, 1.2, 48 * 64 * 3, dtype=np.float32).reshape(48, 64, 3)
    light[0, 0] = np.nan
    write_exr(tmp_path / "0.exr", light)
    shown = reader_of(tmp_path, transfer=Transfer.SLOG3).read("a", 0)
    exact = srgb_from_linear(np.clip(np.nan_to_num(light), 0, 1)) * 255
    assert np.abs(shown - exact).max() <= 0.5 + 0.06  # steps of 1/65535 light are 0.05 codes in the dark
    assert (shown[np.clip(light, 0, 1) == 0] == 0).all()


def with_primaries(content: bytes, points: object) -> bytes:
    """An EXR file, as FFmpeg writes it, that names its primaries and its white."""
    at = 8
    while content[at]:
        kind = content.index(b"\0", at) + 1
        size = content.index(b"\0", kind) + 1
        at = size + 4 + int.from_bytes(content[size : size + 4], "little")
    said = b"chromaticities\0chromaticities\0" + (32).to_bytes(4, "little") + np.array(points, "<f4").tobytes()
    # The file says where its lines are, which now are further on.
    first = int.from_bytes(content[at + 1 : at + 9], "little")
    count = (first - at - 1) // 8
    lines = np.frombuffer(content, "<u8", count, at + 1) + len(said)
    return content[:at] + said + b"\0" + lines.astype("<u8").tobytes() + content[first:]


def test_primaries_of_exr(tmp_path: Path) -> None:
    light = np.random.default_rng(1).random((48, 64, 3)).astype(np.float32)
    path = write_exr(tmp_path / "0.exr", light)
    content = path.read_bytes()
    path.write_bytes(with_primaries(content, [*BT2020, D65]))
    mixed = np.clip(light @ bt709_from(BT2020).T, 0, 1)
    assert np.abs(reader_of(tmp_path).read("a", 0) - srgb_from_linear(mixed) * 255).max() <= 0.6
    path.write_bytes(with_primaries(content, [(0.7347, 0.2653), (0, 1), (0.0001, -0.077), (0.32168, 0.33767)]))
    with pytest.raises(ValueError, match=r"its white is 0\.3217, 0\.3377, but must be D65"):
        reader_of(tmp_path).read("a", 0)


def test_16_bits_of_log_become_what_the_curve_says(tmp_path: Path) -> None:
    code = RNG.integers(0, 1 << 16, (48, 64, 3)).astype(np.uint16)
    write_picture(tmp_path / "0.png", code)
    shown = reader_of(tmp_path, transfer=Transfer.LOGC3).read("a", 0)
    light = light_from_signal(Transfer.LOGC3, code / 65535) @ bt709_from(CAMERA_PRIMARIES[Transfer.LOGC3]).T
    assert np.abs(shown - srgb_from_linear(np.clip(light, 0, 1)) * 255).max() < 1


@pytest.mark.parametrize("careful", [False, True])
def test_pictures_that_cannot_be_decoded_are_lost(tmp_path: Path, careful: bool) -> None:
    for number in range(4):
        write_picture(tmp_path / f"{number}.png", PICTURE)
    whole = (tmp_path / "1.png").read_bytes()
    (tmp_path / "1.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "2.png").write_bytes(b"content")
    reader = reader_of(tmp_path, careful=careful)
    for number in range(4):
        try:
            assert np.array_equal(reader.read("a", number), PICTURE)
        except (DamagedPictureError, AssertionError):
            assert number in (1, 2)
    damage = reader.damage("a")
    assert damage.keys() == {1, 2}
    assert damage[2] is Damage.LOST


def test_wrong_bytes_in_a_jpeg_are_found(tmp_path: Path) -> None:
    for number in range(3):
        write_picture(tmp_path / f"{number}.jpg", RNG.integers(0, 256, (240, 320, 3)).astype(np.uint8))
    content = bytearray((tmp_path / "1.jpg").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 40] = bytes(40)
    (tmp_path / "1.jpg").write_bytes(content)
    reader = reader_of(tmp_path, careful=True)
    for number in range(3):
        reader.read("a", number)
    assert reader.damage("a") == {1: Damage.CONCEALED}


def test_an_empty_folder_is_no_video(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no numbered pictures"):
        reader_of(tmp_path).read("a", 0)


@pytest.mark.parametrize("quarter", [0, 90, 180, 270])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_display_matrix_turns_points(quarter: int, flipped: bool) -> None:
    angle = np.deg2rad(quarter)
    a, b, c, d = (round(float(v)) for v in (np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)))
    if flipped:
        a, c = -a, -c

    class Frame:
        rotation = 0
        side_data = {"DISPLAYMATRIX": np.array([a, b, 0, c, d, 0, 0, 0, 1], np.int32).tobytes()}  # noqa: RUF012

    shown = Turn.of_frame(Frame()).shown(PICTURE)  # type: ignore[arg-type]  # all that is asked of a frame
    height, width = PICTURE.shape[:2]
    y, x = np.mgrid[0:height, 0:width]
    across, down = a * x + c * y, b * x + d * y
    wanted = np.zeros_like(shown)
    wanted[down - down.min(), across - across.min()] = PICTURE
    assert np.array_equal(shown, wanted)
