"""Times by pictures: videos of balls whose cameras begin at times that are known, or whose timecodes lie."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from calibration.rig import Camera, Rig
from packuv.motion import MotionOptions
from pipelines.options import compose
from sync.align import AlignOptions, SyncReport
from sync.capture import CaptureSettings, find_capture
from sync.clock import ClockMode
from sync.content import Content, ContentOptions, Offset, Window, find_offsets
from sync.content.sound import RATE
from tasks.artefacts.stage import Files, Site
from tasks.artefacts.store import Key
from tasks.report.facts import ReportInput
from tasks.report.findings import findings
from tasks.stages.clock import FindStarts
from tasks.stages.content import OFFSETS, CompareContent, choose_windows, read_content
from tasks.stages.footage import RIG, Take
from tasks.stages.synchronize import Synchronize, read_starts, starts_of
from tasks.stages.track import MOTION, REPEATS, FindMotion, repeats_told
from tests.support.artefacts import build_here, put
from tests.support.balls import FOCAL, camera_pose, covered
from tests.support.balls import WIDTH as GRID
from tests.support.sounds import recorded, room, write_video

WIDTH, HEIGHT, FRAMES, COUNT = 160, 90, 80, 5
NAMES = tuple(f"cam{number}" for number in range(COUNT))
MOTION_OPTIONS = MotionOptions(keep_flow=False, width=WIDTH)


def film(
    folder: Path,
    late: dict[int, float],
    rates: dict[int, Fraction] | None = None,
    repeated: dict[int, list[int]] | None = None,
) -> None:
    """A video for each camera, which begins `late` instants after the first; bright balls before a grey ramp. `rates`
    are those of cameras that do not film 30 frames a second, `repeated` the numbers of the pictures that others have in
    place of their own."""
    (folder / "videos").mkdir(parents=True)
    wall = np.linspace(40, 90, WIDTH * HEIGHT).astype(np.uint8)
    for number, name in enumerate(NAMES):
        rate = (rates or {}).get(number, Fraction(30))
        times = np.arange(int(FRAMES * rate / 30)) * float(30 / rate) + late.get(number, 0.0)
        with av.open(str(folder / "videos" / f"{name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=rate)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "bgr0"
            for seen in covered(number, COUNT, times[(repeated or {}).get(number, slice(None))], WIDTH, HEIGHT):
                grey = np.where(seen, 230, wall).astype(np.uint8).reshape(HEIGHT, WIDTH)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.dstack([grey] * 3), format="rgb24")))
            container.mux(stream.encode())


def calibrated() -> Rig:
    cameras = []
    for number, name in enumerate(NAMES):
        turn, centre = camera_pose(number, COUNT)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ centre
        focal = FOCAL * WIDTH / GRID
        cameras.append(Camera(name, WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, pose))
    return Rig(tuple(cameras), "made up")


def write_calibration(folder: Path) -> None:
    frames = [
        {
            "file_path": f"images/{camera.name}.png", "w": camera.width, "h": camera.height, "fl_x": camera.fx,
            "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "transform_matrix": (np.linalg.inv(camera.camera_from_world) @ np.diag([1, -1, -1, 1])).tolist(),
        } for camera in calibrated().cameras
    ]  # fmt: skip
    (folder / "calibration").mkdir()
    (folder / "calibration" / "transforms.json").write_text(json.dumps({"frames": frames}))


def write_times(folder: Path, early: dict[int, int]) -> None:
    """Timecode files of microseconds; some cameras' say so many frames too early."""
    (folder / "timecodes").mkdir()
    for number, name in enumerate(NAMES):
        first = 1_700_000_000_000_000 - round(early.get(number, 0) * 1e6 / 30)
        lines = [f"frame_{first + round(k * 1e6 / 30)}_{k:012d}\n" for k in range(FRAMES)]
        (folder / "timecodes" / f"{name}.txt").write_text("".join(lines))


def synchronized(site: Site, folder: Path, starts: Key | None = None) -> Key:
    capture = find_capture(site.capture)
    stage = Synchronize(
        videos=Files(dict.fromkeys(NAMES, "content")),
        timecodes=Files(dict.fromkeys(capture.timecodes, "content")),
        fps=None,
        timecode_column=None,
        time_offset_s={name: str(seconds) for name, seconds in capture.settings.time_offset_s.items()},
        starts=starts,
        options=AlignOptions(clock=ClockMode.CONTENT if starts else ClockMode.TRUSTED),
    )
    return _made(stage, site, folder)


def _made(stage: Synchronize | FindMotion | FindStarts | CompareContent, site: Site, folder: Path) -> Key:
    _, out = build_here(stage, site, folder)
    return put(
        site, stage.name, lambda there: [path.rename(there / path.name) for path in out.iterdir()], at=str(folder)
    )


def compared(site: Site, folder: Path, groups: Key, *, keep_flow: bool = False) -> Key:
    """The check, with one camera whose motion nobody has measured, and flow of the others that is kept or is not."""
    options = replace(MOTION_OPTIONS, keep_flow=keep_flow)
    rig = put(site, "rig", lambda out: calibrated().save(out / RIG))
    take = Take(groups=groups, rig=rig, cameras=NAMES[:-1])
    motion = _made(FindMotion(take=take, options=options), site, folder / "motion")
    assert (site.path(motion) / MOTION).is_dir()
    return _made(
        CompareContent(take=take, unseen=NAMES[-1:], motion=motion, motion_options=options, options=ContentOptions()),
        site,
        folder / "content",
    )


def lies_in(content: Content) -> dict[str, float]:
    told = {name: content.worst(name) for name in content.cameras}
    return {name: own[1].away for name, own in told.items() if own is not None and own[1].lies}


@pytest.mark.parametrize("liar", [1, 4])
def test_a_camera_whose_timecodes_lie_is_named_and_its_cure_cures(tmp_path: Path, liar: int) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    film(site.capture, {})
    write_times(site.capture, {liar: 2})
    found = read_content(site.path(compared(site, tmp_path / "first", synchronized(site, tmp_path / "sync"))))
    assert {name: round(away) for name, away in lies_in(found).items()} == {f"cam{liar}": 2}
    assert not found.undecided

    (site.capture / "capture.toml").write_text(f"time_offset_s = {{ cam{liar} = {2 / 30:.4f} }}")
    groups = synchronized(site, tmp_path / "mended")
    again = read_content(site.path(compared(site, tmp_path / "again", groups)))
    assert not lies_in(again)
    assert "are added to its times, as time_offset_s" in (site.path(groups) / "sync.json").read_text()


def test_flow_that_is_kept_tells_what_flow_that_is_measured_anew_tells(tmp_path: Path) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    film(site.capture, {})
    write_times(site.capture, {2: -1})
    groups = synchronized(site, tmp_path / "sync")
    anew, kept = (
        site.path(compared(site, tmp_path / str(keep), groups, keep_flow=keep)) / OFFSETS for keep in (False, True)
    )
    assert anew.read_bytes() == kept.read_bytes()


def test_what_the_pictures_say_of_times_is_told(tmp_path: Path) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    film(site.capture, {})
    write_times(site.capture, {0: -1})
    groups = synchronized(site, tmp_path / "sync")
    content = read_content(site.path(compared(site, tmp_path / "first", groups)))
    report = ReportInput("balls", sync=SyncReport.load(site.path(groups)), content=content)
    (told,) = [found.text for found in findings(report) if "pictures" in found.text]
    assert told.startswith("The pictures of cam0 lie -1.0 frames")
    assert "time_offset_s = { cam0 = -0.03" in told


def test_cameras_that_lie_equally_are_told_to_be_a_group() -> None:
    offsets = {name: Offset(0.0, 0.1) for name in NAMES} | {name: Offset(3.0, 0.1) for name in NAMES[:2]}
    content = Content(NAMES, (Window(0, 79, offsets),))
    texts = [found.text for found in findings(ReportInput("balls", content=content))]
    (told,) = [text for text in texts if "about the same" in text]
    assert told.startswith("cam0, cam1 lie by about the same +3 frames, 2 of 5 cameras: pictures tell that two groups")
    apart = Content(NAMES, (Window(0, 79, offsets | {"cam1": Offset(-2.0, 0.1)}),))
    assert "about the same" not in " ".join(found.text for found in findings(ReportInput("balls", content=apart)))


def test_of_two_cameras_neither_is_said_to_be_right() -> None:
    content = Content(NAMES[:2], (Window(0, 79, {"cam0": Offset(3.0, 0.1), "cam1": Offset(0.0, 0.1)}),))
    texts = [found.text for found in findings(ReportInput("balls", content=content))]
    assert any(
        text.startswith("Of cam0 and cam1 the pictures tell that their times differ by 3 frames") for text in texts
    )


def test_cameras_without_times_are_synchronized_by_their_pictures(tmp_path: Path) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    late = {0: 6.0, 1: 0.0, 2: 3.4, 3: 11.0, 4: 1.0}
    film(site.capture, late)
    write_calibration(site.capture)
    found = find_starts(site, tmp_path / "clock", known=True)
    first = min(late.values())
    for name, start_ns in read_starts(site.path(found)).items():
        assert start_ns * 30 / 1e9 == pytest.approx(late[int(name[-1])] - first, abs=0.3)
    assert json.loads((site.path(found) / "starts.json").read_text())["by"] == "calibration"

    groups = synchronized(site, tmp_path / "sync", found)
    report = json.loads((site.path(groups) / "sync.json").read_text())["report"]
    assert report["clock"] == "content"
    assert {camera["source"] for camera in report["cameras"]} == {"what the cameras saw or heard"}
    content = read_content(site.path(compared(site, tmp_path / "check", groups)))
    assert not lies_in(content)


@pytest.mark.parametrize("rates", [{2: 15}, {2: 15, 0: 60, 4: 24}])
def test_cameras_of_other_rates_are_synchronized_by_their_pictures(tmp_path: Path, rates: dict[int, int]) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    late = {0: 6.0, 1: 0.0, 2: 3.4, 3: 11.0, 4: 1.0}
    film(site.capture, late, {number: Fraction(rate) for number, rate in rates.items()})
    write_calibration(site.capture)
    found = find_starts(site, tmp_path / "clock", known=True)
    for name, start_ns in read_starts(site.path(found)).items():
        assert start_ns * 30 / 1e9 == pytest.approx(late[int(name[-1])], abs=0.3)
    if len(rates) == 1:  # and what the check sees of the slower camera speaks for these starts
        groups = synchronized(site, tmp_path / "sync", found)
        content = read_content(site.path(compared(site, tmp_path / "check", groups)))
        assert not lies_in(content)
        assert not content.undecided
        notes = SyncReport.load(site.path(groups)).notes
        assert any(note.startswith("cam2: it films a frame each 67 ms, cam") for note in notes), notes


def test_a_camera_that_films_too_few_frames_is_named(tmp_path: Path) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    film(site.capture, {}, {3: Fraction(5)})
    write_calibration(site.capture)
    with pytest.raises(ValueError, match=r"when cam3 began.*; cam3 films 5 frames per second, most cameras 30"):
        find_starts(site, tmp_path / "clock", known=True)


def find_starts(site: Site, folder: Path, *, known: bool) -> Key:
    stage = FindStarts(
        videos=Files(dict.fromkeys(NAMES, "content")),
        timecodes=Files({}),
        calibration=Files({"transforms.json": "content"}) if known else None,
        options=MOTION_OPTIONS,
    )
    return _made(stage, site, folder)


def test_pictures_that_tell_nothing_are_no_clock(tmp_path: Path) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    (site.capture / "videos").mkdir(parents=True)
    for name in NAMES[:3]:
        with av.open(str(site.capture / "videos" / f"{name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "bgr0"
            for _ in range(30):
                container.mux(
                    stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), 90, np.uint8), format="rgb24"))
                )
            container.mux(stream.encode())
    with pytest.raises(
        ValueError, match=r"do not tell when cam0, cam1, cam2 began to film.*no sound in common; give a calibration"
    ):
        find_starts(site, tmp_path / "clock", known=False)


def test_cameras_that_hear_the_same_need_no_calibration(tmp_path: Path) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    (site.capture / "videos").mkdir(parents=True)
    late = {"cam0": 0.8, "cam1": 0.5, "cam2": 1.25}
    for number, (name, start) in enumerate(late.items()):
        write_video(site.capture / "videos" / f"{name}.mkv", recorded(room(), start, number)[: 8 * RATE])
    found = find_starts(site, tmp_path / "clock", known=False)
    for name, start_ns in read_starts(site.path(found)).items():
        assert start_ns / 1e9 == pytest.approx(late[name] - 0.5, abs=0.01)
    before = starts_of(SyncReport.load(site.path(started(site, tmp_path / "sync", found, tuple(late)))))
    (site.capture / "capture.toml").write_text("time_offset_s = { cam1 = 0.1 }")
    after = starts_of(SyncReport.load(site.path(started(site, tmp_path / "moved", found, tuple(late)))))
    assert {name: after[name] - before[name] for name in late} == {"cam0": 0, "cam1": 100_000_000, "cam2": 0}
    assert json.loads((site.path(found) / "starts.json").read_text())["by"] == "sound"


def started(site: Site, folder: Path, starts: Key, names: tuple[str, ...]) -> Key:
    said = find_capture(site.capture).settings.time_offset_s
    return _made(
        Synchronize(
            videos=Files(dict.fromkeys(names, "content")),
            timecodes=Files({}),
            fps=None,
            timecode_column=None,
            time_offset_s={name: str(seconds) for name, seconds in said.items()},
            starts=starts,
            options=AlignOptions(clock=ClockMode.CONTENT),
        ),
        site,
        folder,
    )


def test_starts_are_of_the_settings_by_which_times_are_read(tmp_path: Path) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    film(site.capture, {})
    (site.capture / "capture.toml").write_text("fps = 60")
    with pytest.raises(ValueError, match=r"settings of .* changed while they were read"):
        find_starts(site, tmp_path / "clock", known=False)


def test_the_clock_is_chosen_in_capture_toml() -> None:
    options = compose("draft", CaptureSettings(clock=ClockMode.CONTENT), {})
    assert options.sync.clock is ClockMode.CONTENT


def test_stretches_are_those_in_which_most_moves() -> None:
    moving = np.zeros(3000)
    moving[500:700] = moving[1500:1700] = moving[2500:2700] = 0.125
    assert choose_windows(moving, ContentOptions()) == [range(500, 700), range(1500, 1700), range(2500, 2700)]
    assert choose_windows(np.zeros(90), ContentOptions()) == [range(90)]
    assert choose_windows(np.zeros(410), ContentOptions()) == [range(205), range(205, 410)]
    assert find_offsets({}, 5) == {}


@pytest.mark.parametrize(
    ("shown", "still", "asked"),
    [
        ([min(k, 39) for k in range(FRAMES)], 40, "did it hang, or was its rate converted"),
        ([k - k % 2 for k in range(FRAMES)], 40, "did it hang, or was its rate converted"),
        ([0] * FRAMES, FRAMES - 1, "is its lens covered, or did it hang"),
        ([k - (k in (20, 50)) for k in range(FRAMES)], 0, ""),
    ],
)
def test_a_camera_that_repeats_pictures_is_named(tmp_path: Path, shown: list[int], still: int, asked: str) -> None:
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    film(site.capture, {}, repeated={2: shown})
    write_times(site.capture, {})
    groups, rig = synchronized(site, tmp_path / "sync"), put(site, "rig", lambda out: calibrated().save(out / RIG))
    take = Take(groups=groups, rig=rig, cameras=NAMES)
    notes, _ = build_here(FindMotion(take=take, options=MOTION_OPTIONS), site, tmp_path / "motion")
    assert notes.get(REPEATS, {}) == ({"cam2": [still, FRAMES - 1]} if still else {})
    told = list(repeats_told(notes))
    assert len(told) == bool(still)
    assert not still or f"cam2: {still} of {FRAMES - 1} pictures repeat the one before" in told[0]
    assert not still or asked in told[0]


def test_a_single_instant_has_no_motion(tmp_path: Path) -> None:
    """And a share of it is no figure that a receipt could not hold."""
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    film(site.capture, {})
    write_times(site.capture, {})
    groups, rig = synchronized(site, tmp_path / "sync"), put(site, "rig", lambda out: calibrated().save(out / RIG))
    take = Take(groups=groups, rig=rig, cameras=NAMES[:2], first=3, stop=4)
    notes, _ = build_here(FindMotion(take=take, options=MOTION_OPTIONS), site, tmp_path / "motion")
    assert notes == {"pictures": 0, "moving_share": 0.0}
