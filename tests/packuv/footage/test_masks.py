"""Foreground masks: what counts as foreground, and which shapes fit."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from packuv.footage import MaskReader
from packuv.footage.png import MARK, png_size
from sync.capture import find_capture
from sync.masks import check_masks, find_masks


def write_masks(folder: Path, masks: list[np.ndarray]) -> Path:
    folder.mkdir(parents=True)
    for number, mask in enumerate(masks):
        cv2.imwrite(str(folder / f"{number:06d}.png"), mask)
    return folder


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_labels_are_foreground_in_the_size_of_the_pictures(tmp_path: Path, scale: int, kind: type) -> None:
    labels = np.random.default_rng(0).integers(0, 3, (24, 32)).astype(kind)
    reader = MaskReader({"a": write_masks(tmp_path / "a", [labels])}, {"a": (32 * scale, 24 * scale)})
    wanted = np.kron(labels > 0, np.ones((scale, scale), bool))
    assert np.array_equal(reader.read("a", 0)[:, :, 0] == 255, wanted)


def test_a_mask_of_another_shape_is_refused(tmp_path: Path) -> None:
    reader = MaskReader({"a": write_masks(tmp_path / "a", [np.zeros((24, 32), np.uint8)])}, {"a": (32, 32)})
    with pytest.raises(ValueError, match=r"in the shape of the pictures of a, 32x32, but 000000\.png is 32x24"):
        reader.read("a", 0)


def test_masks_belong_to_cameras_and_frames(tmp_path: Path) -> None:
    picture = np.zeros((24, 32), np.uint8)
    for camera in ("a", "b"):
        write_masks(tmp_path / "videos" / camera, [picture] * 3)
    assert find_masks(find_capture(tmp_path)) == {}
    masks = write_masks(tmp_path / "masks" / "a", [picture] * 2)
    capture = find_capture(tmp_path)
    with pytest.raises(ValueError, match="a mask for each of the 3 frames of a, but has 2"):
        check_masks(capture, "a")
    (masks / "last.png").write_bytes((masks / "000001.png").read_bytes())
    with pytest.raises(ValueError, match=r"but has 2, and last\.png without a number; add"):
        check_masks(capture, "a")
    (masks / "last.png").unlink()
    (masks / "000002.png").touch()
    with pytest.raises(ValueError, match=r"000002\.png is an empty file, but must hold a mask"):
        check_masks(capture, "a")
    (masks / "000002.png").unlink()
    cv2.imwrite(str(masks / "000003.png"), picture)
    with pytest.raises(ValueError, match="frame 2 is picture 2 and mask 3; number them alike"):
        check_masks(capture, "a")
    (masks / "000003.png").rename(masks / "000002.png")
    assert check_masks(capture, "a") == (32, 24)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda masks: (masks / "b").mkdir(), r"b must hold numbered masks, as 000000\.png, but holds none"),
        (lambda masks: shutil.copytree(masks / "a", masks / "c"), "c belongs to no video"),
        (
            lambda masks: shutil.move(masks / "a" / "000002.png", masks),
            r"no camera's folder: 1, the first of them 000002\.png",
        ),
        (lambda masks: masks.rename(masks.with_name("kept")).with_name("masks").touch(), "masks must be a folder"),
        (lambda masks: shutil.rmtree(masks / "a"), "must hold masks as <camera>/000000"),
    ],
)
def test_masks_that_lie_elsewhere_are_told_where_they_belong(
    tmp_path: Path, spoil: Callable[[Path], object], told: str
) -> None:
    picture = np.zeros((24, 32), np.uint8)
    for camera in ("videos/a", "videos/b", "masks/a"):
        write_masks(tmp_path / camera, [picture] * 3)
    spoil(tmp_path / "masks")
    with pytest.raises(ValueError, match=told):
        find_masks(find_capture(tmp_path))


def test_a_png_that_is_cut_or_changed_anywhere_is_not_whole() -> None:
    picture = np.random.default_rng(0).integers(0, 2, (9, 13)).astype(np.uint8)
    file = cv2.imencode(".png", picture)[1].tobytes()
    assert png_size(file) == (13, 9)
    for at in range(len(MARK), len(file)):
        changed = bytearray(file)
        changed[at] ^= 1 << at % 8
        for wrong in (file[:at], bytes(changed)):
            with pytest.raises(ValueError, match=r"cut short|not those that were written"):
                png_size(wrong)


def spoil_png(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def spoil_jpeg(path: Path) -> None:
    for mask in path.parent.iterdir():
        cv2.imwrite(str(mask.with_suffix(".jpg")), cv2.imread(str(mask)))
        mask.unlink()
    spoil_png(path.with_suffix(".jpg"))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (spoil_png, r"a: 000001\.png is damaged: it is cut short"),
        (spoil_jpeg, r"a: 000001\.jpg is damaged: parts of it cannot be decoded"),
        (lambda path: path.write_bytes(b"no picture"), r"000001\.png cannot be decoded"),
        (lambda path: cv2.imwrite(str(path), np.zeros((24, 24), np.uint8)), r"000001\.png is 24x24"),
    ],
)
def test_one_bad_mask_among_many_is_found_and_named(tmp_path: Path, spoil: Callable[[Path], object], told: str) -> None:
    circle = cv2.circle(np.zeros((24, 32), np.uint8), (16, 12), 9, 255, -1)
    masks = write_masks(tmp_path / "a", [circle] * 3)
    sizes = {"a": (64, 48)}  # of which masks are half
    MaskReader({"a": masks}, sizes).check("a")
    spoil(masks / "000001.png")
    with pytest.raises(ValueError, match=told):
        MaskReader({"a": masks}, sizes).check("a")
