"""Foreground masks: what counts as foreground, and which shapes fit."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from packuv.footage import MaskReader
from sync.capture import check_masks, find_capture, find_masks


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
    with pytest.raises(ValueError, match="in the shape of the pictures of a, 32x32, but mask 0 is 32x24"):
        reader.read("a", 0)


def test_masks_belong_to_cameras_and_frames(tmp_path: Path) -> None:
    picture = np.zeros((24, 32), np.uint8)
    for camera in ("a", "b"):
        write_masks(tmp_path / "videos" / camera, [picture] * 3)
    assert find_masks(find_capture(tmp_path)) == {}
    write_masks(tmp_path / "masks" / "a", [picture] * 2)
    capture = find_capture(tmp_path)
    videos = {name: {"frames": 3, "width": 32, "height": 24} for name in "ab"}
    with pytest.raises(ValueError, match="a mask for each of the 3 frames of a, but has 2"):
        check_masks(capture, videos)
    cv2.imwrite(str(tmp_path / "masks" / "a" / "000003.png"), picture)
    with pytest.raises(ValueError, match="frame 2 is picture 2 and mask 3; number them alike"):
        check_masks(capture, videos)
    (tmp_path / "masks" / "a" / "000003.png").rename(tmp_path / "masks" / "a" / "000002.png")
    check_masks(capture, videos)
    with pytest.raises(ValueError, match="in the shape of the pictures of a, 48x24, but they are 32x24"):
        check_masks(capture, {"a": {"frames": 3, "width": 48, "height": 24}})
    (tmp_path / "masks" / "b").mkdir()
    with pytest.raises(ValueError, match=r"b must hold numbered masks, as 000000\.png, but holds none"):
        find_masks(capture)
    (tmp_path / "masks" / "b").rmdir()
    write_masks(tmp_path / "masks" / "c", [picture] * 3)
    with pytest.raises(ValueError, match="belongs to no video"):
        find_masks(capture)
