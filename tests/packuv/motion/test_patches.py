"""What changes for good: dated to the instant, and told from people who pass, people who wait, cuts and light."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from packuv.colour import OFFSET, light_factors
from packuv.footage import LensCamera, Views
from packuv.motion import Patches, PatchOptions, epochs, find_patches
from packuv.motion.patches import Patch

HEIGHT, WIDTH, CAMERAS = 48, 64, 4
OPTIONS = PatchOptions(lasting=12, width=WIDTH)
PLACE = np.s_[20:32, 40:54]
"""Where a thing stands"""
Scene = Callable[[np.ndarray, int, int, np.random.Generator], None]
"""Paints what a camera sees at an instant: (pixels, camera, instant, rng)"""


@pytest.fixture
def film(ring, tmp_path) -> Callable[..., Views]:
    """Views of a gradient with a person who passes before it, sensor noise, and what a scene adds."""

    def make(scene: Scene, count: int = 40, *, light: np.ndarray | None = None) -> Views:
        cameras, videos = ring(CAMERAS, width=WIDTH, height=HEIGHT), {}
        for index, camera in enumerate(cameras):
            rng = np.random.default_rng(index)
            path = videos[camera.name] = tmp_path / f"{camera.name}.mkv"
            with av.open(str(path), "w") as container:
                stream = container.add_stream("ffv1", rate=30)
                stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "bgr0"
                for instant in range(count):
                    pixels = np.empty((HEIGHT, WIDTH, 3))
                    pixels[:] = np.linspace(60, 120, WIDTH)[None, :, None]
                    scene(pixels, index, instant, rng)
                    left = 3 * instant % (2 * WIDTH)
                    pixels[5:40, left : left + 6] = 200
                    if light is not None:
                        pixels = 255 * ((pixels / 255 + OFFSET) * light_factors(light[instant, index]) - OFFSET)
                    noisy = pixels + rng.normal(0, 1.5, pixels.shape)
                    frame = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
                container.mux(stream.encode())
        frames = np.tile(np.arange(count)[:, None], (1, CAMERAS))
        return Views(videos, frames, [LensCamera(camera) for camera in cameras], light=light)

    return make


def thing(start: int, stop: int = 1_000, cameras: int = CAMERAS) -> Scene:
    """Something that stands there from one instant until another."""

    def paint(pixels: np.ndarray, camera: int, instant: int, rng: np.random.Generator) -> None:
        if camera < cameras and start <= instant < stop:
            pixels[PLACE] = (180, 40, 30)

    return paint


def nothing(pixels: np.ndarray, camera: int, instant: int, rng: np.random.Generator) -> None:
    """The scene without more."""


@pytest.mark.parametrize("date", [12, 17, 28])
def test_a_thing_put_down_is_dated_to_the_instant_and_seen_where_it_stands(film, date):
    found = find_patches(film(thing(date)), OPTIONS)
    assert found.dates == (date,)
    assert found.cuts == ()
    assert sorted(found.found[0].masks) == list(range(CAMERAS))
    stands = np.zeros((HEIGHT, WIDTH), bool)
    stands[PLACE] = True
    for mask in found.found[0].masks.values():
        # A pixel of the edge may differ by chance, and more where the passer-by hides it at the date.
        assert (mask & stands).sum() >= 0.9 * (mask | stands).sum()


def test_workers_do_not_change_what_is_found(film):
    views = film(thing(17))
    alone, together = find_patches(views, OPTIONS), find_patches(views, OPTIONS, workers=3)
    assert alone.dates == together.dates
    for camera, mask in alone.found[0].masks.items():
        np.testing.assert_array_equal(mask, together.found[0].masks[camera])


def test_put_down_and_taken_away_are_two_dates(film):
    assert find_patches(film(thing(30, 43), 60), OPTIONS).dates == (30, 43)


def test_who_passes_leaves_no_patch(film):
    assert find_patches(film(nothing), OPTIONS) == Patches(())


def test_who_waits_leaves_no_patch(film):
    """Clothes are as still as a thing in their middle; the outline sways."""

    def waiting(pixels: np.ndarray, camera: int, instant: int, rng: np.random.Generator) -> None:
        if instant < 20:
            x, y = rng.integers(-3, 4, 2)
            pixels[12 + y : 40 + y, 30 + x : 46 + x] = (30, 40, 120)

    assert find_patches(film(waiting), OPTIONS).found == ()


def test_what_stays_for_less_is_left_to_keyframes(film):
    assert find_patches(film(thing(14, 22)), OPTIONS).found == ()


def test_two_cameras_are_too_few(film):
    assert find_patches(film(thing(17, cameras=2)), OPTIONS).found == ()
    assert find_patches(film(thing(17, cameras=3)), OPTIONS).dates == (17,)


def test_a_cut_is_no_patch(film):
    def cut(pixels: np.ndarray, camera: int, instant: int, rng: np.random.Generator) -> None:
        if instant >= 20:
            pixels[:] = 255 - pixels[:, ::-1]
            pixels[::8] = 20

    found = find_patches(film(cut), OPTIONS)
    assert found.found == ()
    assert len(found.cuts) == 1
    assert abs(found.cuts[0] - 20) <= 1


def test_light_and_exposure_that_jump_are_no_patch(film):
    light = np.zeros((40, CAMERAS, 3))
    light[20:] = 0.5  # the room's
    light[25:, 1] = -0.3  # one camera's
    assert find_patches(film(nothing, light=light), OPTIONS) == Patches(())
    assert find_patches(film(thing(17), light=light), OPTIONS).dates == (17,)


def test_a_camera_that_dies_does_not_hide_what_the_others_see(film):
    views = film(thing(22))
    views.frames[18:, 2] = -1
    found = find_patches(views, OPTIONS)
    assert found.dates == (22,)
    assert sorted(found.found[0].masks) == [0, 1, 3]


def test_a_short_sequence_is_not_even_looked_at(ring):
    frames = np.tile(np.arange(23)[:, None], (1, 3))
    cameras = [LensCamera(camera) for camera in ring(3, width=WIDTH, height=HEIGHT)]
    views = Views({lens.pinhole.name: Path("missing.mkv") for lens in cameras}, frames, cameras)
    assert find_patches(views, OPTIONS) == Patches(())


def test_saving_and_loading_gives_the_same(tmp_path):
    rng = np.random.default_rng(1)
    masks = {index: rng.random((9, 16)) > 0.5 for index in (0, 3, 12)}
    whole = Patches((Patch(5, masks), Patch(70, {1: masks[0]})), cuts=(90,))
    whole.save(tmp_path / "patches.npz")
    again = Patches.load(tmp_path / "patches.npz")
    assert (again.dates, again.cuts) == (whole.dates, whole.cuts)
    for before, after in zip(whole.found, again.found, strict=True):
        assert before.masks.keys() == after.masks.keys()
        assert all(np.array_equal(mask, after.masks[index]) for index, mask in before.masks.items())


@pytest.mark.parametrize("dates", [(), (4,), (1, 2, 9)])
def test_epochs_are_the_sequence(dates):
    parts = epochs(dates, 10)
    assert [instant for part in parts for instant in part] == list(range(10))
    assert [part.start for part in parts[1:]] == list(dates)


def test_options_that_make_no_sense_are_refused():
    for wrong, text in (({"contrast": 10}, "contrast"), ({"agreement": 1.5}, "agreement"), ({"cameras": 0}, "cameras")):
        with pytest.raises(ValueError, match=text):
            PatchOptions(**wrong)
