"""The manifest of a data set: what is found, what is remembered, what is said about captures that do not work."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import av
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines import dataset, manifest
from pipelines.dataset import survey, unique_names
from pipelines.manifest import SCHEMA, Manifest, Row, read_manifest, scan, update, write
from sync.capture import check_name
from sync.probe import probe_video
from tasks.artefacts.digests import file_digest
from tests.support.pictures import write_picture
from tests.support.places import ROOT

GOLDEN = ROOT / "tests/golden/capture"


@pytest.fixture
def data_set(tmp_path: Path, monkeypatch) -> Path:
    """Two captures of one name, days apart; the files count as settled although they are new."""
    monkeypatch.setattr(manifest, "SETTLED_SECONDS", 0.0)
    for place in ("day1/dance", "day2/dance"):
        shutil.copytree(GOLDEN, tmp_path / "set" / place)
    return tmp_path / "set"


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    """Names of the videos that are opened."""
    names: list[str] = []

    def probe(path: Path):
        names.append(path.name)
        return probe_video(path)

    monkeypatch.setattr(manifest, "probe_video", probe)
    return names


def rows_of(data_set: Path) -> list[Row]:
    return list(update(data_set / "manifest.parquet", survey(data_set)).rows)


def test_a_row_says_what_a_camera_filmed(data_set):
    rows = rows_of(data_set)
    assert [(row.sequence, row.camera) for row in rows] == [
        (name, f"cam0{n}") for name in ("day1-dance", "day2-dance") for n in (1, 2, 3, 4, 5)
    ]
    for row in rows:
        assert row.path is not None
        video = Path(row.capture) / row.path
        info, stat = probe_video(video), video.stat()
        assert row == Row(
            sequence=row.sequence,
            capture=str(data_set / row.sequence.replace("-", "/")),
            camera=row.camera,
            path=f"videos/{row.camera}.mp4",
            codec="h264",
            width=info.width,
            height=info.height,
            frames=info.frame_count,
            fps="30",
            duration_s=info.duration_ns / 1e9,
            timecodes="file",
            timecode_path=f"timecodes/{row.camera}.txt",
            calibration="calibration",
            bytes=stat.st_size,
            mtime_ns=stat.st_mtime_ns,
            digest=file_digest(video),
            tags=("synthetic", "ring"),
            held_out=row.camera == "cam03",
            inode=stat.st_ino,
            ctime_ns=stat.st_ctime_ns,
            timecode_check=row.timecode_check,
        )


def test_what_is_written_is_read_again(data_set):
    path = data_set / "manifest.parquet"
    made = update(path, survey(data_set))
    assert read_manifest(path) == made
    assert [entry.sequence for entry in made.sequences] == ["day1-dance", "day2-dance"]
    assert made.sequences[1].capture == data_set / "day2/dance"
    assert sum((entry.rows for entry in made.sequences), ()) == made.rows
    schema = pq.read_schema(path)
    assert schema.equals(SCHEMA)
    assert schema.metadata[b"packuv_manifest"] == b"1"
    assert schema.metadata[b"dataset"] == os.fsencode(data_set)
    assert schema.field("frames").type == pa.int64()
    assert not schema.field("sequence").nullable


def test_a_second_scan_opens_no_video_and_writes_the_same_bytes(data_set, opened, monkeypatch):
    path = data_set / "manifest.parquet"
    update(path, survey(data_set))
    first = path.read_bytes()
    assert len(opened) == 10
    for reader in ("_digest", "file_timecodes"):
        monkeypatch.setattr(manifest, reader, lambda *_: pytest.fail("a file was read again"))
    update(path, survey(data_set))
    assert len(opened) == 10
    assert path.read_bytes() == first


def test_of_a_file_that_changed_only_its_row_changes(data_set, opened):
    before = rows_of(data_set)
    opened.clear()
    shutil.copy(GOLDEN / "videos/cam02.mp4", data_set / "day1/dance/videos/cam01.mp4")
    after = rows_of(data_set)
    assert opened == ["cam01.mp4"]
    assert after[0].digest == file_digest(GOLDEN / "videos/cam02.mp4")
    assert after[1:] == before[1:]


def test_time_and_size_put_back_do_not_hide_a_change(data_set, opened):
    rows_of(data_set)
    opened.clear()
    video = data_set / "day1/dance/videos/cam01.mp4"
    stat, content = video.stat(), bytearray(video.read_bytes())
    content[-1] ^= 1
    video.write_bytes(content)
    os.utime(video, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert rows_of(data_set)[0].digest == file_digest(video)
    assert opened == ["cam01.mp4"]


def test_a_file_that_was_just_changed_is_read_again(data_set, opened, monkeypatch):
    monkeypatch.setattr(manifest, "SETTLED_SECONDS", 3600.0)
    first = rows_of(data_set)
    assert {(row.inode, row.ctime_ns, row.timecode_check) for row in first} == {(None, None, None)}
    opened.clear()
    assert rows_of(data_set) == first
    assert len(opened) == 10


def test_long_reading_does_not_settle_a_file(data_set, monkeypatch):
    monkeypatch.setattr(manifest, "SETTLED_SECONDS", 0.5)

    def probe(path: Path):
        if path.parts[-4:] == ("day1", "dance", "videos", "cam01.mp4"):
            time.sleep(0.6)
        return probe_video(path)

    monkeypatch.setattr(manifest, "probe_video", probe)
    os.utime(data_set / "day1/dance/videos/cam01.mp4")
    assert rows_of(data_set)[0].ctime_ns is None


def test_a_file_that_changes_while_it_is_read_is_a_problem_until_it_stays(data_set, monkeypatch):
    def probe(path: Path):
        if path.parent.parent.parent.name == "day1" and path.stem == "cam04":
            os.utime(path)
        return probe_video(path)

    monkeypatch.setattr(manifest, "probe_video", probe)
    row = rows_of(data_set)[3]
    assert row.problem is not None
    assert row.problem.endswith("cam04.mp4 changed while it was read; scan again when it is whole")
    monkeypatch.undo()
    assert rows_of(data_set)[3].problem is None


def test_captures_come_and_go(data_set, opened):
    both = rows_of(data_set)
    opened.clear()
    shutil.move(data_set / "day2", data_set.parent / "elsewhere")
    left = rows_of(data_set)
    assert {row.sequence for row in left} == {"tiny"}  # its own name, now that no other has it
    assert [row.digest for row in left] == [row.digest for row in both[:5]]
    shutil.move(data_set.parent / "elsewhere", data_set / "day2")
    assert rows_of(data_set) == both
    assert len(opened) == 5


def test_a_data_set_that_was_moved_is_known(data_set, opened):
    rows_of(data_set)
    opened.clear()
    moved = data_set.rename(data_set.parent / "moved")
    rows = rows_of(moved)
    assert opened == []
    assert rows[0].capture == str(moved / "day1/dance")


# Captures that do not work


def problems(data_set: Path) -> dict[tuple[str, str | None], str]:
    rows = rows_of(data_set)
    assert read_manifest(data_set / "manifest.parquet").rows == tuple(rows)
    return {(row.sequence, row.camera): row.problem for row in rows if row.problem is not None}


def test_a_bad_video_is_the_problem_of_one_camera_and_is_remembered(data_set, opened):
    video = data_set / "day1/dance/videos/cam02.mp4"
    video.write_bytes(video.read_bytes()[:3000])
    found = problems(data_set)
    assert list(found) == [("day1-dance", "cam02")]
    assert "cam02.mp4" in found["day1-dance", "cam02"]
    row = rows_of(data_set)[1]
    assert (row.codec, row.frames, row.digest, row.fps, row.bytes) == (None, None, None, None, 3000)
    opened.clear()
    assert problems(data_set) == found
    assert opened == []
    assert [entry.problem is None for entry in read_manifest(data_set / "manifest.parquet").sequences] == [False, True]


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("name = ", "day1-dance", "is no TOML"),
        ("colour = 3", "day1-dance", "unknown key 'colour'"),
        ("name = '../../escaped'", "day1-dance", "a sequence's name must have"),
        ("ignore = ['cam01', 'cam02', 'cam03', 'cam04']", "dance", "at least two cameras"),
    ],
)
def test_bad_settings_are_the_problem_of_the_capture(data_set, text, name, message):
    (data_set / "day1/dance/capture.toml").write_text(text)
    first, *others = rows_of(data_set)
    assert first == Row(name, str(data_set / "day1/dance"), problem=first.problem)
    assert message in (first.problem or "")
    assert [row.sequence for row in others] == ["tiny"] * 5


def test_folders_that_are_almost_captures(data_set):
    (data_set / "empty/videos").mkdir(parents=True)
    (data_set / "bare").mkdir()
    (data_set / "bare/capture.toml").touch()
    (data_set / "not one").mkdir()
    found = problems(data_set)
    assert set(found) == {("bare", None), ("empty", None)}
    assert "must have a folder 'videos'" in found["bare", None]
    assert "at least two cameras" in found["empty", None]


def test_timecodes_that_do_not_fit_are_the_problem_of_their_camera(data_set, opened):
    path = data_set / "day1/dance/timecodes/cam04.txt"
    lines = path.read_text()
    rows_of(data_set)
    opened.clear()
    path.write_text("".join(lines.splitlines(keepends=True)[:-2]))
    found = problems(data_set)
    assert list(found) == [("day1-dance", "cam04")]
    assert "camera 'cam04' has 6 frames in its video, but 4 timecodes" in found["day1-dance", "cam04"]
    assert problems(data_set) == found
    path.write_text("what\n")
    assert "what" in problems(data_set)["day1-dance", "cam04"]
    path.unlink()
    assert "has no file for ['cam04']" in problems(data_set)["day1-dance", "cam04"]
    path.write_text(lines)
    assert problems(data_set) == {}
    assert opened == []


def test_a_rate_that_makes_labels_unreadable_is_seen(data_set):
    labels = "\n".join(f"10:00:00:{n:02d}" for n in range(6))
    for camera in (1, 2, 3, 4, 5):
        (data_set / f"day1/dance/timecodes/cam0{camera}.txt").write_text(labels)
    assert problems(data_set) == {}
    settings = data_set / "day1/dance/capture.toml"
    settings.write_text(settings.read_text().replace("fps = 30", "fps = 3"))
    assert len(problems(data_set)) == 5


def test_without_timecode_files_the_container_tells_the_times(data_set):
    shutil.rmtree(data_set / "day1/dance/timecodes")
    shutil.rmtree(data_set / "day1/dance/calibration")
    row = rows_of(data_set)[0]
    assert (row.timecodes, row.timecode_path, row.timecode_check, row.calibration) == ("container", None, None, None)


def test_names_that_are_no_text_are_a_problem(data_set):
    shutil.copytree(GOLDEN, data_set / "\udcff")
    shutil.copy(GOLDEN / "videos/cam01.mp4", data_set / "day1/dance/videos/\udcfe.mp4")
    found = problems(data_set)
    assert all("rename" in problem for problem in found.values())
    assert len(found) == 2


# Which folders are captures


def test_what_is_passed_over(data_set):
    for place in (".hidden/a", "day1/dance/inner", "runs/dance/a", "runs/dance/store/sync"):
        shutil.copytree(GOLDEN, data_set / place)
    (data_set / "runs/dance/run.json").touch()
    (data_set / "loop").symlink_to(data_set)
    (data_set / "day1/again").symlink_to(data_set / "day2/dance")
    (data_set / "round").symlink_to("round")
    (data_set / "broken").symlink_to("nowhere")
    assert [found.place for found in survey(data_set).captures] == ["day1/dance", "day2/dance"]


def test_a_link_leads_to_a_capture_elsewhere(data_set):
    (data_set / "day1/dance").rename(data_set.parent / "elsewhere")
    (data_set / "a").symlink_to(data_set.parent / "elsewhere")
    assert [found.place for found in survey(data_set).captures] == ["a", "day2/dance"]


def test_a_capture_is_a_data_set_of_one(data_set):
    (found,) = survey(data_set / "day1/dance").captures
    assert (found.place, found.name) == (".", "tiny")


def test_captures_are_in_natural_order(tmp_path):
    for place in ("take10", "take2", "a b", "a/c"):
        (tmp_path / place / "videos").mkdir(parents=True)
    assert [found.place for found in survey(tmp_path).captures] == ["a/c", "a b", "take2", "take10"]


def test_data_sets_without_captures(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere; a data set is a folder with capture folders"):
        survey(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"must hold capture folders, with videos/<camera>.mp4 in each, but has none"):
        survey(tmp_path)


def test_folders_that_cannot_be_read_are_told(data_set, monkeypatch):
    (data_set / "lost+found").mkdir()
    scandir = os.scandir  # root may read everything, so that taking away the right to read shows nothing

    def refuse(path):
        if Path(path).name == "lost+found":
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(dataset.os, "scandir", refuse)
    found = survey(data_set)
    assert len(found.captures) == 2
    assert found.unreadable == (data_set / "lost+found",)


# Names


PLACES = st.lists(st.text("aAb1-/ .#é\u0308ßS", min_size=1, max_size=8), max_size=12, unique=True)


@given(PLACES, st.data())
def test_every_place_gets_a_name_of_its_own(places, data):
    own = {place: data.draw(st.sampled_from([None, "a", "A", "a-b", "ß", "ss", "a1"])) for place in places}
    names = unique_names(own, root="a")
    assert set(names) == set(own)
    assert len({dataset._alike(name) for name in names.values()}) == len(own)
    assert all(check_name(name) for name in names.values())
    assert unique_names(own, root="a") == names


@pytest.mark.parametrize(
    ("own", "names"),
    [
        ({"x/a": "one", "y/a": "two"}, ["one", "two"]),
        ({"x/a": "a", "y/a": "A"}, ["x-a", "y-a"]),
        ({"x/a": "a", "x-a": "x-a", "y/a": "a"}, ["x-a-2", "x-a", "y-a"]),
        ({"x/#1": None, "x/_1": None}, ["x-_1", "x-_1-2"]),
        ({"/".join("x" * 90): "a", "b": "a"}, ["-".join("x" * 50) + "-", "b"]),
        ({".": None}, ["root"]),
        ({"###": None, "%%%": None}, ["capture", "capture-2"]),
    ],
)
def test_names_of_sequences(own, names):
    assert list(unique_names(own, root="root")[place] for place in own) == names


# The file


def test_files_that_are_no_manifest_are_left_alone(data_set):
    path = data_set / "manifest.parquet"
    path.write_text("notes")
    with pytest.raises(ValueError, match=r"manifest\.parquet must be a manifest, but is no Parquet file"):
        update(path, survey(data_set))
    assert path.read_text() == "notes"
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(ValueError, match="is no manifest of version 1"):
        update(path, survey(data_set))
    with pytest.raises(FileNotFoundError, match="packuv manifest DATASET -o"):
        read_manifest(data_set / "none.parquet")


def test_a_scan_that_is_stopped_keeps_what_it_has_read(data_set, opened, monkeypatch):
    path = data_set / "manifest.parquet"
    whole = rows_of(data_set)
    for row in whole:
        os.utime(Path(row.capture) / str(row.path))
    found = survey(data_set)

    def first_only(*arguments, **options) -> Iterator[list[Row]]:
        yield next(scan(*arguments, **options))
        raise KeyboardInterrupt

    monkeypatch.setattr(manifest, "scan", first_only)
    with pytest.raises(KeyboardInterrupt):
        update(path, found)
    kept = read_manifest(path).rows
    assert kept[:5] != tuple(whole[:5])
    assert kept[5:] == tuple(whole[5:])
    monkeypatch.undo()
    monkeypatch.setattr(manifest, "SETTLED_SECONDS", 0.0)
    monkeypatch.setattr(manifest, "probe_video", lambda path: opened.append(path.parts[-4]) or probe_video(path))
    opened.clear()
    assert rows_of(data_set)[:5] == list(kept[:5])
    assert set(opened) == {"day2"}


def test_reading_ends_when_nobody_wants_more(data_set):
    reading = scan(survey(data_set))
    next(reading)
    reading.close()


def test_progress_counts_the_bytes_that_are_read(data_set):
    heard: list[tuple[float, float]] = []
    update(data_set / "m.parquet", survey(data_set), progress=lambda done, total, note="": heard.append((done, total)))
    total = sum(path.stat().st_size for path in data_set.rglob("*.mp4"))
    assert heard[-1] == (total, total)
    assert heard == sorted(heard)


def test_rows_of_all_kinds_come_back(tmp_path):
    rows = (Row("a", "/a", problem="why"), Row("b", "/b", "cam", "videos/c", fps="30000/1001", tags=("x", "y z")))
    write(tmp_path / "m.parquet", Manifest(tmp_path, rows))
    assert read_manifest(tmp_path / "m.parquet") == Manifest(tmp_path, rows)


def test_a_folder_of_pictures_is_a_camera(data_set, opened):
    videos = data_set / "day1/dance/videos"
    with av.open(str(videos / "cam01.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    (videos / "cam01.mp4").unlink()
    for number, picture in enumerate(pictures):
        write_picture(videos / "cam01" / f"{number}.png", picture)
    row = rows_of(data_set)[0]
    height, width = pictures[0].shape[:2]
    assert (row.path, row.codec, row.width, row.height) == ("videos/cam01", "png", width, height)
    assert (row.frames, row.fps, row.duration_s, row.problem) == (len(pictures), None, None, None)
    assert row.digest == file_digest(videos / "cam01")
    assert row.bytes == sum(path.stat().st_size for path in (videos / "cam01").iterdir())
    opened.clear()
    assert rows_of(data_set)[0] == row
    assert opened == []
    write_picture(videos / "cam01" / "0.png", pictures[1])
    assert rows_of(data_set)[0].digest != row.digest
    assert opened == ["cam01"]
