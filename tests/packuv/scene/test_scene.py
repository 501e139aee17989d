import copy
import gc
import hashlib
import json
import os
import re
import subprocess
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import packuv
from packuv.camera import PinholeCamera
from packuv.gaussians.codes import OPACITY, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.scene import (
    TOLERANCES,
    EncodeOptions,
    Quality,
    SceneHeader,
    Tolerance,
    VerifyReport,
    open_scene,
    verify_scene,
    write_scene,
)
from packuv.scene.copy import _END, MAGIC, SEGMENT, VOID, read_copy
from packuv.scene.header import codes_digest
from packuv.scene.lookahead import Address
from packuv.scene.matroska import Packet, write_matroska
from packuv.scene.sharing import KeyPlanner, stored_segments
from tests.support.needs import needs_ffmpeg
from tests.support.places import ROOT

DOCUMENT = ROOT / "docs/scene-format.md"


def random_segment(rng, first, rows, dynamic, frames, degree):
    """A random walk with births, deaths and frames in which nothing happens."""
    columns, mask = attribute_count(degree), rng.permutation(rows) < dynamic
    key = Codes(rng.integers(0, 65536, (rows, 3), np.uint16), rng.integers(0, 256, (rows, columns), np.uint8))
    key.attributes[rng.random(rows) < 0.3, OPACITY] = 0
    xyz, attributes = [key.xyz[mask]], [key.attributes[mask]]
    for _ in range(frames - 1):
        still = rng.random() < 0.25
        xyz.append((xyz[-1] + (0 if still else rng.integers(-300, 301, (dynamic, 3)))).astype(np.uint16))
        change = 0 if still else rng.integers(-4, 5, (dynamic, 1)) + rng.integers(0, 2, (dynamic, columns))
        attributes.append((attributes[-1] + change).astype(np.uint8))
        if not still:
            attributes[-1][rng.random(dynamic) < 0.2, OPACITY] = 0
    return Segment(first, key, mask, np.stack(xyz)[1:], np.stack(attributes)[1:])


def random_sequence(seed, shapes, degree=0, shared=0.8):
    """Segments that follow one another, from (rows, dynamic, frames) each; keys share rows with the one before."""
    rng, first, result = np.random.default_rng(seed), 0, []
    for rows, dynamic, frames in shapes:
        segment = random_segment(rng, first, rows, dynamic, frames, degree)
        if result:
            before = result[-1].key
            count = min(int(shared * rows), len(before))
            there, here = (np.sort(rng.permutation(n)[:count]) for n in (len(before), rows))
            segment.key.xyz[here], segment.key.attributes[here] = before.xyz[there], before.attributes[there]
        result.append(segment)
        first += frames
    return result


def save(folder, segments):
    paths = [folder / f"segment{k}.npz" for k in range(len(segments))]
    for path, segment in zip(paths, segments, strict=True):
        segment.save(path)
    return paths


def quantizer(degree=0):
    count = attribute_count(degree)
    return Quantizer(np.array([1.0, 2, 3]), 0.5, np.full(3, 20.0), np.full(count, -1.5), np.full(count, 2.0), degree)


def make_header(frames, degree=0):
    cameras = tuple(
        PinholeCamera(name, 64, 48, 50.5, 51, 32, 24.25, np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0])
        for name in ("cam1", "cam2")
    )
    times = (np.arange(frames, dtype=np.int64) * 10**9 * 1001) // 30000 + 1_700_000_000_123_456_789
    return SceneHeader(
        quantizer(degree), times, Fraction(30000, 1001), cameras, ("cam2",), {"worst_ms": 3.25}, {"note": "größer"}
    )


def same(a, b):
    return np.array_equal(a.xyz, b.xyz) and np.array_equal(a.attributes, b.attributes)


def frames_of(segments, reach=3):
    planner = KeyPlanner(reach)
    references = [planner.plan(segment).reference for segment in segments]
    return [stored.frame(k) for stored in stored_segments(segments, references=references) for k in range(len(stored))]


SHAPES = [(300, 90, 5), (310, 60, 3), (40, 0, 4), (700, 700, 2), (690, 9, 1), (1500, 20, 6)]


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    """One file of several different segments, and its frames."""
    folder = tmp_path_factory.mktemp("scene")
    segments = random_sequence(0, SHAPES)
    write_scene(folder / "scene.mkv", save(folder, segments), make_header(21))
    with open_scene(folder / "scene.mkv") as scene:
        assert [entry.reference for entry in scene.index.segments] == [None, 0, 1, 0, 3, 3]
    return folder / "scene.mkv", frames_of(segments)


# Round trips


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 2**32 - 1),
    st.lists(
        st.tuples(st.integers(1, 400), st.sampled_from([0, 0.3, 1]), st.integers(1, 5)).map(
            lambda shape: (shape[0], int(shape[0] * shape[1]), shape[2])
        ),
        min_size=1,
        max_size=4,
    ),
    st.integers(0, 2),
)
def test_every_frame_comes_back_in_any_order(tmp_path, seed, shapes, degree):
    segments = random_sequence(seed, shapes, degree)
    frames = frames_of(segments)
    header = make_header(len(frames), degree)
    summary = write_scene(tmp_path / "scene.mkv", save(tmp_path, segments), header, threads=1)
    assert summary.frames == len(frames)
    assert summary.bytes == (tmp_path / "scene.mkv").stat().st_size > sum(summary.track_bytes.values())
    assert list(summary.digests) == [codes_digest(codes) for codes in frames]
    with open_scene(tmp_path / "scene.mkv", threads=1) as scene:
        assert len(scene) == len(frames)
        for frame in [*range(len(frames)), *np.random.default_rng(seed).integers(0, len(frames), 6).tolist()]:
            assert same(scene.codes(frame), frames[frame])


def test_every_frame_is_in_the_segment_that_says_so(scene_file):
    lengths = [frames for _, _, frames in SHAPES]
    with open_scene(scene_file[0]) as scene:
        assert [scene.segment_at(frame) for frame in range(21)] == np.repeat(np.arange(6), lengths).tolist()
        for outside in (-1, 21):
            with pytest.raises(IndexError, match="of a scene with 21 frames"):
                scene.segment_at(outside)


def test_constant_channels_and_a_still_scene_take_no_space(tmp_path):
    key = Codes(np.full((500, 3), 777, np.uint16), np.full((500, 10), 9, np.uint8))
    still = Segment(0, key, np.ones(500, bool), np.repeat(key.xyz[None], 4, 0), np.repeat(key.attributes[None], 4, 0))
    summary = write_scene(tmp_path / "scene.mkv", save(tmp_path, [still]), make_header(5))
    assert set(summary.track_bytes) == {"key"}
    with open_scene(tmp_path / "scene.mkv") as scene:
        assert len(scene.index.tracks[0].mosaic.channels) == 1
        assert all(same(scene.codes(frame), still.frame(frame)) for frame in range(5))


def test_frames_and_scenes_without_anybody_come_back(tmp_path):
    segments = random_sequence(3, [(60, 30, 4), (1, 1, 2)])
    segments[0].key.attributes[:, OPACITY] = 0
    segments[0].attributes[1, :, OPACITY] = 0
    segments[1].key.attributes[:, OPACITY] = segments[1].attributes[:, :, OPACITY] = 0
    for tolerance in (Tolerance(), Tolerance(3, 1)):
        path, options = tmp_path / "scene.mkv", EncodeOptions(tolerance)
        write_scene(path, save(tmp_path, segments), make_header(6), options=options)
        with open_scene(path) as scene:
            present = [int((scene.codes(frame).attributes[:, OPACITY] > 0).sum()) for frame in range(6)]
        assert present[0] == present[2] == present[4] == present[5] == 0
        assert present[1] == int((segments[0].attributes[0, :, OPACITY] > 0).sum()) > 0


def test_floats_are_those_of_the_quantizer(scene_file):
    path, frames = scene_file
    with open_scene(path) as scene:
        for frame in (0, 3, 6, 9, 20):
            got, expected = scene.gaussians(frame), quantizer().decode(frames[frame])
            for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
                assert np.array_equal(getattr(got, name), getattr(expected, name))


@pytest.mark.parametrize("order", [range(21), (20, 3, 4, 4, 12, 0, 1, 13), (5, 2, 5)], ids=["on", "jumps", "back"])
def test_floats_in_place_are_the_same(scene_file, order):
    path, frames = scene_file
    shown = None
    with open_scene(path) as scene:
        for frame in order:
            shown, expected = scene.gaussians(frame, into=shown), quantizer().decode(frames[frame])
            for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
                assert np.array_equal(getattr(shown, name), getattr(expected, name))


def test_codes_are_the_callers_own(scene_file):
    path, frames = scene_file
    with open_scene(path) as scene:
        scene.codes(1).xyz[:] = 0
        scene.codes(1).attributes[:] = 0
        assert same(scene.codes(2), frames[2])


def test_the_header_comes_back(scene_file):
    written = make_header(21)
    with open_scene(scene_file[0]) as scene:
        header = scene.header
    assert np.array_equal(header.times_ns, written.times_ns)
    assert (header.rate, header.held_out, header.sync, header.extra) == (
        written.rate,
        written.held_out,
        written.sync,
        written.extra,
    )
    assert header.quantizer.to_json() == written.quantizer.to_json()
    assert [camera.to_json() for camera in header.cameras] == [camera.to_json() for camera in written.cameras]


def test_frames_are_found_by_time(scene_file):
    with open_scene(scene_file[0]) as scene:
        times = scene.header.times_ns.tolist()
        assert [scene.frame_at(time) for time in times] == list(range(21))
        assert [scene.frame_at(time - 1) for time in times] == [0, *range(20)]
        assert scene.frame_at(times[-1] + 10**12) == 20
        with pytest.raises(IndexError, match="frame 21 of a scene with 21 frames"):
            scene.codes(21)


def test_iteration_gives_every_frame(scene_file):
    path, frames = scene_file
    with packuv.open(str(path)) as scene:
        for gaussians, codes in zip(scene, frames, strict=True):
            assert np.array_equal(gaussians.means, quantizer().decode(codes).means)
        assert len(list(scene)) == 21  # a second time


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_looking_ahead_changes_nothing(scene_file, threads):
    path, frames = scene_file
    order = [*range(21), 3, 4, 5, 4, 20, 0, 1, 6, 7, 8, 9, 10, 2, 19, 20]
    with open_scene(path, threads=threads) as scene:
        for frame in order:
            assert same(scene.codes(frame), frames[frame])


def test_parallel_readers_do_not_disturb_each_other(scene_file):
    path, frames = scene_file

    def read(seed):
        with open_scene(path, threads=2) as scene:
            for frame in np.random.default_rng(seed).permutation(21).tolist() + list(range(21)):
                assert same(scene.codes(frame), frames[frame])
                assert len(scene.gaussians(frame)) == len(frames[frame])
        return True

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(read, range(4)))


def test_keys_are_read_in_a_bounded_number(tmp_path):
    segments = random_sequence(5, [(200, 20, 2)] * 12, shared=0.9)
    summaries = {}
    for reach in (1, 3):
        options = EncodeOptions(reach=reach)
        path = tmp_path / f"{reach}.mkv"
        summaries[reach] = write_scene(path, save(tmp_path, segments), make_header(24), options=options)
        with open_scene(path) as scene:
            for number, frames in enumerate(frames_of(segments, reach)):
                assert same(scene.codes(number), frames)
            assert max(len(scene._way(number)) for number in range(12)) == reach
    assert summaries[3].track_bytes["key"] < 0.6 * summaries[1].track_bytes["key"]


def test_memory_stays_flat_over_a_thousand_frames(tmp_path):
    segments = random_sequence(2, [(600, 300, 20)], shared=0)
    segments = [replace(segments[0], first=20 * k) for k in range(50)]
    header = make_header(1000)
    write_scene(tmp_path / "scene.mkv", save(tmp_path, segments), header)
    held = []
    with open_scene(tmp_path / "scene.mkv") as scene:
        for frame, gaussians in enumerate(scene):
            if frame % 200 == 199:
                held.append(resident_bytes())
            del gaussians
    assert len(held) == 5
    assert held[-1] - held[0] < 4e6  # 800 frames' floats alone would be 27 MB


def resident_bytes():
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
def test_a_million_gaussians(tmp_path):
    segments = random_sequence(4, [(2**20, 2**18, 2), (2**20, 2**18, 2)])
    frames = frames_of(segments)
    write_scene(tmp_path / "scene.mkv", save(tmp_path, segments), make_header(4))
    with open_scene(tmp_path / "scene.mkv") as scene:
        assert scene.index.segments[1].own < 2**18
        assert all(same(scene.codes(frame), frames[frame]) for frame in (3, 0, 1, 2))


# With a tolerance


LOSSY = EncodeOptions(tolerance=Tolerance(20, 2))


@pytest.fixture(scope="module")
def lossy_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lossy")
    segments = random_sequence(0, SHAPES)
    write_scene(folder / "scene.mkv", save(folder, segments), make_header(21), options=LOSSY)
    return folder / "scene.mkv", frames_of(segments)


def test_a_lossy_scene_says_so_and_stays_within_its_tolerance(lossy_file, scene_file):
    path, frames = lossy_file
    assert verify_scene(path).ok
    assert path.stat().st_size < 0.95 * scene_file[0].stat().st_size
    worst = [0, 0]
    with open_scene(path) as scene:
        assert scene.index.tolerance == Tolerance(20, 2)
        for number, wanted in enumerate(frames):
            found = scene.codes(number)
            errors = [np.abs(getattr(found, n).astype(int) - getattr(wanted, n)) for n in ("xyz", "attributes")]
            worst = [max(w, int(e.max())) for w, e in zip(worst, errors, strict=True)]
            assert np.array_equal(found.attributes[:, OPACITY] > 0, wanted.attributes[:, OPACITY] > 0)
    assert worst == [20, 2]


def test_a_scene_that_moves_within_its_tolerance_needs_no_second_track(tmp_path):
    rng = np.random.default_rng(0)
    key = Codes(rng.integers(100, 65000, (50, 3), np.uint16), rng.integers(9, 250, (50, 10), np.uint8))
    xyz = np.stack([key.xyz + rng.integers(0, 3, key.xyz.shape, np.uint16) for _ in range(4)])
    moving = Segment(0, key, np.ones(50, bool), xyz, np.repeat(key.attributes[None], 4, 0))
    options = EncodeOptions(tolerance=Tolerance(2, 1))
    summary = write_scene(tmp_path / "scene.mkv", save(tmp_path, [moving]), make_header(5), options=options)
    assert set(summary.track_bytes) == {"key"}
    with open_scene(tmp_path / "scene.mkv") as scene:
        found = np.stack([scene.codes(frame).xyz.astype(int) for frame in range(1, 5)])
    wanted = next(stored_segments([moving], references=[None])).xyz
    assert np.abs(found - wanted).max() <= 2


def test_keys_of_a_lossy_scene_are_exact(lossy_file):
    path, frames = lossy_file
    with open_scene(path) as scene:
        for entry in scene.index.segments:
            assert same(scene.codes(entry.first), frames[entry.first])


def test_every_quality_has_its_tolerance_and_each_is_coarser_than_the_last():
    ladder = [TOLERANCES[quality] for quality in Quality]
    assert ladder[0].exact
    for finer, coarser in pairwise(ladder):
        assert finer.position < coarser.position
        assert finer.attribute <= coarser.attribute


# The beginning of a sequence


def test_a_run_that_stops_early_leaves_its_first_segments(scene_file, tmp_path):
    segments = random_sequence(0, SHAPES)
    paths = save(tmp_path, segments)
    for count in (1, 3, 6):
        frames = sum(len(segment) for segment in segments[:count])
        write_scene(tmp_path / "scene.mkv", paths[:count], make_header(21).first(frames))
        with open_scene(tmp_path / "scene.mkv") as scene:
            assert len(scene) == len(scene.header.times_ns) == frames
            assert all(same(scene.codes(k), wanted) for k, wanted in enumerate(scene_file[1][:frames]))
    assert (tmp_path / "scene.mkv").read_bytes() == scene_file[0].read_bytes()


# The file


def test_same_input_same_bytes_whatever_the_threads(scene_file, tmp_path):
    write_scene(tmp_path / "again.mkv", save(tmp_path, random_sequence(0, SHAPES)), make_header(21), threads=1)
    assert (tmp_path / "again.mkv").read_bytes() == scene_file[0].read_bytes()


@needs_ffmpeg
@pytest.mark.parametrize("kind", ["scene_file", "lossy_file"])
def test_the_decoder_in_the_document_reads_the_scene(kind, request):
    path, _ = request.getfixturevalue(kind)
    (code,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), flags=re.DOTALL)
    names: dict = {}
    exec(code, names)
    decoded = list(names["frames"](str(path)))
    assert len(decoded) == 21
    with open_scene(path) as scene:
        for frame, (xyz, attributes) in enumerate(decoded):
            assert same(Codes(xyz, attributes), scene.codes(frame))


@needs_ffmpeg
def test_ffmpeg_sees_the_same_pictures_and_the_checksum_fits_the_header(scene_file, tmp_path):
    path = scene_file[0]
    subprocess.run(
        ["ffmpeg", "-v", "error", "-dump_attachment:t", "", "-i", path, "-t", "0", "-f", "null", "-"],
        check=True,
        cwd=tmp_path,
    )
    checksum, name = (tmp_path / "packuv.sha256").read_text().split()
    assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == checksum
    header = json.loads((tmp_path / "packuv.json").read_text())
    command = ["ffmpeg", "-v", "error", "-i", path, "-map", "0:v:0", "-fps_mode", "passthrough", "-f", "rawvideo", "-"]
    raw = subprocess.run(command, check=True, capture_output=True).stdout
    with open_scene(path) as scene:
        starts = [segment["first"] for segment in header["segments"]]
        addresses = [Address(0, number, first) for number, first in enumerate(starts)]
        pictures = [scene._pictures.picture(address, []) for address in addresses]
    assert raw == b"".join(picture.tobytes() for picture in pictures)


def test_nothing_but_the_scene_is_left_behind(tmp_path):
    segments = save(tmp_path, random_sequence(1, [(50, 10, 3)]))
    (tmp_path / "out").mkdir()
    write_scene(tmp_path / "out/scene.mkv", segments, make_header(3))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["scene.mkv"]
    before = (tmp_path / "out/scene.mkv").read_bytes()
    with pytest.raises(ValueError, match="hold 3 frames, but the header has 4 times"):
        write_scene(tmp_path / "out/scene.mkv", segments, make_header(4))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["scene.mkv"]
    assert (tmp_path / "out/scene.mkv").read_bytes() == before


def test_progress_counts_every_frame_twice(tmp_path):
    steps = []
    segments = save(tmp_path, random_sequence(1, [(5, 5, 3), (5, 0, 2)]))

    def progress(done, total, note=""):
        steps.append((done, total))

    write_scene(tmp_path / "scene.mkv", segments, make_header(5), progress=progress)
    assert steps == [(done, 10) for done in range(1, 11)]


# Damage


def test_a_whole_file_verifies(scene_file):
    assert verify_scene(scene_file[0]) == VerifyReport(21)


def damaged(scene_file, tmp_path, content):
    path = tmp_path / "damaged.mkv"
    path.write_bytes(content)
    return path


def complaint(path, frames):
    """What is said about a file, empty if it is whole; frames that are called good are right, others are refused."""
    try:
        report = verify_scene(path, threads=1)
    except ValueError as error:
        return str(error)
    with open_scene(path, threads=1) as scene:
        for frame in sorted(set(range(len(frames))) - set(report.bad))[::3]:
            assert same(scene.codes(frame), frames[frame])
        for frame in report.bad[:1]:
            with pytest.raises(ValueError, match=re.escape(str(path))):
                scene.codes(frame)
    return report.problem


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_file_cut_anywhere_says_so(scene_file, tmp_path, data):
    content = scene_file[0].read_bytes()
    copy = len(without_copy(content))
    places = st.integers(0, len(content) - 1) | st.integers(copy - 1, len(content) - 1)
    path = damaged(scene_file, tmp_path, content[: data.draw(places)])
    assert str(path) in complaint(path, scene_file[1])


def test_a_file_cut_inside_its_second_copy_says_so_and_reads_whole(scene_file, tmp_path):
    content = scene_file[0].read_bytes()
    copy = len(without_copy(content))
    for place in (copy, copy + 1, copy + 9, (copy + len(content)) // 2, len(content) - 64, len(content) - 1):
        path = damaged(scene_file, tmp_path, content[:place])
        report = verify_scene(path, threads=1)
        assert report.header.startswith(f"{path} is cut short: it must have {len(content)} bytes, but has {place}")
        assert not report.bad
        assert not complaint(damaged(scene_file, tmp_path, content), scene_file[1])
    longer = damaged(scene_file, tmp_path, content + b"more")
    assert "something else follows" in complaint(longer, scene_file[1])


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_flipped_bit_never_gives_wrong_codes(scene_file, tmp_path, data):
    content = bytearray(scene_file[0].read_bytes())
    place = data.draw(st.integers(0, len(content) - 1) | st.integers(0, 6000))  # the headers are in the first 6 kB
    content[place] ^= 1 << data.draw(st.integers(0, 7))
    path = damaged(scene_file, tmp_path, bytes(content))
    assert str(path) in complaint(path, scene_file[1])


def test_a_damaged_packet_is_named_and_costs_the_rest_of_its_segment(scene_file, tmp_path):
    path, frames = scene_file
    with open_scene(path) as scene:
        entry = scene.index.segments[0]
        step = next(k for k, prediction in enumerate(entry.predictions, start=1) if prediction and k > 1)
        found = scene._source.read(1, entry.packet(step), step)
    content = bytearray(path.read_bytes())
    content[found.span(path)[0] + len(found.data) // 2] ^= 1
    report = verify_scene(damaged(scene_file, tmp_path, bytes(content)))
    assert report.bad == tuple(range(step, 5))
    start, stop = report.span
    assert report.track == "dynamic"
    assert (start, stop) == found.span(path)
    assert content[start:stop] != path.read_bytes()[start:stop]
    place = f"packet {entry.packet(step)} of track 'dynamic' (frame {step}, bytes {start} to {stop - 1})"
    assert place in report.problem
    with open_scene(tmp_path / "damaged.mkv") as scene:
        with pytest.raises(ValueError, match="differs from what was written"):
            scene.codes(4)
        assert same(scene.codes(0), frames[0])
        assert same(scene.codes(20), frames[20])


def test_a_damaged_key_costs_those_that_refer_to_it_and_no_others(scene_file, tmp_path):
    path, frames = scene_file
    with open_scene(path) as scene:
        entry = scene.index.segments[1]
        found = scene._source.read(0, 1, entry.first)
    content = bytearray(path.read_bytes())
    content[found.span(path)[0] + 40] ^= 16
    report = verify_scene(damaged(scene_file, tmp_path, bytes(content)))
    assert report.bad == tuple(range(5, 12))  # segments 1 and 2
    assert report.track == "key"
    assert "packet 1 of track 'key' (frame 5" in report.problem
    with open_scene(tmp_path / "damaged.mkv") as scene:
        for frame in (*range(5), *range(12, 21)):
            assert same(scene.codes(frame), frames[frame])


def elements(content, start, stop, depth=0):
    """Starts of all EBML elements of a Matroska file, those inside master elements included."""
    masters = {0x18538067, 0x1F43B675, 0x1654AE6B, 0xAE, 0xE0, 0x1941A469, 0x61A7, 0x1254C367, 0x7373, 0xA0, 0x1C53BB6B}
    while start < stop:
        yield start
        length = 9 - content[start].bit_length()
        name = int.from_bytes(content[start : start + length])
        place = start + length
        width = 9 - content[place].bit_length()
        size = int.from_bytes(content[place : place + width]) & ((1 << 7 * width) - 1)
        inside = place + width
        end = stop if size == (1 << 7 * width) - 1 else inside + size
        if name in masters:
            yield from elements(content, inside, end, depth + 1)
        start = end


def openable(path):
    """Whether a file's header is whole; if not, it is said which file's."""
    try:
        open_scene(path, threads=1).close()
    except ValueError as error:
        return str(path) not in str(error)
    return True


def test_a_file_cut_at_any_element_says_so_and_gives_what_is_left(scene_file, tmp_path):
    path, frames = scene_file
    content = path.read_bytes()
    starts = sorted(set(elements(content, 0, len(content))))
    with open_scene(path) as scene:
        entry = scene.index.segments[-1]
        last = scene._source.read(1, entry.packet(entry.frames - 1), 20).span(path)[0]
    places = [start for start in starts if 0 < start < last]
    assert len(places) > 90  # headers, both attachments, clusters, every block and what it is made of
    saved = []
    for place in places[:: max(1, len(places) // 60)]:
        cut = damaged(scene_file, tmp_path, content[:place])
        if not openable(cut):
            continue
        report = verify_scene(cut, threads=1)
        assert not report.ok
        good = sorted(set(range(21)) - set(report.bad))
        saved.append(len(good))
        with open_scene(cut, threads=1) as scene:
            assert all(same(scene.codes(frame), frames[frame]) for frame in good[-3:])
    assert saved == sorted(saved)  # the longer, the more
    assert saved[-1] >= 15


def copy_of(path):
    with path.open("rb") as file:
        return read_copy(file)


def resized(content):
    """With the size of the segment that belongs to so many bytes."""
    at = content.index(SEGMENT) + len(SEGMENT)
    return content[:at] + (len(content) - at - 8 | 1 << 56).to_bytes(8) + content[at + 8 :]


def without_copy(content):
    """A file as programs that know nothing of the copy write it."""
    return resized(content[: content.rindex(VOID + b"\0")])


def test_damage_to_the_header_is_named(scene_file, tmp_path):
    content = scene_file[0].read_bytes().replace(b'"rate":"30000/1001"', b'"rate":"30000/1002"')
    with pytest.raises(ValueError, match=r"header packuv\.json is damaged"):
        open_scene(damaged(scene_file, tmp_path, without_copy(content)))


def test_whose_header_or_copy_is_damaged_is_told_and_costs_no_frame(scene_file, tmp_path):
    content = scene_file[0].read_bytes()
    at = len(without_copy(content))
    first = content[:at].replace(b'"rate":"30000/1001"', b'"rate":"30000/1002"') + content[at:]
    structure = content[:3] + bytes([content[3] ^ 8]) + content[4:]
    second = content[: at + 40] + bytes([content[at + 40] ^ 8]) + content[at + 41 :]
    told = (
        r"packuv\.json is damaged.*the second copy was read",
        "the second copy was read",
        "second copy of its header",
    )
    for changed, words in zip((first, structure, second), told, strict=True):
        path = damaged(scene_file, tmp_path, changed)
        report = verify_scene(path, threads=1)
        assert not report.ok
        assert not report.bad
        assert re.search(words, report.header)
        assert str(path) in report.header
        assert report.problem == report.header


def test_no_damaged_byte_outside_of_packets_costs_anything(scene_file, tmp_path):
    """Of the file's structure, the header, its checksum, and the copy of it."""
    path, frames = scene_file
    content = path.read_bytes()
    copy = copy_of(path)
    free = np.ones(len(content), bool)
    with open_scene(path) as scene:
        for track, places in enumerate(copy.positions):
            for number, place in enumerate(places):
                free[place : place + scene.index.tracks[track].sizes[number]] = False
    rng = np.random.default_rng(0)
    parts = elements(content, 0, len(content))
    for place in [0, 3, len(content) - 1, *rng.choice(np.flatnonzero(free), 40), *rng.choice(list(parts), 40)]:
        changed = bytearray(content)
        changed[place] ^= 1 << rng.integers(8)
        assert complaint(damaged(scene_file, tmp_path, bytes(changed)), frames), f"byte {place} is changed"
        with open_scene(damaged(scene_file, tmp_path, bytes(changed)), threads=1) as scene:
            assert scene.header.times_ns.tolist() == copy_times(copy)
            for frame in (0, 4, 20):
                assert same(scene.codes(frame), frames[frame])


def test_an_open_scene_reads_on_without_its_name(scene_file, tmp_path, monkeypatch):
    path, frames = scene_file
    (tmp_path / "a.mkv").write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    with open_scene(Path("a.mkv"), threads=1) as scene:
        assert same(scene.codes(0), frames[0])
        monkeypatch.chdir("/")
        (tmp_path / "a.mkv").unlink()
        assert all(same(scene.codes(frame), frames[frame]) for frame in range(21))


def copy_times(copy):
    return json.loads(copy.header)["times_ns"]


def test_a_copy_of_another_scene_or_of_moved_packets_tells_nothing(scene_file, tmp_path):
    """As a program leaves it that changes the file before it."""
    path = scene_file[0]
    content = path.read_bytes()
    at = len(without_copy(content))
    other = content[at:].replace(b"packuv-copy", b"another-end")
    for changed in (content[:at], content[:at] + other):
        assert verify_scene(damaged(scene_file, tmp_path, resized(changed))).ok
    moved = resized(content[:at] + VOID + (100).to_bytes(7, "big") + bytes(100) + content[at:])
    report = verify_scene(damaged(scene_file, tmp_path, moved))
    assert not report.bad
    assert "bytes around its pictures are not those that were written" in report.header
    packed = zlib.compress(copy_of(path).header.replace(b'"30000/1001"', b'"30000/1002"')), zlib.compress(b"{}")
    append = b"".join(packed)
    end = _END.pack(hashlib.sha256(append).digest(), *map(len, packed), MAGIC)
    element = VOID + len(append + end).to_bytes(7, "big") + append + end
    assert verify_scene(damaged(scene_file, tmp_path, resized(content[:at] + element))).ok


def rewritten(scene_file, tmp_path, change):
    """The scene with another header, whose checksum fits again."""
    content = scene_file[0].read_bytes()
    start = content.index(b'{"cameras":')
    end = content.index(b"}", content.index(b'"version":')) + 1
    document = content[start:end]
    altered = change(document)
    assert len(altered) == len(document)
    old, new = (hashlib.sha256(text).hexdigest().encode() for text in (document, altered))
    return damaged(scene_file, tmp_path, content.replace(document, altered).replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"version":2', b'"version":1', "it is packuv-scene version 1, layout compact; this program reads"),
        (b'"version":2', b'"version":3', "it is packuv-scene version 3, layout compact; this program reads"),
        (b'"layout":"compact"', b'"layout":"compacT"', "layout compacT"),
        (b'"rows":300', b'"roWs":300', "segment 0 needs the field 'rows'"),
        (b'"rows":300', b'"rows":1e9', "segment 0: rows must be a whole number from 0 to 67108864"),
        (b'"frames":5', b'"frames":4', "segment 0: predictions must hold 3 numbers, but holds 4"),
        (b'"reference":3', b'"reference":5', "segment at frame 14 does not fit"),
        (b'"own":300', b'"own":299', "segment at frame 0 does not fit"),
        (b'"position":0', b'"position":-', "cannot be read"),
        (b'"width":64', b'"widtH":64', "camera 'cam1' needs the field 'width'"),
        (b'"sh0_g"', b'"sh0_h"', "cannot be read"),
    ],
)
def test_a_header_that_makes_no_sense_is_refused(scene_file, tmp_path, old, new, message):
    path = rewritten(scene_file, tmp_path, lambda document: document.replace(old, new))
    with pytest.raises(ValueError, match=re.escape(message)):
        open_scene(path)


def leaves(node, path=()):
    """Paths of everything inside a JSON document."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from leaves(value, (*path, key))


ODD_VALUES = [None, True, -1, 0, 1, 3, 10**9, 2**70, 0.5, "", "x", [], {}, [1], {"a": 1}, float("nan")]


@pytest.fixture(scope="module")
def parts(scene_file):
    """Header, packets in the order of the file, and tracks."""
    with open_scene(scene_file[0]) as scene:
        document, times = json.loads(copy_of(scene_file[0]).header), scene.header.times_ms
        packets = [
            Packet(address.track, int(times[address.frame]), 33, scene._source.read(*vars(address).values()).data)
            for address in scene._wanted(0, 0, 20)
        ]
        tracks = [entry.video(number) for number, entry in enumerate(scene.index.tracks)]
    return document, packets, tracks


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_header_with_odd_values_is_refused_or_reads_without_a_crash(parts, tmp_path, data):
    document, packets, tracks = parts
    document = copy.deepcopy(document)
    places = list(leaves(document))
    place = data.draw(st.sampled_from([n for n in places if len(n) < 3]) | st.sampled_from(places))
    node = document
    for key in place[:-1]:
        node = node[key]
    if data.draw(st.booleans()) and isinstance(node, dict):
        del node[place[-1]]
    else:
        node[place[-1]] = data.draw(st.sampled_from(ODD_VALUES))
    text = json.dumps(document).encode()
    checksum = f"{hashlib.sha256(text).hexdigest()}  packuv.json\n".encode()
    attachments = {"packuv.json": ("application/json", text), "packuv.sha256": ("text/plain", checksum)}
    odd = tmp_path / "odd.mkv"
    write_matroska(odd, tracks, packets, attachments, rate=Fraction(30))
    if openable(odd):
        report = verify_scene(odd, threads=1)
        assert report.ok or str(odd) in report.problem


def test_what_is_no_scene_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        open_scene(tmp_path / "missing.mkv")
    (tmp_path / "text.mkv").write_text("hello")
    with pytest.raises(ValueError, match="not a Matroska file"):
        verify_scene(tmp_path / "text.mkv")


# What cannot be written


def test_segments_must_follow_one_another_and_fit_the_quantizer(tmp_path):
    first, second = save(tmp_path, random_sequence(0, [(5, 2, 3), (5, 2, 3)]))
    with pytest.raises(ValueError, match="starts at instant 0, but the segment before it ends at 6"):
        write_scene(tmp_path / "scene.mkv", [second, first], make_header(6))
    with pytest.raises(ValueError, match="has 16 channels a row, but the header's quantizer 25"):
        write_scene(tmp_path / "scene.mkv", [first, second], make_header(6, degree=1))
    with pytest.raises(ValueError, match="at least one segment"):
        write_scene(tmp_path / "scene.mkv", [], make_header(0))
    empty = Codes(np.empty((0, 3), np.uint16), np.empty((0, 10), np.uint8))
    nothing = Segment(0, empty, np.empty(0, bool), np.empty((0, 0, 3), np.uint16), np.empty((0, 0, 10), np.uint8))
    with pytest.raises(ValueError, match="holds no Gaussians"):
        write_scene(tmp_path / "scene.mkv", save(tmp_path, [nothing]), make_header(1))


def test_a_header_is_checked_at_once():
    times = np.arange(3, dtype=np.int64) * 10**7
    with pytest.raises(ValueError, match="frames 1 and 2 are 400000 ns apart"):
        SceneHeader(quantizer(), np.array([0, 10**7, 10**7 + 400_000]), Fraction(30))
    with pytest.raises(ValueError, match="int64"):
        SceneHeader(quantizer(), times.astype(float), Fraction(30))
    with pytest.raises(ValueError, match="held-out cameras"):
        SceneHeader(quantizer(), times, Fraction(30), held_out=("cam9",))
    with pytest.raises(ValueError, match="plain JSON"):
        SceneHeader(quantizer(), times, Fraction(30), extra={"a": np.float32(1)})
    with pytest.raises(ValueError, match=r"up, extra\.up, must be a unit vector"):
        SceneHeader(quantizer(), times, Fraction(30), extra={"up": [0, 0, 2]})
    with pytest.raises(ValueError, match=r"extra\.up"):
        SceneHeader(quantizer(), times, Fraction(30), extra={"up": "north"})
    assert SceneHeader(quantizer(), times, Fraction(30), extra={"up": [0, 0.6, 0.8]}).up == (0, 0.6, 0.8)
    assert SceneHeader(quantizer(), times, Fraction(30)).up is None
    with pytest.raises(ValueError, match="rate must be positive"):
        SceneHeader(quantizer(), times, Fraction(0))
