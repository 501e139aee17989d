"""Where foreground masks lie: what is surely masks is read, all else that seems so is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from sync.capture import find_capture
from sync.masks import find_masks, masks_folder, masks_unread


def lay(folder: Path, *files: str) -> Path:
    for file in ("videos/cam1.mp4", "videos/cam2.mp4", *files):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(b"content")
    return folder


@pytest.mark.parametrize("name", ["mask", "Masks", "fmask", "FMASK_lr", "seg"])
@pytest.mark.parametrize("inside", ["cam1/000000.png", "cam1.mp4"])
def test_masks_are_read_under_the_names_of_data_sets(tmp_path: Path, name: str, inside: str) -> None:
    capture = find_capture(lay(tmp_path, f"{name}/{inside}"))
    assert find_masks(capture) == {"cam1": (tmp_path / name / inside.removesuffix("/000000.png"))}
    assert not list(masks_unread(capture))


@pytest.mark.parametrize(
    "odd",
    ["mask/000000.png", "mask/frames/cam1/000000.png", "seg_masks/cam1/000000.png", "masks.zip", "pha/cam1/000000.png"],
)
def test_what_only_seems_to_be_masks_is_named_with_the_cure(tmp_path: Path, odd: str) -> None:
    capture = find_capture(lay(tmp_path, odd))
    assert find_masks(capture) == {}
    (note,) = masks_unread(capture)
    assert note.startswith(odd.partition("/")[0])
    assert "lay them there" in note


def test_masks_come_before_other_names_which_are_named(tmp_path: Path) -> None:
    capture = find_capture(lay(tmp_path, "mask/cam1/0.png", "fmask/cam1/0.png", "masking_tape.txt"))
    assert masks_folder(capture) == tmp_path / "mask"
    assert list(masks_unread(capture)) == [
        "fmask/ seems to hold foreground masks and is passed over: those of mask/ are read"
    ]
    capture = find_capture(lay(tmp_path, "masks/cam2/0.png"))
    assert find_masks(capture) == {"cam2": tmp_path / "masks/cam2"}
    assert [note.partition("/")[0] for note in masks_unread(capture)] == ["fmask", "mask"]


def test_what_is_read_under_another_name_must_fit_likewise(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cam3 belongs to no video; did you mean"):
        find_masks(find_capture(lay(tmp_path, "mask/cam1/0.png", "mask/cam3/0.png")))


@pytest.mark.parametrize("name", ["cam1_mask.mp4", "cam1-matte.mov", "cam1_MASKS/000000.png"])
def test_masks_among_the_videos_are_no_cameras(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"seems to be masks of cam1, .*move it to masks/cam1"):
        find_capture(lay(tmp_path, f"videos/{name}"))
    camera = Path(name).parts[0].partition(".")[0]
    (tmp_path / "capture.toml").write_text(f'ignore = ["{camera}"]')
    assert find_capture(tmp_path).cameras == ("cam1", "cam2")
