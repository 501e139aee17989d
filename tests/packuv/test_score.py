"""Scores: one declaration makes the fields and the table's columns."""

from __future__ import annotations

from dataclasses import fields, replace
from fractions import Fraction

import av
import numpy as np
import pyarrow as pa
import pytest

from packuv.camera import PinholeCamera
from packuv.colour import lit
from packuv.footage import LensCamera, Silhouettes, Views
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Quantizer, attribute_values
from packuv.gaussians.floats import with_canonical_axes
from packuv.gaussians.segment import Segment
from packuv.metrics import cut_out, psnr, ssim
from packuv.progress import no_progress
from packuv.raster import render
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.score import (
    BLOCKS,
    COLUMNS,
    FIGURES,
    FOREGROUND,
    SCHEMA,
    Artist,
    Score,
    _Watch,
    glance,
    read_table,
    score,
    summary,
    write_table,
)
from tests.support.splats import wall


def test_the_table_has_the_columns_that_stores_hold():
    assert pa.schema(
        [
            ("frame", pa.int32()),
            ("time_ns", pa.int64()),
            ("camera", pa.string()),
            ("held_out", pa.bool_()),
            ("psnr_db", pa.float64()),
            ("ssim", pa.float64()),
            ("psnr_calibrated_db", pa.float64()),
            ("ssim_calibrated", pa.float64()),
            ("psnr_own_db", pa.float64()),
            ("ssim_own", pa.float64()),
            ("flicker", pa.float64()),
            ("psnr_moving_db", pa.float64()),
            ("psnr_still_db", pa.float64()),
            ("moving_share", pa.float64()),
            ("tof_px", pa.float64()),
            ("lpips", pa.float64()),
            ("psnr_never_moving_db", pa.float64()),
        ]
    ).equals(SCHEMA, check_metadata=True)


def test_every_field_is_a_column_and_every_figure_has_a_mean():
    assert COLUMNS.names == [field.name for field in fields(Score)]
    assert [*SCHEMA.names, *FOREGROUND] == COLUMNS.names
    assert tuple(name for name in SCHEMA.names if name not in ("frame", "time_ns", "camera", "held_out")) == FIGURES


# In light that changes

CAMERA = PinholeCamera("a", 96, 64, 70.0, 70.0, 48.0, 32.0, np.eye(4))
LIGHT = np.array([[0.0, 0, 0], [0.4, 0.1, -0.2], [-0.6, -0.6, -0.5]])


def write_wall(path, light):
    """Three equal frames, and what the header says of their light."""
    gaussians = with_canonical_axes(wall(0))
    values = attribute_values(gaussians)
    low, high = values.min(axis=0).astype(float) - 1e-3, values.max(axis=0).astype(float) + 1e-3
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    quantizer = Quantizer(np.array([0, 0, 4.0]), 1.0, np.full(3, 5.0), low, high)
    key = quantizer.encode(gaussians)
    still = np.empty((2, 0, 3), np.uint16), np.empty((2, 0, key.attributes.shape[1]), np.uint8)
    Segment(0, key, np.zeros(len(key), bool), *still).save(path.with_suffix(".npz"))
    times = np.arange(3, dtype=np.int64) * 40_000_000
    header = SceneHeader(quantizer, times, Fraction(25), (CAMERA,), extra={"near": 0.1})
    write_scene(path, [path.with_suffix(".npz")], replace(header, light=light))
    return path


def film(path, pictures):
    """Lossless video of float32 pictures [3, H, W]."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.options = 96, 64, "rgb24", {"qp": "0"}
        for picture in pictures:
            pixels = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8).transpose(1, 2, 0)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")))
        container.mux(stream.encode(None))


def scores_of(path, video, light):
    views = Views({"a": video}, np.arange(3)[:, None], [LensCamera(CAMERA)], light=light)
    with open_scene(path) as scene:
        return score(scene, views, no_progress)


def test_the_device_draws_what_is_scored(tmp_path, monkeypatch):
    path, asked = write_wall(tmp_path / "steady.mkv", 0 * LIGHT), []

    def drawn(*given, options, **named):
        asked.append(options.device)
        return render(*given, options=replace(options, device="cpu"), **named)

    monkeypatch.setattr("packuv.score.render", drawn)
    with open_scene(path) as scene:
        film(tmp_path / "a.mp4", [Artist(scene).draw(scene.gaussians(0), CAMERA)] * 3)
        views = Views({"a": tmp_path / "a.mp4"}, np.arange(3)[:, None], [LensCamera(CAMERA)])
        score(scene, views, no_progress, device="cuda")
    assert asked == ["cpu", "cuda", "cuda", "cuda"]


def test_raw_scores_are_those_of_the_scene_in_its_light(tmp_path):
    path, steady = write_wall(tmp_path / "lit.mkv", LIGHT), write_wall(tmp_path / "steady.mkv", 0 * LIGHT)
    with open_scene(path) as scene:
        drawn = Artist(scene).draw(scene.gaussians(0), CAMERA)
    film(tmp_path / "a.mp4", [lit(drawn, light) for light in LIGHT])
    for one in scores_of(path, tmp_path / "a.mp4", None):
        assert one.psnr_db > 55  # 8 bits
    # A plain camera whose exposure is steady: what it makes of the picture is the light of the scene.
    for one in scores_of(path, tmp_path / "a.mp4", LIGHT[:, None]):
        assert one.psnr_calibrated_db == pytest.approx(one.psnr_db, abs=0.01)
    raw = [one.psnr_db for one in scores_of(steady, tmp_path / "a.mp4", LIGHT[:, None])]
    assert raw[0] > 55
    assert max(raw[1:]) < 30


def test_scores_depend_on_no_parts_go_on_after_a_kill_and_are_those_of_a_glance(tmp_path, monkeypatch):
    path = write_wall(tmp_path / "lit.mkv", LIGHT)
    rng = np.random.default_rng(0)
    film(tmp_path / "a.mp4", rng.random((3, 3, 64, 96)).astype(np.float32))
    lenses = [LensCamera(replace(CAMERA, name=name)) for name in "ab"]
    videos, frames = {name: tmp_path / "a.mp4" for name in "ab"}, np.array([[0, 0], [1, -1], [2, 2]])

    def scored(scratch=None, progress=no_progress):
        with open_scene(path) as scene:
            return score(scene, Views(videos, frames, lenses), progress, scratch=scratch)

    whole = scored()
    with open_scene(path) as scene:
        for few in ([0, 1, 2], [1], [0, 2]):
            seen = glance(scene, Views(videos, frames, lenses), few, no_progress)
            assert [vars(item) for item in seen] == [
                {name: getattr(item, name) for name in ("camera", "frame", "psnr_calibrated_db", "ssim_calibrated")}
                for item in whole
                if item.frame in few
            ]
    assert any(item.psnr_never_moving_db is not None for item in whole)
    monkeypatch.setattr("packuv.score.PART", 1)
    for kept in range(3):  # parts that a kill left
        scratch = tmp_path / f"scratch{kept}"
        scratch.mkdir()
        assert scored(scratch) == whole
        for part in range(kept, 3):
            (scratch / f"{part:09d}.arrow").unlink()
        told = []
        assert scored(scratch, lambda done, total, note="", told=told: told.append((done, note))) == whole
        assert [done for done, _ in told] == [1, 2, 3]


def test_scores_do_not_depend_on_the_number_of_workers(tmp_path):
    path = write_wall(tmp_path / "lit.mkv", LIGHT)
    rng = np.random.default_rng(0)
    film(tmp_path / "a.mp4", rng.random((3, 3, 64, 96)).astype(np.float32))
    videos = {name: tmp_path / "a.mp4" for name in "ab"}
    lenses = [LensCamera(replace(CAMERA, name=name)) for name in "ab"]
    frames = np.array([[0, 0], [1, -1], [2, 2]])
    with open_scene(path) as scene:
        one, many = (score(scene, Views(videos, frames, lenses), no_progress, workers=n) for n in (1, 3))
    assert one == many
    assert [(item.frame, item.camera) for item in one] == [(0, "a"), (0, "b"), (1, "a"), (2, "a"), (2, "b")]


# ---- the foreground


def test_the_foreground_is_scored_where_masks_tell_it_and_nothing_else_changes(tmp_path):
    path = write_wall(tmp_path / "lit.mkv", 0 * LIGHT)
    rng = np.random.default_rng(0)
    pictures = rng.random((3, 3, 64, 96)).astype(np.float32)
    film(tmp_path / "a.mp4", pictures)
    masks = np.zeros((3, 64, 96), np.float32)
    masks[0, 10:40, 20:30] = masks[1] = 1  # none in the last frame
    film(tmp_path / "mask.mp4", np.repeat(masks[:, None], 3, axis=1))
    lenses = [LensCamera(replace(CAMERA, name=name)) for name in "ab"]
    frames = np.arange(3)[:, None]
    silhouettes = Silhouettes(Views({"a": tmp_path / "mask.mp4"}, frames, lenses[:1]))
    views = Views({name: tmp_path / "a.mp4" for name in "ab"}, np.repeat(frames, 2, axis=1), lenses)
    perceived = []

    def measure(picture, truth):
        perceived.append(picture.shape[1:])
        return float(np.abs(picture - truth).mean())

    with open_scene(path) as scene:
        drawn = Artist(scene).draw(scene.gaussians(0), CAMERA)
        plain = score(scene, views, no_progress)
        found = score(scene, views, no_progress, silhouettes=silhouettes)
        score(scene, views, no_progress, silhouettes=silhouettes, lpips=measure)
    bare = [replace(item, **dict.fromkeys(FOREGROUND)) for item in found]
    assert bare == plain
    own = {(item.camera, item.frame): item for item in found}
    assert all(getattr(own[key], name) is None for key in own if key[0] == "b" or key[1] == 2 for name in FOREGROUND)

    part, whole = own["a", 0], own["a", 1]
    shown, truth = np.clip(drawn, 0, 1), views.filmed(0, 0)
    box = np.s_[:, 10:40, 20:30]
    assert part.foreground_share == pytest.approx(300 / (64 * 96))
    assert part.psnr_foreground_db == pytest.approx(psnr(shown[box], truth[box]), abs=0.05)  # of clipped values
    around = np.zeros((3, 64, 96), np.float32), np.zeros((3, 64, 96), np.float32)
    around[0][box], around[1][box] = shown[box], truth[box]
    wide = np.s_[:, 10:40, 19:30]  # as wide as the window of SSIM
    assert part.ssim_foreground == pytest.approx(ssim(around[0][wide], around[1][wide]), abs=1e-3)
    assert whole.psnr_foreground_db == pytest.approx(whole.psnr_calibrated_db, abs=0.05)
    assert whole.ssim_foreground == pytest.approx(whole.ssim_calibrated, abs=1e-3)
    assert sorted(set(perceived)) == [(64, 64), (64, 96)]

    write_table(tmp_path / "found.arrow", found)
    assert list(read_table(tmp_path / "found.arrow")) == found
    means = [summary(part, frames=3, size_bytes=1, borders=[]) for part in (found, plain)]
    assert means[0]["by_camera"]["b"]["psnr_foreground_db"] is None
    assert means[0]["mean"]["ssim_foreground"] == pytest.approx((part.ssim_foreground + whole.ssim_foreground) / 2)
    assert set(means[0]["mean"]) - set(means[1]["mean"]) == set(FOREGROUND)


def test_a_box_lies_within_the_picture_and_around_the_mask():
    rng = np.random.default_rng(4)
    picture = rng.random((3, 40, 50)).astype(np.float32)
    for _ in range(50):
        mask = np.zeros((40, 50), bool)
        rows, columns = np.sort(rng.choice(40, 2, replace=False)), np.sort(rng.choice(50, 2, replace=False))
        mask[rows[0] : rows[1], columns[0] : columns[1]] = True
        cut = cut_out(picture, mask, least_px=16)
        assert cut.shape[1:] == tuple(max(16, b - a) for a, b in (rows, columns))
        assert cut.sum() == pytest.approx(picture[:, mask].sum(), rel=1e-4)
    assert cut_out(picture, mask, least_px=64).shape == picture.shape


# ---- moving and still areas

HEIGHT, WIDTH = 90, 160
RNG = np.random.default_rng(2)
WALL = RNG.integers(60, 200, (HEIGHT // 10, WIDTH // 10, 3)).repeat(10, 0).repeat(10, 1).astype(np.uint8)


SQUARE = RNG.integers(0, 256, (10, 10, 3)).repeat(3, 0).repeat(3, 1).astype(np.uint8)


def filmed(x: int) -> np.ndarray:
    """A square at column x before a wall, uint8 [H, W, 3]."""
    picture = WALL.copy()
    picture[30:60, x : x + 30] = SQUARE
    return picture


def watch(errors: list[np.ndarray]) -> tuple[_Watch, list[tuple[float | None, ...]]]:
    """What is seen of a square that goes right by 5 pixels a frame, with these errors of the render."""
    seen = _Watch()
    return seen, [seen.see(filmed(20 + 5 * i), filmed(20 + 5 * i), error) for i, error in enumerate(errors)]


def flat(size: float) -> np.ndarray:
    return np.full((3, HEIGHT, WIDTH), size, np.float32)


def test_an_equal_error_is_equal_in_all_areas():
    seen, areas = watch([flat(0.1)] * 3)
    assert areas[0] == (None, None, None, None)
    for moving, still, share, tof in areas[1:]:
        assert moving == pytest.approx(20, abs=1e-4)
        assert still == pytest.approx(20, abs=1e-4)
        assert 0 < share < 0.3
        assert tof == 0
    assert list(seen.never_moving()) == pytest.approx([20] * 3, abs=1e-4)


def test_areas_are_apart_and_make_up_the_picture():
    error = RNG.normal(0, 0.1, (3, HEIGHT, WIDTH)).astype(np.float32)
    _, areas = watch([error, error])
    moving, still, share, _ = areas[1]
    mean = share * 10 ** (-moving / 10) + (1 - share) * 10 ** (-still / 10)
    # Float32 squares.
    assert -10 * np.log10(mean) == pytest.approx(
        psnr(np.full_like(error, 0.5) + error, np.full_like(error, 0.5)), abs=1e-3
    )


def test_errors_where_the_square_passes_at_any_time_do_not_count_as_never_moving():
    error = flat(0.01)
    error[:, 30:60, 20:65] = 0.5  # its way over all frames
    seen, _ = watch([error] * 4)
    assert list(seen.never_moving()) == pytest.approx([40] * 4, abs=1e-3)


def test_a_scene_of_one_frame_and_an_exact_one_have_no_areas():
    seen, _ = watch([flat(0.1)])
    assert list(seen.never_moving()) == [None]
    seen, areas = watch([flat(0)] * 2)
    assert areas[1][:2] == (None, None)
    assert list(seen.never_moving()) == [None, None]


def test_what_is_kept_of_a_picture_is_small():
    seen, _ = watch([flat(0.1)])
    assert seen.blocks[0].shape == (round(BLOCKS * HEIGHT / WIDTH), BLOCKS)


def test_a_camera_without_pictures_has_none_where_nothing_moves():
    assert list(_Watch().never_moving()) == []
