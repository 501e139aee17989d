"""Capture folders: what is found in them, and what is said about those that do not work."""

import doctest
import unicodedata
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sync.capture
from sync.align import load_index, save_index
from sync.capture import (
    CaptureSettings,
    check_name,
    find_capture,
    find_lender,
    find_plate,
    load_timecodes,
    probe_capture,
)
from sync.clock import ClockMode
from sync.masks import find_masks
from sync.probe import ColourTags, VideoInfo
from sync.timecode import Timecodes


def make_capture(folder: Path, *files: str, settings: str | None = None) -> Path:
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(b"content")
    folder.mkdir(exist_ok=True)
    if settings is not None:
        (folder / "capture.toml").write_text(settings)
    return folder


UNTAGGED = ColourTags("yuv420p", 8, None, None, None, None)


def make_info(frames: int) -> VideoInfo:
    times = np.arange(frames, dtype=np.int64) * 40_000_000
    return VideoInfo(64, 48, "h264", Fraction(25), frames, times, frames * 40_000_000, 1000, UNTAGGED)


VIDEOS = ("videos/cam1.mp4", "videos/cam2.mkv", "videos/cam10.mov")


def test_a_bare_folder_of_videos_is_a_capture(tmp_path: Path) -> None:
    capture = find_capture(make_capture(tmp_path / "dance", *VIDEOS))
    assert capture.name == "dance"
    assert capture.cameras == ("cam1", "cam2", "cam10")
    assert capture.timecodes == {}
    assert capture.calibration is None
    assert capture.settings == CaptureSettings()


def test_files_that_are_no_videos_are_passed_over(tmp_path: Path) -> None:
    others = ("videos/.DS_Store", "videos/notes.txt", "videos/cam1.JPG", "videos/old/cam3.mp4", "masks/cam1/0.png")
    assert find_capture(make_capture(tmp_path, *VIDEOS, *others)).cameras == ("cam1", "cam2", "cam10")


def test_settings_are_read(tmp_path: Path) -> None:
    text = """
        name = "dance"
        fps = 29.97
        tags = ["studio", "fast"]
        reference = "cam2"
        held_out = ["cam10"]
        ignore = ["cam1"]
        clock = "triggered"
        calibration = "solve"
        timecode_column = "pts_ns"
        transfer = "slog3"
        time_offset_s = { cam3 = -0.0333, cam10 = 2 }
    """
    files = (*VIDEOS, "videos/cam3.mp4", "calibration/transforms.json", "timecodes/cam1.txt", "timecodes/cam2.csv")
    capture = find_capture(make_capture(tmp_path, *files, settings=text))
    assert capture.name == "dance"
    assert capture.cameras == ("cam2", "cam3", "cam10")
    assert set(capture.timecodes) == {"cam2"}
    assert capture.calibration is None
    settings = capture.settings
    assert settings.fps == Fraction(30000, 1001)
    assert settings.tags == ("studio", "fast")
    assert (settings.reference, settings.held_out, settings.ignore) == ("cam2", ("cam10",), ("cam1",))
    assert settings.clock is ClockMode.TRIGGERED
    assert settings.timecode_column == "pts_ns"
    assert settings.transfer == "slog3"
    assert settings.time_offset_s == {"cam3": Decimal("-0.0333"), "cam10": 2}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("heldout = []", "unknown key 'heldout'; did you mean 'held_out'"),
        ("colour = 1", "unknown key 'colour'; known are"),
        ("name =", "is no TOML"),
        ("fps = 'fast'", "fps: a frame rate is a number"),
        ("fps = 0", "fps: a frame rate lies between"),
        ("clock = 'sundial'", "clock: .*sundial"),
        ("transfer = 'slog'", "transfer must be one of sdr, hlg, .*, but is 'slog'; did you mean 'slog3'"),
        ("name = 3", "name must be a text, but is 3"),
        ("tags = 'a'", "tags must be a list of texts"),
        ("ignore = [1]", "ignore must be a list of texts"),
        ("reference = 'cam3'", "reference names 'cam3', which has no video; did you mean 'cam"),
        ("held_out = ['left']", "held_out names 'left', which has no video$"),
        ("ignore = ['cam1']\nreference = 'cam1'", r"\['cam1'\] cannot be ignored"),
        ("ignore = ['cam1', 'cam2']", "at least two cameras"),
        ("calibration = 'rig.json'", "calibration = 'rig.json', but .* is not there"),
        ("time_offset_s = 3", "time_offset_s must be a table of seconds by camera, but is 3"),
        ("time_offset_s = { cam1 = 'late' }", "time_offset_s of 'cam1' must be a number of seconds, .* but is 'late'"),
        ("time_offset_s = { cam1 = nan }", "time_offset_s of 'cam1' must be a number of seconds"),
        ("time_offset_s = { cam1 = 1e9 }", "time_offset_s of 'cam1' must be a number of seconds, at most 1000000"),
        ("time_offset_s = { cam1 = 1e999999999 }", "time_offset_s of 'cam1' must be a number of seconds, at most"),
        ("time_offset_s = { cam3 = 1 }", "time_offset_s names 'cam3', which has no video; did you mean 'cam"),
        ("calibration = 'solve'\nrig_from = 'take01'", "from rig_from or from calibration, not both"),
    ],
)
def test_bad_settings_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        find_capture(make_capture(tmp_path, *VIDEOS, settings=text))


def test_folders_that_are_no_capture(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="none is no folder"):
        find_capture(tmp_path / "none")
    with pytest.raises(ValueError, match="must have a folder 'videos'"):
        find_capture(tmp_path)
    with pytest.raises(ValueError, match="at least two cameras"):
        find_capture(make_capture(tmp_path, "videos/cam1.mp4"))
    with pytest.raises(ValueError, match=r"two files for 'cam1': cam1\.mkv and cam1\.mp4"):
        find_capture(make_capture(tmp_path, "videos/cam1.mkv"))


# Names

GOOD_NAMES = ("dance", "7", "take 2 (b)", "a.b_c-d+e", "танец", "नृत्य", "舞" * 66, "Mari\u0061\u0308", "x" * 100)
BAD_NAMES = (
    "",
    ".",
    "..",
    "../../escaped",
    "/etc",
    "a/b",
    "a\\b",
    "a\0b",
    "a\nb",
    "\x1b[2J",
    ".hidden",
    "_a",
    "-rf",
    "a.",
    "a ",
)
BAD_NAMES += (
    " a",
    "x" * 101,
    "舞" * 67,
    "\u0308a",
    "a\u202eb",
    "a\u200bb",
    "\udcff",
    "c:",
    "a*",
    "a?b",
    "a#b",
    "²",
    "a\u2028",
)


@pytest.mark.parametrize("name", GOOD_NAMES)
def test_names_of_sequences(tmp_path: Path, name: str) -> None:
    assert check_name(name) == name
    assert find_capture(make_capture(tmp_path / name, *VIDEOS)).name == name
    assert find_capture(make_capture(tmp_path / "b", *VIDEOS, settings=f'name = "{name}"')).name == name


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names_that_sequences_must_not_have(name: str) -> None:
    with pytest.raises(ValueError, match="a sequence's name must have 1 to 100 letters, digits, spaces and"):
        check_name(name)


@given(st.text(max_size=120))
def test_a_name_that_passes_is_one_visible_folder(name: str) -> None:
    try:
        check_name(name)
    except ValueError:
        return
    path = Path("out") / name
    assert path.parent == Path("out")
    assert path.name == name
    assert not name.startswith((".", "-"))
    assert not any(unicodedata.category(character)[0] in "CZ" for character in name.replace(" ", ""))
    assert len(name.encode()) <= 200


def test_a_bad_name_says_where_it_comes_from(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"but is '#1', the folder's; set 'name' in .*#1/capture\.toml$"):
        find_capture(make_capture(tmp_path / "#1", *VIDEOS))
    with pytest.raises(ValueError, match=r"but is '\.\./x'; change 'name' in .*capture\.toml$"):
        find_capture(make_capture(tmp_path / "a", *VIDEOS, settings="name = '../x'"))


@pytest.mark.parametrize("camera", ["a\\b", "a\nb", "\x1b[2J", " a", "a ", "\udcff", "a\u202eb", "x" * 101, "舞" * 67])
def test_names_that_cameras_must_not_have(tmp_path: Path, camera: str) -> None:
    with pytest.raises(ValueError, match="a camera's name must have 1 to 100 printable characters") as error:
        find_capture(make_capture(tmp_path, *VIDEOS, f"videos/{camera}.mp4"))
    assert str(error.value).isprintable()


@pytest.mark.parametrize("camera", ["..a", "-i", "%03d", "<b>", "a#b?c", "cam 1", "$(reboot)", "x" * 100])
def test_names_of_cameras_stay_names_of_files(tmp_path: Path, camera: str) -> None:
    """A stem has no slash, so what is made of it lies in the folder where it is made; hidden files are passed over."""
    cameras = find_capture(make_capture(tmp_path, *VIDEOS, f"videos/{camera}.mp4")).cameras
    assert set(cameras) == {"cam1", "cam2", "cam10"} | ({camera} if camera[0] != "." else set())
    times = Timecodes(np.arange(3, dtype=np.int64), np.arange(3, dtype=np.int64))
    save_index(dict.fromkeys(cameras, times), None, tmp_path / "out")
    assert {path.relative_to(tmp_path / "out").parts[0] for path in (tmp_path / "out").rglob("*")} == {"index"}
    assert set(load_index(tmp_path / "out")) == set(cameras)


# Timecodes


def test_timecodes_are_found_by_camera_or_shared(tmp_path: Path) -> None:
    own = make_capture(tmp_path / "own", *VIDEOS, *(f"timecodes/cam{n}.txt" for n in (1, 2, 10)), "timecodes/.hidden")
    assert {camera: path.name for camera, path in find_capture(own).timecodes.items()} == {
        "cam1": "cam1.txt",
        "cam2": "cam2.txt",
        "cam10": "cam10.txt",
    }
    shared = make_capture(tmp_path / "shared", *VIDEOS, "timecodes/timestamps.csv")
    assert set(find_capture(shared).timecodes.values()) == {shared / "timecodes" / "timestamps.csv"}


@pytest.mark.parametrize(("own", "other"), [("NFD", "NFC"), ("NFC", "NFD")])
def test_umlauts_are_the_same_however_they_are_written(tmp_path: Path, own: str, other: str) -> None:
    def written(form: str) -> str:
        return unicodedata.normalize(form, "S\u00fcd")  # type: ignore[arg-type]  # the form is one of two

    name = written(other)
    files = (f"videos/{written(own)}.mp4", "videos/b.mp4", "videos/c.mp4", f"timecodes/{name}.txt", "timecodes/b.txt")
    masks = f"Masks/{name}/0.png"
    settings = f'held_out = ["{name}"]\nreference = "b"\ntime_offset_s = {{ "{name}" = 1 }}\n'
    capture = find_capture(make_capture(tmp_path, *files, "timecodes/c.txt", masks, settings=settings))
    assert capture.cameras == ("b", "c", written("NFC"))
    assert capture.timecodes[written("NFC")].is_file()
    assert capture.videos[written("NFC")].is_file()
    assert capture.settings.held_out == (written("NFC"),)
    assert list(capture.settings.time_offset_s) == [written("NFC")]
    assert find_masks(capture) == {written("NFC"): tmp_path / "Masks" / name}


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (("timecodes/cam01.txt",), r"cam01\.txt belongs to no video; did you mean 'cam1'"),
        (("timecodes/cam1.txt", "timecodes/cam1.csv"), r"two files for 'cam1'"),
        (("timecodes/timestamps.csv", "timecodes/cam1.csv"), r"timestamps\.csv or one file per camera"),
    ],
)
def test_timecodes_that_belong_nowhere(tmp_path: Path, files: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        find_capture(make_capture(tmp_path, *VIDEOS, *files))


def test_timecodes_are_numbered_by_the_frames_of_the_video(tmp_path: Path) -> None:
    folder = make_capture(tmp_path, "videos/a.mp4", "videos/b.mp4", "timecodes/a.txt")
    (folder / "timecodes" / "a.txt").write_text(
        "frame_1734551081928174_000000000070\nframe_1734551081962493_000000000072\n"
    )
    (folder / "timecodes" / "b.csv").write_text("frame,time_us\n4,1734551081928174\n5,1734551081962493\n")
    capture = find_capture(folder)
    found = load_timecodes(capture, {"a": make_info(3), "b": make_info(2)})
    assert found["a"].indices.tolist() == [0, 2]
    assert found["b"].indices.tolist() == [0, 1]
    assert np.array_equal(found["a"].times_ns, found["b"].times_ns)
    with pytest.raises(ValueError, match="camera 'b' has 7 frames in its video, but 2 timecodes"):
        load_timecodes(capture, {"a": make_info(3), "b": make_info(7)})


def test_shared_timecodes_are_loaded(tmp_path: Path) -> None:
    folder = make_capture(tmp_path, "videos/cam_0.mp4", "videos/cam_1.mp4")
    (folder / "timecodes").mkdir()
    (folder / "timecodes" / "timestamps.csv").write_text("cam_id,frame_time\n0,1.5\n1,1.51\n1,1.6\n0,1.61\n")
    found = load_timecodes(find_capture(folder), {"cam_0": make_info(2), "cam_1": make_info(2)})
    assert found["cam_1"].times_ns.tolist() == [1510000000, 1600000000]


def test_without_timecodes_the_containers_serve(tmp_path: Path) -> None:
    capture = find_capture(make_capture(tmp_path, "videos/a.mp4", "videos/b.mp4"))
    found = load_timecodes(capture, {"a": make_info(3), "b": make_info(2)})
    assert found["a"].times_ns.tolist() == [0, 40_000_000, 80_000_000]


def test_timecodes_for_some_cameras_only_are_refused(tmp_path: Path) -> None:
    capture = find_capture(make_capture(tmp_path, "videos/a.mp4", "videos/b.mp4", "timecodes/a.txt"))
    with pytest.raises(ValueError, match=r"no file for \['b'\]"):
        load_timecodes(capture, {"a": make_info(3), "b": make_info(2)})


# Calibration


@pytest.mark.parametrize(
    ("files", "found"),
    [
        (("calibration/cameras.txt", "calibration/images.txt"), "calibration"),
        (("calibration/cameras.bin", "calibration/cameras.txt"), "calibration"),
        (("calibration/sparse/0/cameras.bin",), "calibration/sparse/0"),
        (("calibration/transforms.json", "calibration/readme.md"), "calibration/transforms.json"),
        (("calibration/poses_bounds.npy",), "calibration/poses_bounds.npy"),
        (("calibration/rig.json",), "calibration/rig.json"),
        (("calibration/colmap/cameras.txt",), "calibration/colmap"),
        (("calibration/intri.yml", "calibration/extri.yml"), "calibration"),
        (("calibration/camera_array.toml",), "calibration/camera_array.toml"),
        (("calibration/intri.yml",), "calibration"),
        (("calibration/params.txt", "calibration/notes.md"), "calibration"),
        (("calibration/.DS_Store",), None),
    ],
)
def test_calibrations_are_found(tmp_path: Path, files: tuple[str, ...], found: str | None) -> None:
    folder = make_capture(tmp_path, *VIDEOS, *files)
    assert find_capture(folder).calibration == (None if found is None else folder / found)


def test_of_several_calibrations_one_must_be_named(tmp_path: Path) -> None:
    folder = make_capture(tmp_path, *VIDEOS, "calibration/a.toml", "calibration/transforms.json")
    with pytest.raises(ValueError, match=r"one of \['calibration/transforms.json', 'calibration/a.toml'\]"):
        find_capture(folder)
    make_capture(folder, settings="calibration = 'calibration/a.toml'")
    assert find_capture(folder).calibration == folder / "calibration" / "a.toml"


# Other folders of the day


def make_day(folder: Path, **rig_from: str | None) -> None:
    """Takes, each with the rig of another one or with its own."""
    for name, source in rig_from.items():
        make_capture(folder / name, *VIDEOS, settings=f'rig_from = "{source}"' if source else "")


def test_a_chain_of_takes_leads_to_the_one_with_a_rig_of_its_own(tmp_path: Path) -> None:
    make_day(tmp_path, take01=None, take02="take01", take03="take02", far=str(tmp_path / "take03"))
    assert find_lender(find_capture(tmp_path / "take01")) is None
    for name in ("take02", "take03", "far"):
        lender = find_lender(find_capture(tmp_path / name))
        assert lender is not None
        assert lender.name == "take01"


def test_a_chain_that_goes_round_or_ends_nowhere_is_refused(tmp_path: Path) -> None:
    make_day(tmp_path, a="b", b="c", c="b", own="own", lost="take99")
    for name, way in (("a", "a -> b -> c -> b"), ("own", "own -> own")):
        with pytest.raises(ValueError, match=f"goes round: {way}"):
            find_lender(find_capture(tmp_path / name))
    with pytest.raises(FileNotFoundError, match="rig_from = 'take99', but there is no folder"):
        find_lender(find_capture(tmp_path / "lost"))


def test_a_lender_needs_all_cameras_and_another_name(tmp_path: Path) -> None:
    make_capture(tmp_path / "take01", *VIDEOS)
    more = make_capture(tmp_path / "take02", *VIDEOS, "videos/cam11.mp4", settings='rig_from = "take01"')
    with pytest.raises(ValueError, match=r"has no cameras \['cam11'\]; list them under 'ignore'"):
        find_lender(find_capture(more))
    (more / "capture.toml").write_text('rig_from = "take01"\nignore = ["cam1", "cam11"]')
    assert find_lender(find_capture(more)) == find_capture(tmp_path / "take01")
    (more / "capture.toml").write_text('rig_from = "take01"\nignore = ["cam11"]\nname = "take01"')
    with pytest.raises(ValueError, match="would go into one folder"):
        find_lender(find_capture(more))


def test_a_plate_has_videos_of_some_cameras(tmp_path: Path) -> None:
    take = make_capture(tmp_path / "take01", *VIDEOS, settings='clean_plate = "empty"')
    with pytest.raises(FileNotFoundError, match="clean_plate = 'empty', but there is no folder"):
        find_plate(find_capture(take))
    plate = make_capture(tmp_path / "empty", "videos/cam2.mp4", "videos/witness.mp4")
    assert find_plate(find_capture(take)) == {"cam2": plate / "videos/cam2.mp4"}
    (plate / "videos/cam2.mp4").unlink()
    with pytest.raises(ValueError, match="must have videos of"):
        find_plate(find_capture(take))
    assert find_plate(find_capture(make_capture(tmp_path / "take02", *VIDEOS))) == {}


def test_docstring_examples_hold() -> None:
    assert doctest.testmod(sync.capture).failed == 0
    assert doctest.testmod(sync.capture).attempted > 0


def test_files_that_were_begun_seconds_apart_are_named(tmp_path: Path) -> None:
    """By creation_time, unless clocks are hours apart and so were never set."""
    (tmp_path / "videos").mkdir()
    times = {"a": "10:00:00", "b": "10:00:01", "c": "10:00:12", "d": "09:59:58"}

    def noted(times: dict[str, str]) -> dict[str, str]:
        for name, time in times.items():
            with av.open(str(tmp_path / "videos" / f"{name}.mkv"), "w") as out:
                out.metadata["creation_time"] = f"2026-11-29T{time}Z"
                stream = out.add_stream("ffv1", rate=25)
                stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
                for _ in range(3):
                    out.mux(stream.encode(av.VideoFrame(32, 32, "yuv420p")))
                out.mux(stream.encode())
        capture = find_capture(tmp_path)
        codes = load_timecodes(capture, probe_capture(capture))
        return {name: " ".join(own.notes) for name, own in codes.items() if own.notes}

    found = noted(times)
    assert set(found) == {"c", "d"}
    assert "begun 12 s after those of most cameras" in found["c"]
    assert "begun 2 s before" in found["d"]
    assert not noted({**times, "c": "14:00:12"})
    (tmp_path / "timecodes").mkdir()
    for name in times:
        (tmp_path / "timecodes" / f"{name}.txt").write_text("0\n40000000\n80000000\n")
    assert not noted(times)
