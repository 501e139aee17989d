"""Decoding is exact or refused; undistortion and colour follow their formulas."""

from __future__ import annotations

import json
import pickle
import resource
import shutil
import subprocess
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import packuv.footage.packets as packets_module
from packuv.budget import Budget
from packuv.camera import PinholeCamera
from packuv.footage.lens import LensCamera, undistorted_camera
from packuv.footage.packets import Packets, packet_seconds
from packuv.footage.planes import as_planes
from packuv.footage.reader import FrameReader
from packuv.footage.views import Views, _packed, _unpacked
from tests.support.needs import needs_ffmpeg

WIDTH, HEIGHT, COUNT = 96, 64, 40


def write_video(path: Path, pictures: Sequence[np.ndarray] | np.ndarray, *, ticks: Sequence[int] | None = None) -> None:
    """Lossless H.264 in RGB with B-frames and a key frame every 16, shown at `ticks` thirtieths of a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=30)
        stream.width, stream.height, stream.pix_fmt = pictures[0].shape[1], pictures[0].shape[0], "rgb24"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 30)
        stream.options = {"qp": "0", "g": "16", "bf": "2", "threads": "1", "preset": "veryfast"}
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = number if ticks is None else ticks[number], Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def numbered(count: int = COUNT) -> np.ndarray:
    """uint8 [n, H, W, 3]: pictures that differ everywhere from frame to frame."""
    y, x, n = np.mgrid[0:HEIGHT, 0:WIDTH, 0:count].transpose(0, 3, 1, 2)
    return np.stack([(3 * x + 5 * n) % 256, (2 * y + 7 * n) % 256, (x + y + 11 * n) % 256], axis=-1).astype(np.uint8)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("frames") / "a.mp4"
    write_video(path, numbered())
    return path


def camera(name: str = "a", *, width: int = WIDTH, height: int = HEIGHT) -> PinholeCamera:
    return PinholeCamera(name, width, height, 80.0, 82.0, width / 2 + 1.3, height / 2 - 0.7, np.eye(4))


def remux(source: Path, target: Path, *arguments: str) -> Path:
    command = ["ffmpeg", "-v", "error", "-y", *arguments, "-i", str(source), "-c", "copy", str(target)]
    subprocess.run(command, check=True)
    return target


@settings(max_examples=15)
@given(order=st.lists(st.integers(0, COUNT - 1), min_size=1, max_size=12))
def test_any_order_gives_the_frames_that_were_written(video: Path, order: list[int]) -> None:
    reader, truth = FrameReader({"a": video}), numbered()
    assert np.array_equal(reader.read_many("a", order), truth[order])
    assert all(np.array_equal(reader.read("a", frame), truth[frame]) for frame in order)


def test_dropped_frames_do_not_shift_the_count(tmp_path: Path) -> None:
    ticks = [tick for tick in range(COUNT) if tick % 7 != 3]
    write_video(tmp_path / "a.mp4", numbered()[ticks], ticks=ticks)
    reader = FrameReader({"a": tmp_path / "a.mp4"})
    assert reader.frame_count("a") == len(ticks)
    assert np.array_equal(reader.read_many("a", range(len(ticks))), numbered()[ticks])
    assert np.allclose(packet_seconds(tmp_path / "a.mp4"), np.array(ticks) / 30, atol=1e-9)


def test_what_packets_tell_of_a_long_video_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "a.mp4", numbered())
    kept = tmp_path / "kept"
    assert FrameReader({"a": tmp_path / "a.mp4"}, kept=kept).frame_count("a") == COUNT
    assert not kept.exists()  # a short one
    monkeypatch.setattr(packets_module, "LONG", COUNT)
    first = Packets.read(tmp_path / "a.mp4", kept)
    with monkeypatch.context() as patched:
        patched.setattr(packets_module, "_demuxed", lambda *_: pytest.fail("demuxed again"))
        again = Packets.read(tmp_path / "a.mp4", kept)
        reader = FrameReader({"a": tmp_path / "a.mp4"}, kept=kept)
        assert np.array_equal(reader.read_many("a", [33, 2]), numbered()[[33, 2]])
    assert np.array_equal(first.ticks, again.ticks)
    assert np.array_equal(first.keys, again.keys)
    assert (first.base, first.coding) == (again.base, again.coding)
    write_video(tmp_path / "a.mp4", numbered(20))  # another file of that name
    assert len(Packets.read(tmp_path / "a.mp4", kept).ticks) == 20


def test_closed_decoders_open_again(video: Path, tmp_path: Path) -> None:
    shutil.copy(video, tmp_path / "b.mp4")
    reader = FrameReader({"a": video, "b": tmp_path / "b.mp4"}, open_limit=1)
    for frame in (0, 1, 30, 2):
        for name in ("a", "b"):
            assert np.array_equal(reader.read(name, frame), numbered()[frame])
    reader.close()
    assert np.array_equal(reader.read("a", 5), numbered()[5])


def test_count_is_checked_against_the_timecodes(video: Path) -> None:
    reader = FrameReader({"a": video})
    reader.check_count("a", COUNT)
    with pytest.raises(ValueError, match=r"a\.mp4 has 40 frames, its timecodes 41; export"):
        reader.check_count("a", COUNT + 1)


def test_bad_input_names_file_and_frame(video: Path, tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("not a video")
    reader = FrameReader({"a": video, "gone": tmp_path / "gone.mp4", "text": tmp_path / "text.mp4"})
    with pytest.raises(ValueError, match=r"a\.mp4 has frames 0 to 39, but frame 40"):
        reader.read("a", COUNT)
    with pytest.raises(ValueError, match="no video of camera 'z'"):
        reader.read("z", 0)
    with pytest.raises(FileNotFoundError, match=r"gone\.mp4"):
        reader.read("gone", 0)
    with pytest.raises(ValueError, match=r"text\.mp4 cannot be read as a video"):
        reader.read("text", 0)


def test_a_truncated_file_gives_true_frames_or_an_error(video: Path, tmp_path: Path) -> None:
    """A fragmented file cut in half still opens."""
    whole = tmp_path / "whole.mkv"
    write_video(whole, numbered())
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    reader, right = FrameReader({"a": cut}), 0
    for frame in range(reader.frame_count("a")):
        try:
            picture = reader.read("a", frame)
        except ValueError as error:
            assert f"frame {frame}" in str(error)  # noqa: PT017 - either outcome is right, a wrong picture is not
            continue
        assert np.array_equal(picture, numbered()[frame])
        right += 1
    assert 10 <= right < COUNT


@needs_ffmpeg
def test_a_transport_stream_gives_true_frames_or_an_error(tmp_path: Path) -> None:
    """Seeking in MPEG-TS lands on later key frames; unchecked, most of these reads return a wrong picture."""
    source = tmp_path / "a.mp4"
    content, codec = ["-f", "lavfi", "-i", "testsrc2=s=192x128:r=30:d=2"], ["-c:v", "libx264", "-g", "16", "-bf", "2"]
    subprocess.run(["ffmpeg", "-v", "error", *content, *codec, str(source)], check=True)
    reader = FrameReader({"mp4": source, "ts": remux(source, tmp_path / "a.ts"), "mkv": tmp_path / "a.mkv"})
    refused = 0
    for frame in (17, 3, 39, 20, 0, 33):
        try:
            assert np.array_equal(reader.read("ts", frame), reader.read("mp4", frame))
        except ValueError as error:
            assert "remux" in str(error)  # noqa: PT017 - either outcome is right, a wrong picture is not
            refused += 1
    assert refused > 0
    remux(tmp_path / "a.ts", tmp_path / "a.mkv")
    assert np.array_equal(reader.read_many("mkv", range(60)), reader.read_many("mp4", range(60)))


@needs_ffmpeg
def test_a_cut_by_edit_list_counts_what_is_shown(video: Path, tmp_path: Path) -> None:
    reader = FrameReader({"a": remux(video, tmp_path / "cut.mp4", "-ss", "0.7")})
    count = reader.frame_count("a")
    assert count < COUNT
    assert np.array_equal(reader.read_many("a", range(count)), numbered()[COUNT - count :])


@given(
    st.integers(1, 6).flatmap(
        lambda c: st.lists(st.lists(st.integers(-1, 2**31 - 2), min_size=c, max_size=c), min_size=1, max_size=9)
    )
)
def test_frame_tables_survive_their_text_form(rows: list[list[int]]) -> None:
    frames = np.array(rows, dtype=np.int32)
    assert np.array_equal(_unpacked(_packed(frames), frames.shape[1]), frames)


def test_views_say_none_where_a_camera_has_no_frame(video: Path) -> None:
    views = Views({"a": video}, np.array([[3], [-1], [4]]), [LensCamera(camera())])
    assert views.picture(0, 1) is None
    assert views.pixels(0, 1) is None
    picture = views.picture(0, 2)
    assert picture is not None
    assert picture.dtype == np.float32
    assert np.array_equal(np.rint(picture * 255).astype(np.uint8), numbered()[4].transpose(2, 0, 1))


def test_views_survive_pickle_and_json(video: Path) -> None:
    lens = LensCamera(camera(), (-0.1, 0.02, 0.001, -0.002), (1.1, 0.9, 1.0), (-0.3, 0.05))
    light = np.linspace(-0.1, 0.1, 9).reshape(3, 1, 3)
    views = Views({"a": video}, np.array([[0], [-1], [5]]), [lens], max_width=48, light=light)
    again = [pickle.loads(pickle.dumps(views)), Views.from_spec(json.loads(json.dumps(views.to_spec())))]
    for other in again:
        assert other.names == views.names
        assert np.array_equal(other.frames, views.frames)
        assert np.array_equal(other.picture(0, 2), views.picture(0, 2))


def test_the_cache_keeps_within_its_bytes_and_changes_nothing(video: Path) -> None:
    frames = np.arange(COUNT)[:, None]
    small = Views({"a": video}, frames, [LensCamera(camera())], budget=Budget(3 * WIDTH * HEIGHT * 3))
    for instant in (0, 1, 2, 3, 1, 0, 9, 3):
        assert np.array_equal(small.pixels(0, instant), numbered()[instant])
        taken = small.budget.total_bytes - small.budget.free_bytes
        assert taken == sum(p.nbytes for p in small._cache.values()) <= small.budget.total_bytes


def test_what_does_not_fit_into_memory_is_read_from_disk_instead_of_decoded_again(video: Path, tmp_path: Path) -> None:
    frames, one = np.arange(COUNT)[:, None], WIDTH * HEIGHT * 3
    for total in (0, 2 * one):
        views = Views({"a": video}, frames, [LensCamera(camera())], budget=Budget(total), spill=tmp_path)
        for instant in range(4):
            views.pixels(0, instant)
        views.reader.close()
        views.reader = FrameReader({"a": tmp_path / "gone.mkv"})
        for instant in (3, 0, 2, 1, 0, 3):
            assert np.array_equal(views.pixels(0, instant), numbered()[instant])
        views.forget()
        assert views.budget.free_bytes == total
        with pytest.raises(FileNotFoundError):
            views.pixels(0, 0)
    assert not list(tmp_path.iterdir())  # the files have no names


def test_a_disk_without_room_for_pictures_has_them_decoded_again(video: Path, tmp_path: Path) -> None:
    frames = np.arange(4)[:, None]
    expected = [Views({"a": video}, frames, [LensCamera(camera())]).pixels(0, instant) for instant in range(4)]
    views = Views({"a": video}, frames, [LensCamera(camera())], budget=Budget(0), spill=tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))  # less than a picture
    try:
        for instant in (0, 3, 0, 1, 2):
            np.testing.assert_array_equal(views.pixels(0, instant), expected[instant])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_steady_pictures_undo_the_light_of_the_instant(video: Path) -> None:
    frames = np.array([[3], [4]])
    light = np.zeros((2, 1, 3))
    light[1, 0] = np.log([1.2, 1.0, 0.8])
    views = Views({"a": video}, frames, [LensCamera(camera())], light=light)
    assert np.array_equal(views.steady(0, 0), numbered()[3])
    filmed, steady = views.pixels(0, 1), views.steady(0, 1)
    assert filmed is not None
    assert steady is not None
    assert np.array_equal(steady[..., 1], filmed[..., 1])
    again = views.response(0, 1).shown(as_planes(steady)) * 255
    bright = (steady > 0) & (steady < 255)
    assert np.abs(again.transpose(1, 2, 0) - filmed)[bright].max() <= 0.6  # steady ones are rounded to bytes
    picture = views.picture(0, 1)
    assert np.abs(picture.transpose(1, 2, 0) * 255 - steady)[bright].max() <= 0.6


def test_downscaling_averages_and_scales_the_camera(video: Path) -> None:
    views = Views({"a": video}, np.array([[0]]), [LensCamera(camera())], max_width=WIDTH // 2)
    truth = numbered()[0].reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    pixels = views.pixels(0, 0)
    assert pixels is not None
    assert np.abs(pixels - truth).max() <= 0.5 + 1e-6
    assert (views.cameras[0].width, views.cameras[0].height) == (WIDTH // 2, HEIGHT // 2)
    assert views.cameras[0].cx == pytest.approx(camera().cx / 2)


def distort(lens: LensCamera, rays: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of rays [n, 2] by the Brown-Conrady formula, written out."""
    k1, k2, p1, p2 = lens.distortion
    x, y = rays.T
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    pinhole = lens.pinhole
    return np.stack([pinhole.fx * xd + pinhole.cx, pinhole.fy * yd + pinhole.cy], axis=1)


@pytest.mark.parametrize("distortion", [(-0.25, 0.06, 0.002, -0.001), (0.2, -0.02, -0.001, 0.003)])
def test_undistortion_shows_each_ray_where_the_pinhole_puts_it(
    tmp_path: Path, distortion: tuple[float, float, float, float]
) -> None:
    lens = LensCamera(camera(width=320, height=240), distortion)
    y, x = np.mgrid[0:240, 0:320] + 0.5
    # Smooth in filmed pixel position, so interpolation adds less than a grey value.
    filmed = np.stack([128 + 120 * np.sin(x / 21), 128 + 120 * np.cos(y / 17), 0.4 * x + 0.4 * y], axis=-1)
    write_video(tmp_path / "a.mp4", [np.rint(filmed).astype(np.uint8)])
    views = Views({"a": tmp_path / "a.mp4"}, np.array([[0]]), [lens])
    target = views.cameras[0]
    rays = np.stack([(x - target.cx) / target.fx, (y - target.cy) / target.fy], axis=-1).reshape(-1, 2)
    u, v = distort(lens, rays).T.reshape(2, 240, 320)
    assert u.min() >= -1e-6
    assert u.max() <= 320 + 1e-6
    assert v.min() >= -1e-6
    assert v.max() <= 240 + 1e-6
    # Some border pixel must touch the filmed border, or the camera is narrower than it need be; its centre is half a
    # pixel inside, and this lens squeezes 2.5 filmed pixels into one at the corner, in both directions.
    assert min(u.min(), 320 - u.max(), v.min(), 240 - v.max()) < 2.0
    expected = np.stack([128 + 120 * np.sin(u / 21), 128 + 120 * np.cos(v / 17), 0.4 * u + 0.4 * v], axis=-1)
    pixels = views.pixels(0, 0)
    assert pixels is not None
    inner = np.s_[2:-2, 2:-2]
    # 0.5 for each of two roundings, and 1/32 px of fixed-point map times the steepest slope of 7 a pixel.
    assert np.abs(pixels[inner] - expected[inner]).max() < 1.5


def test_a_folding_lens_is_cropped_before_the_fold_or_refused() -> None:
    safe = undistorted_camera(LensCamera(camera(width=320, height=240), (-0.45, 0.0, 0.0, 0.0)))
    corner = max(safe.width - safe.cx, safe.cx) / safe.fx, max(safe.height - safe.cy, safe.cy) / safe.fy
    # The fold is where 3 * 0.45 * r2 = 1; it is searched in steps of a thousandth of the border's distance.
    assert 3 * 0.45 * (corner[0] ** 2 + corner[1] ** 2) < 1.002
    with pytest.raises(ValueError, match="do not map the picture one to one"):
        undistorted_camera(LensCamera(camera(), (-400.0, 0.0, 0.0, 0.0)))


def test_mismatched_views_are_refused(video: Path) -> None:
    lens = LensCamera(camera())
    with pytest.raises(ValueError, match=r"frames must be \[T, C\] with C = 1"):
        Views({"a": video}, np.zeros((3, 2), dtype=np.int32), [lens])
    with pytest.raises(ValueError, match=r"cameras \['a'\] have no video"):
        Views({"b": video}, np.zeros((3, 1), dtype=np.int32), [lens])
    with pytest.raises(ValueError, match="the video is 96x64, its calibration 128x64"):
        Views({"a": video}, np.zeros((1, 1)), [LensCamera(camera(width=128))]).pixels(0, 0)
    with pytest.raises(ValueError, match="a lens has one of"):
        LensCamera(camera(), (0.1, 0.2))
