import av
import numpy as np
import pytest

from packuv.footage import LensCamera, Silhouettes, Views
from packuv.motion import BackgroundOptions, find_background, load_stills, save_stills
from packuv.motion.background import bordered

FRAMES, HEIGHT, WIDTH = 9, 48, 64


def scene(instant: int, *, stops: bool) -> np.ndarray:
    """A plain gradient, before which a bright square passes, or stands for the last two thirds of the time."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:] = np.linspace(20, 120, WIDTH)[None, :, None]
    left = 6 * min(instant, 3 if stops else FRAMES)
    pixels[10:20, left : left + 8] = 250
    return pixels


@pytest.fixture
def views(ring, tmp_path) -> Views:
    """Three cameras: one sees the square pass, one sees it stop, one filmed two instants only."""
    cameras = ring(3, width=WIDTH, height=HEIGHT)
    for camera, stops in zip(cameras, (False, True, False), strict=True):
        with av.open(str(tmp_path / f"{camera.name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "bgr0"
            for instant in range(FRAMES):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(scene(instant, stops=stops), format="rgb24")))
            container.mux(stream.encode())
    frames = np.tile(np.arange(FRAMES)[:, None], (1, 3))
    frames[2:, 2] = -1
    videos = {camera.name: tmp_path / f"{camera.name}.mkv" for camera in cameras}
    return Views(videos, frames, [LensCamera(camera) for camera in cameras])


def test_what_passes_is_not_in_the_background(views):
    passing = find_background(views, BackgroundOptions(instants=FRAMES))[0]
    empty = np.broadcast_to(np.linspace(20, 120, WIDTH).astype(np.uint8)[None, :, None], (HEIGHT, WIDTH, 3))
    np.testing.assert_array_equal(passing.pixels, empty)
    assert passing.known.all()


def test_where_somebody_stands_for_long_is_told_from_what_is_known(views):
    standing = find_background(views, BackgroundOptions(instants=FRAMES, agreement=0.8))[1]
    # Two thirds of the instants show the square at columns 18 to 25: fewer than four fifths.
    assert not standing.known[10:20, 18:26].any()
    assert standing.known[30:].all()


def test_what_masks_cover_is_no_background_and_what_they_leave_too_seldom_is_unknown(views, tmp_path):
    covered = np.stack([scene(instant, stops=True)[:, :, 0] == 250 for instant in range(FRAMES)])
    with av.open(str(tmp_path / "mask.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        for mask in covered:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(255 * mask.astype(np.uint8), format="gray")))
        container.mux(stream.encode())
    masks = Views({"cam1": tmp_path / "mask.mkv"}, views.frames[:, 1:2], views.lenses[1:2])
    silhouettes, options = Silhouettes(masks), BackgroundOptions(instants=FRAMES)
    free = (~np.stack([bordered(mask) for mask in covered])).sum(axis=0)
    empty = np.broadcast_to(np.linspace(20, 120, WIDTH).astype(np.uint8)[None, :, None], (HEIGHT, WIDTH, 3))
    for least in (1, 3):
        still = find_background(views, options, silhouettes=silhouettes, least=least)[1]
        np.testing.assert_array_equal(still.known, free >= least)
        np.testing.assert_array_equal(still.pixels[still.known], empty[still.known])
    assert (free < 3).any()
    assert (find_background(views, options)[1].pixels[10:20, 20:24] == 250).all()  # as it is without masks
    other, plain = (find_background(views, options, silhouettes=one)[0] for one in (silhouettes, None))
    np.testing.assert_array_equal(other.pixels, plain.pixels)  # of a camera without masks


def test_cameras_that_filmed_too_little_have_no_background(views):
    assert [still.camera for still in find_background(views, BackgroundOptions(instants=FRAMES))] == [0, 1]
    assert find_background(views, BackgroundOptions(instants=2)) == []


def test_options_refuse_shares_that_leave_nothing():
    with pytest.raises(ValueError, match="agreement"):
        BackgroundOptions(agreement=1.5)


def test_saved_backgrounds_come_back(views, tmp_path):
    stills = find_background(views, BackgroundOptions(instants=FRAMES))
    save_stills(tmp_path / "stills.npz", stills)
    for still, again in zip(stills, load_stills(tmp_path / "stills.npz"), strict=True):
        assert again.camera == still.camera
        np.testing.assert_array_equal(again.pixels, still.pixels)
        np.testing.assert_array_equal(again.known, still.known)
