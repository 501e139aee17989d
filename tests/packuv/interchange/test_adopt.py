"""Splat files become a scene file: nothing changes but what the report says."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Codes
from packuv.gaussians.floats import rows_of
from packuv.gaussians.orbit import OrbitOptions, middle, near_of, orbit
from packuv.gaussians.rows import first_appearance
from packuv.gaussians.uvsize import UvOptions
from packuv.interchange import write_ply, write_spz
from packuv.interchange.adopt import AdoptOptions, adopt, find_frames, read_frame
from packuv.interchange.joined import GROWTH, equal_codes, segments_of
from packuv.interchange.likeness import likeness
from packuv.scene import open_scene, verify_scene
from tests.support.splats import random_gaussians

SMALL = OrbitOptions(cameras=2, size=(64, 48))


def random_codes(rng, count):
    codes = Codes(rng.integers(0, 9, (count, 3), np.uint16), rng.integers(0, 4, (count, 10), np.uint8))
    codes.attributes[:, OPACITY] = rng.integers(1, 256, count)
    return codes


def as_set(codes):
    """The drawn Gaussians of a frame, in any order, equal ones as often as they occur."""
    drawn = codes[codes.attributes[:, OPACITY] > 0]
    return sorted(map(tuple, np.concatenate([drawn.xyz, drawn.attributes], axis=1).tolist()))


# Rows


@settings(max_examples=80)
@given(st.lists(st.integers(0, 30), min_size=1, max_size=2), st.integers(0, 2**32 - 1))
def test_equal_codes_pair_off_like_their_naive_twin(counts, seed):
    rng = np.random.default_rng(seed)
    pool = random_codes(rng, 6)  # few values: many are equal
    codes, others = (pool[rng.integers(0, 6, counts[k % len(counts)])] for k in range(2))
    found = equal_codes(codes, others)
    free = list(range(len(others)))
    for row in range(len(codes)):
        same = [
            k
            for k in free
            if (others.xyz[k] == codes.xyz[row]).all() and (others.attributes[k] == codes.attributes[row]).all()
        ]
        assert found[row] == (same[0] if same else -1)
        if same:
            free.remove(same[0])


@settings(max_examples=60)
@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=12), st.integers(1, 6), st.integers(0, 2**32 - 1), st.booleans()
)
def test_segments_hold_the_very_frames(counts, longest, seed, related):
    rng = np.random.default_rng(seed)
    pool = random_codes(rng, 45)
    frames = [pool[rng.permutation(45)[:n]] if related else random_codes(rng, n) for n in counts]
    at = 0
    for segment in segments_of(frames, longest=longest):
        assert segment.first == at
        assert len(segment) <= longest
        assert len(segment.key) <= max(GROWTH * len(frames[at]), len(frames[at]))
        for index in range(len(segment)):
            assert as_set(segment.frame(index)) == as_set(frames[at + index])
        at += len(segment)
    assert at == len(frames)


def test_rows_that_do_not_change_are_still_and_waiting_rows_repeat_themselves():
    rng = np.random.default_rng(0)
    still, moving, born = (random_codes(rng, n) for n in (20, 3, 2))

    def joined(*parts):
        return Codes(*(np.concatenate([getattr(p, key) for p in parts]) for key in ("xyz", "attributes")))

    later = Codes((moving.xyz + 1).astype(np.uint16), moving.attributes)
    (segment,) = segments_of([joined(still, moving), joined(still, later), joined(still, later, born)], longest=9)
    assert segment.dynamic.tolist() == [False] * 20 + [True] * 5
    assert np.array_equal(segment.key.xyz[23:], born.xyz)
    assert (segment.key.attributes[23:, OPACITY] == 0).all()
    seen = first_appearance(segment)
    assert np.array_equal(seen.attributes[23:], born.attributes)
    assert np.array_equal(seen.xyz[20:23], moving.xyz)


def test_an_empty_frame_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="frame 1 holds no Gaussians"):
        list(segments_of([random_codes(rng, 3), random_codes(rng, 0)], longest=3))


# Scenes


def small_gaussians(count=300, degree=0, seed=0):
    gaussians = random_gaussians(count, degree, seed)
    gaussians.log_scales[:] = gaussians.log_scales * 0.3 - 2
    gaussians.sh[:, 1:] *= 0.1
    return gaussians


def test_a_still_scene_comes_over_within_its_codes(tmp_path):
    truth = small_gaussians(degree=1)
    truth.opacity_logits[:5] = OPACITY_RANGE[0]
    truth.means[5], truth.quaternions[6] = np.nan, 0
    write_ply(tmp_path / "a.ply", truth)
    report = adopt([tmp_path / "a.ply"], tmp_path / "a.mkv", options=AdoptOptions(orbit=SMALL))
    assert (report.frames, report.segments, report.gaussians, report.broken, report.faint) == (1, 1, 295, 2, 0)
    assert report.pruned == 0  # 293 Gaussians on a map of a million texels
    assert report.kept_share == 293 / 295
    assert 0.98 < report.kept_alpha_share < 1
    assert np.isinf(report.psnr_pruned_db).all()
    assert min(report.psnr_db) > 40  # 8 bits a value: about half a step of error everywhere
    assert report.bytes == (tmp_path / "a.mkv").stat().st_size
    assert verify_scene(tmp_path / "a.mkv").ok
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mkv", "a.ply"]
    with open_scene(tmp_path / "a.mkv") as scene:
        frame = read_frame(tmp_path / "a.ply", sh_degree=None).gaussians
        codes = scene.header.quantizer.encode(frame)
        codes.attributes[:, OPACITY] = np.maximum(codes.attributes[:, OPACITY], 1)
        assert as_set(scene.codes(0)) == as_set(codes)
        assert scene.header.quantizer.saturation(frame) == report.saturated < 10
        assert [camera.name for camera in scene.header.cameras] == ["orbit00", "orbit01"]


def test_crowded_texels_lose_and_the_loss_is_told(tmp_path):
    truth = small_gaussians(2000)
    write_spz(tmp_path / "a.spz", truth)
    options = AdoptOptions(uv=UvOptions(rows=16, columns=16, layers=4), orbit=SMALL)
    report = adopt([tmp_path / "a.spz"], tmp_path / "a.mkv", options=options)
    with open_scene(tmp_path / "a.mkv") as scene:
        kept = int((scene.codes(0).attributes[:, OPACITY] > 0).sum())
    assert report.pruned == 2000 - kept > 1000
    assert report.kept_share == kept / 2000
    assert report.kept_share < report.kept_alpha_share < 1  # the faint ones go
    assert max(report.psnr_pruned_db) < 40
    everything = adopt([tmp_path / "a.spz"], tmp_path / "b.mkv", options=replace(options, uv=None))
    assert everything.pruned == 0
    assert min(everything.psnr_db) > max(report.psnr_db)


def test_a_sequence_keeps_every_frame_and_its_time(tmp_path):
    base = small_gaussians(400)
    rng = np.random.default_rng(1)
    for index in range(5):
        frame = rows_of(base, np.arange(400 if index < 3 else 390))
        frame.means[:20] += rng.normal(size=(20, 3)).astype(np.float32) * 0.05
        write_ply(tmp_path / f"{index + 8}.ply", frame)  # 8, 9, 10: natural order is not that of text
    frames = find_frames([tmp_path])
    assert [path.stem for path in frames] == ["8", "9", "10", "11", "12"]
    steps = []
    options = AdoptOptions(rate=Fraction(25), segment_frames=4, orbit=SMALL, compared_frames=2)
    report = adopt(frames, tmp_path / "a.mkv", options=options, progress=lambda *step: steps.append(step[:2]))
    assert (report.frames, report.gaussians, report.segments) == (5, 1980, 2)
    assert len(report.psnr_db) == 4
    assert steps[-1] == (20, 20)
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)
    with open_scene(tmp_path / "a.mkv") as scene:
        assert scene.header.times_ns.tolist() == [0, 40_000_000, 80_000_000, 120_000_000, 160_000_000]
        for index, path in enumerate(frames):
            codes = scene.header.quantizer.encode(read_frame(path, sh_degree=None).gaussians)
            codes.attributes[:, OPACITY] = np.maximum(codes.attributes[:, OPACITY], 1)
            assert as_set(scene.codes(index)) == as_set(codes)
        first = scene.index.segments[0]
        assert first.frames == 4
        assert first.dynamic == 20 + 10 + 20  # moving; gone; moved and not known again when the count changed


def test_bands_can_be_left_behind_and_must_agree(tmp_path):
    write_ply(tmp_path / "a.ply", small_gaussians(degree=2))
    write_ply(tmp_path / "b.ply", small_gaussians(degree=1))
    files = [tmp_path / "a.ply", tmp_path / "b.ply"]
    with pytest.raises(ValueError, match=r"b\.ply has SH of degree 1, the first file 2"):
        adopt(files, tmp_path / "a.mkv", options=AdoptOptions(orbit=SMALL))
    adopt(files, tmp_path / "a.mkv", options=AdoptOptions(orbit=SMALL, sh_degree=1, compared_frames=0))
    with open_scene(tmp_path / "a.mkv") as scene:
        assert scene.header.quantizer.sh_degree == 1


def test_files_are_found_or_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match="no splat file or folder"):
        find_frames([tmp_path / "missing"])
    with pytest.raises(ValueError, match="has none"):
        find_frames([tmp_path])
    write_ply(tmp_path / "a.ply", small_gaussians())
    write_spz(tmp_path / "a.spz", small_gaussians())
    with pytest.raises(ValueError, match=r"has \['\.ply', '\.spz'\]"):
        find_frames([tmp_path])
    absent = small_gaussians()
    absent.opacity_logits[:] = -9
    write_ply(tmp_path / "b.ply", absent)
    with pytest.raises(ValueError, match=r"b\.ply holds no Gaussians that can be drawn"):
        adopt([tmp_path / "b.ply"], tmp_path / "b.mkv", options=AdoptOptions(orbit=SMALL))
    assert not (tmp_path / "b.mkv").exists()


# Views


def test_orbit_cameras_look_at_the_middle_from_outside_and_above():
    gaussians = small_gaussians(1000)
    gaussians.means[:] += [3, -2, 7]
    gaussians.means[0] = 1e4  # a stray one
    centre, radius = middle(gaussians, share=0.9)
    assert np.linalg.norm(centre - [3, -2, 7]) < 0.3
    assert 1 < radius < 4
    cameras = orbit(centre, radius, options=OrbitOptions(cameras=5))
    for camera in cameras:
        pixel, depth = camera.project(centre[None])
        assert np.allclose(pixel, [camera.width / 2, camera.height / 2], atol=1e-6)
        assert depth[0] > radius
        assert camera.centre[1] < centre[1]  # up is -y
        assert camera.camera_from_world[1, 1] > 0  # and down in the picture is +y
        assert np.isclose(np.linalg.det(camera.camera_from_world[:3, :3]), 1)
    assert len({tuple(camera.centre.round(6)) for camera in cameras}) == 5
    alone = rows_of(gaussians, slice(5, 6))
    _, radius = middle(alone, share=0.9)
    assert np.isclose(radius, 3 * np.exp(alone.log_scales.max()))  # a point has no extent, but is seen from outside
    near = near_of(cameras)
    assert np.isinf(likeness(gaussians, gaussians, cameras[:1], near=near)).all()
    fewer = rows_of(gaussians, slice(0, 500))
    assert likeness(gaussians, fewer, cameras[:1], near=near)[0] < 40
