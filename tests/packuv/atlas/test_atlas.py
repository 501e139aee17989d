"""The atlas: every drawn Gaussian in one texel of its own, for pictures and as video by every codec."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from packuv.atlas import import_atlas
from packuv.atlas.picture import (
    CAPTION,
    SHEET_GAP,
    attribute_triplets,
    draw_triplets,
    read_triplets,
    seat,
    sheet,
    triplet_names,
    write_png,
)
from packuv.atlas.video import ATTACHMENT, EXACT_ALWAYS, AtlasCodec, AtlasVideo, AtlasVideoOptions, export_atlas
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.gaussians.uvmap import atlas_size
from packuv.gaussians.uvsize import UvOptions
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.scene.header import codes_digest

MAP = UvOptions(rows=64, columns=64, layers=4)


def quantizer(degree):
    count = attribute_count(degree)
    low, high = np.full(count, -1.5), np.full(count, 2.0)
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    return Quantizer(np.zeros(3), 1.0, np.full(3, 5.0), low, high, degree)


def random_segment(rng, first, frames, rows, degree):
    """A third of the rows may change, some of them are absent at first, some later."""
    columns, moving = attribute_count(degree), rows // 3
    key = Codes(rng.integers(0, 65536, (rows, 3), np.uint16), rng.integers(1, 256, (rows, columns), np.uint8))
    dynamic = np.arange(rows) < moving
    xyz = np.repeat(key.xyz[None, :moving], frames - 1, axis=0)
    attributes = np.repeat(key.attributes[None, :moving], frames - 1, axis=0)
    xyz += rng.integers(0, 40, xyz.shape, np.uint16)
    attributes[..., 7:] += rng.integers(0, 3, attributes[..., 7:].shape, np.uint8)
    key.attributes[: moving // 3, OPACITY] = 0
    attributes[-1:, moving // 2 : moving // 2 + 3, OPACITY] = 0
    return Segment(first, key, dynamic, xyz, attributes)


def write_random_scene(path, *, degree=0, rows=(150, 90), frames=(4, 2), seed=0):
    rng = np.random.default_rng(seed)
    parts, first = [], 0
    for number, (n, length) in enumerate(zip(rows, frames, strict=True)):
        parts.append(path.with_name(f"{number}.npz"))
        random_segment(rng, first, length, n, degree).save(parts[-1])
        first += length
    times = np.array([index * 10**9 // 30 for index in range(first)], dtype=np.int64)
    write_scene(path, parts, SceneHeader(quantizer(degree), times, Fraction(30)))
    return path


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory):
    return write_random_scene(tmp_path_factory.mktemp("atlas") / "a.mkv")


def as_set(codes):
    return sorted(map(tuple, np.concatenate([codes.xyz, codes.attributes], axis=1).tolist()))


# Pictures


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2), st.integers(0, 2**32 - 1), st.sampled_from([16, 64]))
def test_triplets_give_back_what_is_visible(tmp_path, degree, seed, size):
    path = write_random_scene(tmp_path / "a.mkv", degree=degree, seed=seed)
    options = UvOptions(rows=size, columns=size, layers=3)
    with open_scene(path) as scene:
        for number, entry in enumerate(scene.index.segments):
            seating = seat(scene, number, options=options)
            taken = seating.pixels[seating.seated]
            assert len(np.unique(taken, axis=0)) == len(taken)  # a texel of its own
            for frame in range(entry.first, entry.first + entry.frames):
                codes = scene.codes(frame)
                rows = seating.visible(codes)
                assert (codes.attributes[rows, OPACITY] > 0).all()
                pictures = draw_triplets(codes, seating, sh_degree=degree, options=options)
                assert tuple(pictures) == triplet_names(degree)
                assert {p.shape for p in pictures.values()} == {(*atlas_size(options), 3)}
                back = read_triplets(pictures, sh_degree=degree)
                assert np.array_equal(back.xyz, codes.xyz[rows])
                assert np.array_equal(back.attributes, codes.attributes[rows])
                assert (pictures["opacity"][..., 1] > 0).sum() == (rows < entry.dynamic).sum()
                if size == 64:  # room enough: whoever is drawn is seen, born later or not
                    assert as_set(back) == as_set(codes[codes.attributes[:, OPACITY] > 0])


def test_seats_are_frozen_for_a_segment(scene_path):
    with open_scene(scene_path) as scene:
        seating = seat(scene, 0, options=MAP)
        used = []
        for frame in range(4):
            pictures = draw_triplets(scene.codes(frame), seating, sh_degree=0, options=MAP)
            filled = (pictures["position_hi"] | pictures["position_lo"]).any(axis=2)
            used.append(set(map(tuple, np.argwhere(filled).tolist())))
        seats = set(map(tuple, seating.pixels[seating.seated].tolist()))
        assert all(frame <= seats for frame in used)
        rows = seating.visible(scene.codes(0))
        moved = scene.codes(2)
        assert np.isin(rows[(moved.attributes[rows, OPACITY] > 0)], seating.visible(moved)).all()


def test_the_more_opaque_wins_its_texel(tmp_path):
    codes = Codes(np.full((3, 3), 40000, np.uint16), np.full((3, 10), 100, np.uint8))
    codes.attributes[:, OPACITY] = [50, 200, 100]
    codes.attributes[:, 7] = [1, 2, 3]
    still = Segment(0, codes, np.zeros(3, bool), np.empty((0, 0, 3), np.uint16), np.empty((0, 0, 10), np.uint8))
    still.save(tmp_path / "0.npz")
    write_scene(
        tmp_path / "a.mkv", [tmp_path / "0.npz"], SceneHeader(quantizer(0), np.zeros(1, np.int64), Fraction(30))
    )
    with open_scene(tmp_path / "a.mkv") as scene:
        seating = seat(scene, 0, options=UvOptions(rows=16, columns=16, layers=2))
        pictures = draw_triplets(scene.codes(0), seating, sh_degree=0, options=UvOptions(rows=16, columns=16, layers=2))
    kept = read_triplets(pictures, sh_degree=0)
    assert sorted(kept.attributes[:, 7].tolist()) == [2, 3]
    right = np.nonzero(pictures["colour"][:, 16:, 0])  # layer 0 is the right half
    assert pictures["colour"][right[0], right[1] + 16, 0].tolist() == [2]


def test_the_sheet_shows_all_triplets_and_one_as_stored(scene_path, tmp_path):
    height, width = atlas_size(MAP)
    with open_scene(scene_path) as scene:
        page = sheet(scene, 5, options=MAP)
        assert page.shape == (3 * (height + CAPTION), 2 * width + SHEET_GAP, 3)
        one = sheet(scene, 5, options=MAP, triplet="scale")
        pictures = draw_triplets(scene.codes(5), seat(scene, 1, options=MAP), sh_degree=0, options=MAP)
        assert np.array_equal(one, pictures["scale"])
        with pytest.raises(
            ValueError, match="position_hi, position_lo, opacity, scale, rotation, colour, but not 'sh1'"
        ):
            sheet(scene, 5, options=MAP, triplet="sh1")
        with pytest.raises(IndexError, match="frame 6"):
            sheet(scene, 6, options=MAP)
    write_png(tmp_path / "a.png", one)
    assert np.array_equal(cv2.cvtColor(cv2.imread(str(tmp_path / "a.png")), cv2.COLOR_BGR2RGB), one)


def test_triplets_name_every_column_once():
    for degree in range(4):
        columns = [OPACITY, *(c for s in attribute_triplets(degree).values() for c in range(s.start, s.stop))]
        assert sorted(columns) == list(range(attribute_count(degree)))


# Video


@pytest.mark.parametrize("codec", list(AtlasCodec))
def test_every_codec_gives_back_the_very_integers(scene_path, tmp_path, codec):
    steps = []
    options = AtlasVideoOptions(codec, uv=MAP)
    summary = export_atlas(scene_path, tmp_path / "b.mkv", options=options, progress=lambda *step: steps.append(step))
    assert summary.exact
    assert summary.frames == 6
    assert steps[-1] == (18, 18)
    assert sum(summary.track_bytes.values()) < summary.bytes == (tmp_path / "b.mkv").stat().st_size
    assert [path.name for path in tmp_path.iterdir()] == ["b.mkv"]
    video = AtlasVideo(tmp_path / "b.mkv")
    assert len(video) == 6
    with open_scene(scene_path) as scene:
        for frame, codes in enumerate(video.codes()):
            truth = scene.codes(frame)
            truth = truth[truth.attributes[:, OPACITY] > 0]
            assert as_set(codes) == as_set(truth)
            assert codes_digest(codes) == video.digests[frame]
        assert video.header.to_json() == scene.header.to_json()


def test_any_player_finds_named_tracks_of_rgb_pictures_at_their_times(scene_path, tmp_path):
    summary = export_atlas(scene_path, tmp_path / "b.mkv", options=AtlasVideoOptions(uv=MAP))
    with av.open(str(tmp_path / "b.mkv")) as container:
        names = [stream.metadata["title"] for stream in container.streams.video]
        assert names == list(triplet_names(0)) == list(summary.track_bytes)
        times = [p.pts for p in container.demux(container.streams.video[3]) if p.size]
        assert times == [0, 33, 67, 100, 133, 167]
        document = next(s.data for s in container.streams.attachments if s.name == ATTACHMENT)
    data = json.loads(document)
    assert data["segments"] == [{"first": 0, "frames": 4}, {"first": 4, "frames": 2}]
    assert data["uv"] == {"rows": 64, "columns": 64, "layers": 4}


def test_unused_rows_and_columns_are_not_stored(tmp_path):
    """Gaussians all in one direction take a corner of the map."""
    rng = np.random.default_rng(0)
    segment = random_segment(rng, 0, 2, 60, 0)
    beam = Codes((32768 + 3000 + segment.key.xyz // 64).astype(np.uint16), segment.key.attributes)
    moved = (beam.xyz[None, segment.dynamic] + 1).astype(np.uint16)
    replace(segment, key=beam, xyz=moved).save(tmp_path / "0.npz")
    times = np.array([0, 33_000_000], dtype=np.int64)
    write_scene(tmp_path / "a.mkv", [tmp_path / "0.npz"], SceneHeader(quantizer(0), times, Fraction(30)))
    big = UvOptions(rows=512, columns=512, layers=4)
    summary = export_atlas(tmp_path / "a.mkv", tmp_path / "b.mkv", options=AtlasVideoOptions(uv=big))
    assert summary.exact
    assert summary.seated > 0
    assert (summary.height, summary.width) < (512, 1024)
    assert summary.height * summary.width < 512 * 1024 / 8


@pytest.mark.parametrize("codec", [AtlasCodec.X264, AtlasCodec.X265, AtlasCodec.VP9, AtlasCodec.AV1])
def test_lossy_videos_keep_positions_and_tell_their_error(scene_path, tmp_path, codec):
    summary = export_atlas(scene_path, tmp_path / "b.mkv", options=AtlasVideoOptions(codec, 30, MAP))
    assert not summary.exact
    assert [summary.rms[name] for name in EXACT_ALWAYS] == [0, 0]
    assert all(summary.rms[name] > 0 for name in attribute_triplets(0))
    with open_scene(scene_path) as scene:
        for frame, codes in enumerate(AtlasVideo(tmp_path / "b.mkv").codes()):
            truth = scene.codes(frame)
            truth = truth[truth.attributes[:, OPACITY] > 0]
            assert sorted(map(tuple, codes.xyz.tolist())) == sorted(map(tuple, truth.xyz.tolist()))


# Back into a scene


@pytest.mark.parametrize("codec", [AtlasCodec.FFV1, AtlasCodec.X264])
def test_a_scene_that_went_through_the_atlas_is_the_same_scene(scene_path, tmp_path, codec):
    export_atlas(scene_path, tmp_path / "b.mkv", options=AtlasVideoOptions(codec, uv=MAP))
    report = import_atlas(tmp_path / "b.mkv", tmp_path / "c.mkv")
    assert (report.frames, report.segments, report.changed) == (6, 2, 0)
    assert report.bytes == (tmp_path / "c.mkv").stat().st_size
    with open_scene(scene_path) as first, open_scene(tmp_path / "c.mkv") as back:
        assert back.header.to_json() == first.header.to_json()
        for number, entry in enumerate(first.index.segments):
            assert back.index.segments[number].frames == entry.frames
            assert back.index.segments[number].dynamic <= entry.dynamic
        total = 0
        for frame in range(6):
            a, b = (codes[codes.attributes[:, OPACITY] > 0] for codes in (first.codes(frame), back.codes(frame)))
            assert as_set(a) == as_set(b)
            total += len(a)
    assert report.gaussians == total


def test_what_a_lossy_codec_leaves_is_still_a_scene_and_the_change_is_told(scene_path, tmp_path):
    export_atlas(scene_path, tmp_path / "b.mkv", options=AtlasVideoOptions(AtlasCodec.X264, 10, MAP))
    report = import_atlas(tmp_path / "b.mkv", tmp_path / "c.mkv")
    assert report.changed == 6
    with open_scene(tmp_path / "c.mkv") as scene:
        assert len(scene) == 6
    with pytest.raises(ValueError, match="lacks the attachment"):
        import_atlas(scene_path, tmp_path / "d.mkv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.mkv", "c.mkv"]


def test_qualities_are_checked():
    with pytest.raises(ValueError, match="ffv1 is always lossless"):
        AtlasVideoOptions(AtlasCodec.FFV1, 20)
    with pytest.raises(ValueError, match="from 0 to 51, but is 60"):
        AtlasVideoOptions(AtlasCodec.X264, 60)
    AtlasVideoOptions(AtlasCodec.VP9, 60)


def test_what_is_no_atlas_video_is_refused(scene_path, tmp_path):
    with pytest.raises(FileNotFoundError, match="no atlas video"):
        AtlasVideo(tmp_path / "none.mkv")
    with pytest.raises(ValueError, match=r"lacks the attachment atlas\.json"):
        AtlasVideo(scene_path)
    (tmp_path / "junk.mkv").write_bytes(b"junk")
    with pytest.raises(ValueError, match="no Matroska file"):
        AtlasVideo(tmp_path / "junk.mkv")
    export_atlas(scene_path, tmp_path / "b.mkv", options=AtlasVideoOptions(uv=MAP))
    whole = (tmp_path / "b.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(whole[: len(whole) * 3 // 4])
    with pytest.raises(ValueError, match=r"cut\.mkv"):
        list(AtlasVideo(tmp_path / "cut.mkv").codes())
