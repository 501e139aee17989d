"""Every stage reads the same pictures, whatever the cameras recorded them in."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from packuv.colour import linear_from_srgb
from packuv.footage import Transfer
from packuv.footage.transfer import CAMERA_PRIMARIES, bt709_from, light_from_signal
from pipelines.options import compose
from sync.align import AlignOptions
from sync.capture import find_capture
from tasks.artefacts.recipe import canonical
from tasks.artefacts.stage import Files, Site
from tasks.artefacts.store import Key
from tasks.stages.footage import RIG, Footage, PictureOptions, Take
from tasks.stages.synchronize import FOOTAGE, Synchronize, read_videos
from tests.support.artefacts import build_here, put
from tests.support.calibration_scene import ring
from tests.support.planes import write_planes

NEAR = 1.0
"""Codes of 255 between a picture and its 10-bit recording in log: half of a code each, and more in deep shadows"""
HEIGHT, WIDTH = 48, 64


def scene() -> np.ndarray:
    """uint8 [H, W, 3]: a grey ramp from dark to white and, below it, pale colours."""
    ramp = np.linspace(60, 250, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 3))
    ramp[HEIGHT // 2 :] *= (1.0, 0.93, 0.88)
    picture: np.ndarray = np.rint(ramp).astype(np.uint8)
    return picture


def recorded(transfer: Transfer) -> list[np.ndarray]:
    """Planes of 10-bit 4:4:4 by BT.709 of the scene as a camera records it."""
    signal = np.linspace(-0.07, 1.09, 200_001)
    light = linear_from_srgb(scene() / 255) @ np.linalg.inv(bt709_from(CAMERA_PRIMARIES[transfer])).T
    red, green, blue = np.moveaxis(np.interp(light, light_from_signal(transfer, signal), signal), 2, 0)
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    planes = (64 + 876 * luma, 512 + 896 * (blue - luma) / 1.8556, 512 + 896 * (red - luma) / 1.5748)
    return [np.rint(plane).astype(np.uint16) for plane in planes]


@pytest.fixture
def site(tmp_path: Path) -> Site:
    """Three cameras that film log in 10 bits without a tag that says so, the third of them in 12."""
    videos = tmp_path / "capture" / "videos"
    videos.mkdir(parents=True)
    planes = recorded(Transfer.VLOG)
    for name in ("cam00", "cam01"):
        write_planes(videos / f"{name}.mkv", "yuv444p10le", [planes] * 3, (1, 1, 2, 2))
    write_planes(videos / "cam02.mkv", "yuv444p12le", [[4 * plane for plane in planes]] * 3, (1, 1, 2, 2))
    return Site(tmp_path / "store", tmp_path / "capture", 1)


@pytest.fixture
def groups(site: Site, tmp_path: Path) -> Key:
    videos = Files({f"cam0{number}": "content" for number in range(3)})
    stage = Synchronize(videos=videos, timecodes=Files({}), fps=None, timecode_column=None, options=AlignOptions())
    _, folder = build_here(stage, site, tmp_path / "sync")
    return put(site, "sync", lambda out: shutil.copytree(folder, out, dirs_exist_ok=True))


def take(groups: Key, transfer: Transfer | None, **more: Key) -> Take:
    return Take(groups=groups, cameras=("cam00", "cam01", "cam02"), pictures=PictureOptions(transfer=transfer), **more)


def test_log_becomes_the_picture_that_was_filmed(site: Site, groups: Key) -> None:
    rig = ring(3, size=(WIDTH, HEIGHT))
    calibrated = put(site, "points", lambda out: rig.save(out / RIG))
    footage = Footage(take(groups, Transfer.VLOG, rig=calibrated), site)
    for picture in footage.filmed(1).values():
        assert np.abs(picture.astype(int) - scene()).max() <= NEAR
    views = footage.open_views()
    assert np.array_equal(views.pixels(0, 1), footage.filmed(1)["cam00"])


def test_a_video_that_two_cameras_have_is_named(site: Site, tmp_path: Path) -> None:
    def noted(**sha256: str) -> list[str]:
        stage = Synchronize(
            videos=Files(sha256), timecodes=Files({}), fps=None, timecode_column=None, options=AlignOptions()
        )
        notes, _ = build_here(stage, site, tmp_path / "sync")
        return [note for note in notes.get(FOOTAGE, []) if "to the byte" in note]

    assert not noted(cam00="a", cam01="b", cam02="c")
    (note,) = noted(cam00="a", cam01="b", cam02="a")
    assert note.startswith("the videos of cam00 and cam02 are the same to the byte")


def test_log_that_nobody_called_so_is_suspected(site: Site, groups: Key) -> None:
    watch = Footage(take(groups, None), site).watch_for_log()
    watch.passing(Footage(take(groups, None), site).filmed(0))
    assert watch.suspects == ["cam00", "cam01", "cam02"]
    watch.passing({"cam01": scene()})
    watch.passing(Footage(take(groups, None), site).filmed(1))
    assert watch.suspects == ["cam00", "cam02"]
    assert Footage(take(groups, Transfer.SDR), site).watch_for_log().suspects == []


def test_sync_tells_how_each_video_codes_colour(site: Site, groups: Key) -> None:
    colours = {name: video["colour"] for name, video in read_videos(site.path(groups)).items()}
    tags = {"matrix": "bt709", "transfer": None, "primaries": None, "range": "limited"}
    assert colours["cam00"] == {"pixel_format": "yuv444p10le", "bit_depth": 10, **tags}
    assert colours["cam02"] == {"pixel_format": "yuv444p12le", "bit_depth": 12, **tags}


def test_what_capture_toml_says_changes_what_stages_read(site: Site, groups: Key) -> None:
    (site.capture / "capture.toml").write_text('transfer = "vlog"')
    options = compose("draft", find_capture(site.capture).settings, {}).pictures
    assert options == PictureOptions(max_width=640, transfer=Transfer.VLOG)
    assert options.as_filmed == PictureOptions(transfer=Transfer.VLOG)
    assert canonical(take(groups, Transfer.VLOG).pictures) != canonical(take(groups, None).pictures)
