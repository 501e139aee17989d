"""Chapters of recordings, joined into videos."""

from __future__ import annotations

import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import av
import numpy as np
import pytest

from packuv.progress import no_progress
from pipelines.cli import main
from pipelines.join import join
from sync.capture import find_capture
from sync.probe import probe_video
from tests.support.needs import need, needs_ffmpeg

pytestmark = needs_ffmpeg

FRAMES = (20, 25, 7)


def film(
    path: Path, first: int, frames: int, *, size: str = "64x48", label: str | None = None, flags: tuple[str, ...] = ()
) -> None:
    """A chapter with sound that ends a little after its pictures; each picture shows its number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    seconds = frames / 25
    subprocess.run(
        ["ffmpeg", "-v", "error", "-y", "-f", "lavfi", "-i", f"testsrc=size={size}:rate=25:duration=60",
         "-f", "lavfi", "-i", f"sine=440:duration={seconds + 0.03}",
         "-vf", f"trim=start_frame={first}:end_frame={first + frames},setpts=PTS-STARTPTS",
         "-c:v", "libx264", "-bf", "2", "-c:a", "aac", *(("-timecode", label) if label else ()), *flags, path],
        check=True,
    )  # fmt: skip


def pictures(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]


def record(place: Path, names: tuple[str, ...], **options: str) -> list[np.ndarray]:
    """Chapters of these names; what they show, one after another."""
    firsts = np.cumsum([0, *FRAMES[:-1]])
    for name, first, frames in zip(names, firsts, FRAMES, strict=True):
        film(place / name, int(first), frames, **(options if not first else {}))
    return [picture for name in names for picture in pictures(place / name)]


@pytest.mark.parametrize("names", [("GX010042.MP4", "GX020042.MP4", "GX030042.MP4"),
                                   ("GOPR0042.MP4", "GP010042.MP4", "GP020042.MP4")])  # fmt: skip
@pytest.mark.parametrize("own_folder", [True, False])
def test_chapters_become_one_video_of_the_same_pictures(tmp_path: Path, names, own_folder) -> None:
    inside = tmp_path / "videos"
    shown = record(inside / "cam1" if own_folder else inside, names, label="10:00:00:05")
    film(inside / "cam2.mp4", 0, 52)
    with pytest.raises(ValueError, match=rf"has what its recorder cut it into, {names[0]}.*packuv join"):
        find_capture(tmp_path)
    (joined,) = join(tmp_path, no_progress)
    video = inside / ("cam1.mp4" if own_folder else f"{names[1][:2]}0042.mp4")
    assert (joined.video, joined.chapters, joined.frames) == (video, 3, sum(FRAMES))
    info = probe_video(video)
    assert set(np.diff(info.pts_ns).tolist()) == {40_000_000}
    assert info.start_label == "10:00:00:05"
    assert np.array_equal(pictures(video), shown)
    assert sorted(path.name for path in (tmp_path / "chapters" / video.stem).iterdir()) == sorted(names)
    assert sorted(path.name for path in inside.iterdir()) == sorted([video.name, "cam2.mp4"])
    assert len(find_capture(tmp_path).cameras) == 2
    assert join(tmp_path, no_progress) == []


def test_a_joined_video_whose_chapters_were_not_put_away_yet_is_kept(tmp_path: Path) -> None:
    inside = tmp_path / "videos" / "cam1"
    record(inside, ("GX010042.MP4", "GX020042.MP4", "GX030042.MP4"))
    join(tmp_path, no_progress)
    video = tmp_path / "videos" / "cam1.mp4"
    before = video.read_bytes()
    (tmp_path / "chapters" / "cam1").rename(inside)
    (joined,) = join(tmp_path, no_progress)
    assert joined.frames == sum(FRAMES)
    assert video.read_bytes() == before
    assert not inside.exists()


def test_what_does_not_go_on_is_not_joined(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inside = tmp_path / "videos" / "cam1"
    film(inside / "GX010042.MP4", 0, 5)
    film(inside / "GX030042.MP4", 5, 5)
    assert main(["join", str(tmp_path)]) == 2
    assert "lacks number 2 of 3; copy it from the camera's card" in capsys.readouterr().err
    film(inside / "GX020042.MP4", 5, 5, size="32x32")
    assert main(["join", str(tmp_path)]) == 2
    assert "GX020042.MP4 differs from GX010042.MP4 in size" in capsys.readouterr().err
    film(inside / "GX010043.MP4", 0, 5)
    assert main(["join", str(tmp_path)]) == 2
    assert "the chapters of one recording, but has those of GX0042, GX0043" in capsys.readouterr().err
    assert sorted(path.name for path in inside.iterdir()) == [f"GX0{k}0042.MP4" for k in (1,)] + [
        "GX010043.MP4", "GX020042.MP4", "GX030042.MP4"]  # fmt: skip
    assert not (tmp_path / "chapters").exists()
    assert main(["join", str(tmp_path / "nowhere")]) == 2


def test_without_chapters_there_is_nothing_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film(tmp_path / "videos" / "GX010042.MP4", 0, 5)
    film(tmp_path / "videos" / "GX010043.MP4", 0, 5)
    assert main(["join", str(tmp_path)]) == 0
    assert "no camera has chapters to join" in capsys.readouterr().out
    assert find_capture(tmp_path).cameras == ("GX010042", "GX010043")


@pytest.mark.parametrize(
    ("flags", "named"),
    [(("-x264-params", "cabac=0"), "the set-up of its codec"), (("-ar", "32000"), "sound"), (("-r", "50"), "rate")],
)
def test_chapters_that_one_decoder_cannot_read_are_not_joined(tmp_path: Path, flags, named) -> None:
    inside = tmp_path / "videos" / "cam1"
    film(inside / "GX010042.MP4", 0, 20)
    film(inside / "GX020042.MP4", 20, 20, flags=flags)
    with pytest.raises(ValueError, match=f"GX020042.MP4 differs from GX010042.MP4 in .*{named}"):
        join(tmp_path, no_progress)
    assert not (tmp_path / "videos" / "cam1.mp4").exists()


def test_sound_that_only_a_later_chapter_has_is_told(tmp_path: Path) -> None:
    inside = tmp_path / "videos" / "cam1"
    film(inside / "GX010042.MP4", 0, 20, flags=("-an",))
    film(inside / "GX020042.MP4", 20, 20)
    with pytest.raises(ValueError, match="in sound"):
        join(tmp_path, no_progress)


@pytest.mark.parametrize(("label", "goes_on"), [("10:00:00:20", True), ("10:00:00:00", True), ("10:00:59:00", False)])
def test_labels_must_go_on_or_be_the_first_one_again(tmp_path: Path, label: str, goes_on: bool) -> None:
    inside = tmp_path / "videos" / "cam1"
    film(inside / "GX010042.MP4", 0, 20, label="10:00:00:00")
    film(inside / "GX020042.MP4", 20, 20, label=label)
    if goes_on:
        assert join(tmp_path, no_progress)[0].frames == 40
    else:
        with pytest.raises(ValueError, match=r"is labelled 10:00:59:00, \+58\.2 s from there"):
            join(tmp_path, no_progress)


def test_what_is_in_the_way_is_neither_lost_nor_taken_for_ours(tmp_path: Path) -> None:
    inside = tmp_path / "videos" / "cam1"
    film(inside / "GX010042.MP4", 0, 20)
    film(inside / "GX020042.MP4", 20, 20)
    film(tmp_path / "videos" / "cam1.mp4", 5, 40)
    with pytest.raises(ValueError, match=r"cam1\.mp4 is not what .* make"):
        join(tmp_path, no_progress)
    (tmp_path / "videos" / "cam1.mp4").unlink()
    (old := tmp_path / "chapters" / "cam1" / "GX010042.MP4").parent.mkdir(parents=True)
    old.write_bytes(b"another take")
    with pytest.raises(FileExistsError, match="in the way"):
        join(tmp_path, no_progress)
    assert old.read_bytes() == b"another take"
    assert not (tmp_path / "videos" / "cam1.mp4").exists()


def test_what_a_killed_run_left_is_gone_on_from(tmp_path: Path) -> None:
    """A part of the video, and, later, chapters of which only the first is put away."""
    inside = tmp_path / "videos"
    names = ("GX010042.MP4", "GX020042.MP4", "GX030042.MP4")
    shown = record(inside, names)
    (stale := inside / ".GX0042.mp4.123-456.partial.mp4").write_bytes(b"half")
    join(tmp_path, no_progress)
    assert not stale.exists()
    place, video = tmp_path / "chapters" / "GX0042", inside / "GX0042.mp4"
    before = video.read_bytes()
    for left in (names[1:], names[2:]):
        for name in left:
            (place / name).rename(inside / name)
        with pytest.raises(ValueError, match="packuv join"):
            find_capture(tmp_path)
        (joined,) = join(tmp_path, no_progress)
        assert (joined.chapters, joined.frames, video.read_bytes()) == (3, sum(FRAMES), before)
        assert sorted(path.name for path in place.iterdir()) == sorted(names)
        assert [path.name for path in inside.iterdir()] == [video.name]
    video.unlink()  # and what is put away can be joined anew
    (place / names[2]).rename(inside / names[2])
    join(tmp_path, no_progress)
    assert np.array_equal(pictures(video), shown)


def test_two_files_of_one_chapter_are_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inside = tmp_path / "videos" / "cam1"
    for name in ("GX010042.MOV", "GX010042.MP4", "GX020042.MP4"):
        film(inside / name, 0, 5)
    assert main(["join", str(tmp_path)]) == 2
    assert "hold each chapter once, but GX010042.MOV and GX010042.MP4 are the same one" in capsys.readouterr().err
    assert len(list(inside.iterdir())) == 3


def test_another_disk_is_noticed_before_anything_is_written(tmp_path: Path) -> None:
    other = Path("/dev/shm")
    apart = other.is_dir() and other.stat().st_dev != tmp_path.stat().st_dev
    need("shm", apart, "no second file system at /dev/shm")
    record(tmp_path / "videos" / "cam1", ("GX010042.MP4", "GX020042.MP4", "GX030042.MP4"))
    with TemporaryDirectory(dir=other) as elsewhere:
        (tmp_path / "chapters").symlink_to(elsewhere)
        with pytest.raises(OSError, match="must be on the disk of"):
            join(tmp_path, no_progress)
    assert not (tmp_path / "videos" / "cam1.mp4").exists()


def test_when_it_was_begun_and_how_its_codec_is_tagged_is_kept(tmp_path: Path) -> None:
    inside = tmp_path / "videos" / "cam1"
    coded = ("-c:v", "libx265", "-x265-params", "log-level=none", "-tag:v", "hvc1")
    for number in (1, 2):
        begun = ("-metadata", f"creation_time=2026-03-04T05:06:0{number}Z")
        film(inside / f"GX0{number}0042.MP4", 20 * (number - 1), 20, flags=(*coded, *begun))
    join(tmp_path, no_progress)
    with av.open(str(tmp_path / "videos" / "cam1.mp4")) as video:
        assert video.streams.video[0].codec_context.codec_tag == "hvc1"
        assert video.metadata["creation_time"].startswith("2026-03-04T05:06:01")
