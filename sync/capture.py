"""A capture folder: one video per camera, and what belongs to them (docs/capture-folder.md)."""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from decimal import Decimal
from difflib import get_close_matches
from fractions import Fraction
from pathlib import Path
from statistics import median_low
from typing import Any

import numpy as np

from sync.chapters import unjoined
from sync.clock import ClockMode
from sync.natural import natural_key
from sync.offsets import MOST_OFFSET_S, find_offsets, offset_notes, read_offsets
from sync.pictures import PICTURE_SUFFIXES, holds_pictures, is_picture, list_pictures
from sync.probe import CONTAINER_TIMES, VideoInfo, container_timecodes, probe_video
from sync.timecode import NANOSECONDS, SUFFIXES, Timecodes, parse_rate, read_shared_timecodes, read_timecodes, together

VIDEO_FOLDERS = ("videos", "images", "rgbs", "ims")
"""Where the videos or pictures of the cameras lie: our own layout, then those that data sets publish"""
BESIDE_TIMECODES = frozenset(
    {".md", ".pdf", ".html", ".jpg", ".png", ".md5", ".sha256", ".toml", ".yaml", ".yml", ".xml"}
)
"""Endings of files in timecodes/ that hold none"""
UNITS_APART = (-9, -6, -3, 3, 6, 9)
"""Powers of ten between two units of time"""
RATE_OFF = 0.1
"""Share by which timecodes may run faster or slower than the container"""
LABELS_APART = 1.5
"""Frames that a label may be off a timecode file: it counts whole ones"""
UNSET = ("00:00:00:00", "00:00:00;00")
"""Labels that, where all cameras begin with them, nobody set: they count from where each recording began"""
BEGUN_APART_S, CLOCKS_SET_S = 1.5, 3600
"""Seconds that creation_time, which counts whole ones, must lie apart to mean something, and at most, or a clock is not
set"""
SHARED_TIMECODES, SHARED_SUFFIXES = "timestamps.csv", (".csv", ".tsv")
SETTINGS = "capture.toml"
MASKS_OF = re.compile(r"(.+)[_.-](?:f?masks?|mattes?|alpha|pha|seg)", re.IGNORECASE)
"""What masks beside a camera's video are called"""
SOLVE = "solve"
"""Value of `calibration` in capture.toml that asks for a fresh solution although a calibration lies in the folder."""
TRANSFERS = ("sdr", "hlg", "pq", "slog3", "vlog", "clog3", "logc3", "logc4", "log3g10", "linear")
"""Values of `transfer` in capture.toml; what they mean is packuv's, see `packuv.footage.transfer`."""
UPWARD = ("board", "cameras")
"""Values of `up` in capture.toml that are no direction: the side of a board that lies on the floor, or as the cameras
are held"""
SIDECAR_SUFFIXES = frozenset(
    {".aac", ".csv", ".db", ".ini", ".jpeg", ".jpg", ".json", ".log", ".lrv", ".m4a", ".md", ".mp3", ".pdf", ".png"}
    | {".srt", ".thm", ".toml", ".txt", ".wav", ".xml", ".yaml", ".yml"}
)
"""Files beside the videos that are not taken for one. All else is, for FFmpeg reads more than a list can name."""
LETTERS = frozenset({"Lu", "Ll", "Lt", "Lm", "Lo", "Mn", "Mc", "Nd"})
"""Unicode's categories of letters, of the marks that belong to them, and of digits"""
LONGEST_NAME, LONGEST_NAME_BYTES = 100, 200
"""Of a sequence or a camera, in characters and in UTF-8: names of files are made of it, which end at 255 bytes"""


@dataclass(frozen=True)
class CaptureSettings:
    """What capture.toml says; every key is optional."""

    name: str | None = None
    """Name of the sequence; None means the folder's"""
    fps: Fraction | None = None
    """Nominal frames per second; SMPTE labels need it"""
    tags: tuple[str, ...] = ()
    reference: str | None = None
    """Camera whose frames are the instants; None leaves it to coverage"""
    held_out: tuple[str, ...] = ()
    """Cameras that are calibrated but never fitted, to score the result on"""
    ignore: tuple[str, ...] = ()
    """Cameras that are left out altogether"""
    clock: ClockMode = ClockMode.TRUSTED
    calibration: str | None = None
    """Where the calibration is, relative to the capture, or 'solve'; None looks into calibration/"""
    timecode_column: str | None = None
    """Time column of the CSV or JSON timecodes, where there are several"""
    time_offset_s: Mapping[str, Decimal] = field(default_factory=dict)
    """Seconds to add to the times of cameras whose timecodes are off"""
    transfer: str | None = None
    """One of TRANSFERS: what the code values of all videos mean; None leaves it to their tags"""
    rig_from: str | None = None
    """Capture folder whose rig is this one's, beside this folder or absolute"""
    clean_plate: str | None = None
    """Folder with videos of the empty stage, filmed by the same rig; likewise"""
    board: Mapping[str, Any] | None = None
    """A board of known size that the videos show; what its keys mean is calibration's, see `calibration.board.Board`"""
    distance: tuple[Mapping[str, Any], ...] = ()
    """Known distances, likewise, see `calibration.scale.Distance`"""
    up: str | tuple[float, float, float] | None = None
    """Where up is: one of UPWARD, or a direction in the calibration's world; None leaves it open"""

    @classmethod
    def read(cls, path: Path) -> CaptureSettings:
        """Read a capture.toml.

        Raises:
            ValueError: not TOML, an unknown key or a value of the wrong kind, each by name.
        """
        try:
            # decimals stay exact, so that 29.97 can be told from 29.970000000000001
            data = tomllib.loads(path.read_text(encoding="utf-8"), parse_float=Decimal)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is no TOML: {error}") from None
        known = set(cls.__dataclass_fields__)
        for key in data:
            if key not in known:
                raise ValueError(f"{path}: unknown key {key!r}{suggest(key, known)}; known are {sorted(known)}")
        return cls(**{key: _checked(path, key, value) for key, value in data.items()})


@dataclass(frozen=True)
class Capture:
    """The files of one sequence. Cameras are in natural order: cam2 before cam10."""

    folder: Path
    name: str
    videos: dict[str, Path]
    """By camera, without the ignored ones; a folder is one of numbered pictures"""
    timecodes: dict[str, Path]
    """By camera; cameras without a file of their own are missing, all may share one"""
    calibration: Path | None
    """File or folder to import; None means that the rig must be solved"""
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    offsets: Path | None = None
    """t_offsets.json, where there is one"""
    notes: tuple[str, ...] = field(default=(), compare=False)
    """What lies beside the videos and was passed over, one sentence each"""

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.videos)


def find_capture(folder: Path) -> Capture:
    """Find the videos, timecodes, calibration and settings of a capture folder. Opens no video.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: not a capture, two files for one camera, or settings that name what is not there.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; a capture is a folder with videos/<camera>.mp4 in it")
    path = folder / SETTINGS
    settings = CaptureSettings.read(path) if path.is_file() else CaptureSettings()
    inside, videos = _find_videos(folder)
    _check_names(path, settings, videos)
    kept = {camera: video for camera, video in videos.items() if camera not in settings.ignore}
    if len(kept) < 2:
        raise ValueError(
            f"{folder} must hold videos of at least two cameras that are not ignored, but has {list(kept)}"
            f"{_advice(_passed_over(folder, inside, videos))}"
        )
    _check_masks(folder, kept)
    timecodes = _find_timecodes(folder, videos)
    if settings.rig_from is not None and settings.calibration is not None:
        raise ValueError(f"{path}: the rig comes from rig_from or from calibration, not both; take one of them out")
    _check_scale(path, settings)
    return Capture(
        folder=folder,
        name=_name(folder, settings),
        videos=kept,
        timecodes={camera: timecodes[camera] for camera in kept if camera in timecodes},
        calibration=_find_calibration(folder, settings.calibration),
        settings=settings,
        offsets=find_offsets(folder),
        notes=_passed_over(folder, inside, videos),
    )


def holds_pictures_of_cameras(folder: Path) -> bool:
    """Whether a folder holds pictures or videos by camera as data sets publish them: images/<camera>/*.jpg."""
    return any(cameras_in(folder / name) for name in VIDEO_FOLDERS[1:] if (folder / name).is_dir())


def find_lender(capture: Capture) -> Capture | None:
    """The capture whose rig this one uses, at the end of the chain of `rig_from`; None if it uses its own.

    Raises:
        FileNotFoundError: a folder of the chain is missing.
        ValueError: the chain comes back to itself, or the lender lacks a camera or a name of its own.
    """
    chain = [capture]
    while (source := chain[-1].settings.rig_from) is not None:
        path = chain[-1].folder / "capture.toml"
        folder = _beside(chain[-1], "rig_from", source)
        if any(folder.resolve() == take.folder.resolve() for take in chain):
            names = " -> ".join([*(take.folder.absolute().name for take in chain), folder.name])
            raise ValueError(f"{path}: rig_from must lead to a take with a rig of its own, but goes round: {names}")
        chain.append(find_capture(folder))
    lender = chain[-1]
    if lender is capture:
        return None
    path = capture.folder / "capture.toml"
    if lacking := [camera for camera in capture.cameras if camera not in lender.videos]:
        raise ValueError(
            f"{path}: rig_from takes the rig of {lender.folder}, which has no cameras {lacking}; list them under "
            "'ignore', or take out rig_from to have a rig of this take's own"
        )
    if lender.name == capture.name:
        raise ValueError(
            f"{path}: results of this take and of {lender.folder}, whose rig it uses, would go into one folder, since "
            f"both are named {capture.name!r}; give one another 'name'"
        )
    return lender


def find_plate(capture: Capture) -> dict[str, Path]:
    """Videos of the empty stage by camera, of those of this capture's cameras that have one.

    Raises FileNotFoundError without the folder, ValueError when it holds no video of this capture's cameras.
    """
    if capture.settings.clean_plate is None:
        return {}
    folder = _beside(capture, "clean_plate", capture.settings.clean_plate)
    _, videos = _find_videos(folder)
    if not any(camera in capture.videos for camera in videos):
        raise ValueError(f"{folder} must have videos of {list(capture.cameras)}, but has {list(videos)}")
    return {camera: videos[camera] for camera in capture.cameras if camera in videos}


def probe_capture(
    capture: Capture,
    tell: Callable[[int, int, str], None] = lambda *_: None,
    *,
    listen: bool = True,
    kept: Path | None = None,
) -> dict[str, VideoInfo]:
    """What the video of each camera holds; `tell` hears how many are read, of how many, and which is next. `listen` for
    LTC, which takes the reading of whole sound tracks where there is some, once where it is `kept`, see `hear_ltc`.

    Pictures, which hold no times, run at the `fps` of capture.toml, or at the rate of most videos, or at 30. Their
    numbers count from the lowest that any camera begins with, as videos count from their first frame.

    Raises:
        FileNotFoundError, ValueError: as `probe_video`.
    """
    folders = {camera: list_pictures(path) for camera, path in capture.videos.items() if path.is_dir()}
    infos = dict[str, VideoInfo]()
    origin = min((int(pictures.numbers[0]) for pictures in folders.values() if pictures.counted), default=0)
    for camera in sorted(capture.videos, key=lambda camera: camera in folders):  # videos first
        tell(len(infos), len(capture.videos), camera)
        videos = [info.rate for name, info in infos.items() if name not in folders]
        rate = capture.settings.fps or (Counter(videos).most_common(1)[0][0] if videos else None)
        infos[camera] = probe_video(capture.videos[camera], rate=rate, origin=origin, listen=listen, kept=kept)
    return {camera: infos[camera] for camera in capture.cameras}


def picture_notes(capture: Capture, infos: Mapping[str, VideoInfo]) -> tuple[str, ...]:
    """How the times of pictures were found, where no file tells them."""
    folders = [camera for camera, path in capture.videos.items() if path.is_dir()]
    if not folders or capture.timecodes:
        return ()
    listed = {camera: list_pictures(capture.videos[camera]) for camera in folders}
    starts = {camera: int(pictures.numbers[0]) for camera, pictures in listed.items() if pictures.counted}
    said = "fps of capture.toml" if capture.settings.fps else "the videos' rate" if len(folders) < len(infos) else ""
    rate = infos[folders[0]].rate
    notes = [
        f"times of {', '.join(folders)} are the numbers of their pictures, at {float(rate):g} per second "
        f"({said or 'nothing tells it: set fps in capture.toml'})"
    ]
    if len(set(starts.values())) > 1:
        late = ", ".join(f"{camera} at {start}" for camera, start in starts.items() if start > min(starts.values()))
        notes.append(f"pictures begin at number {min(starts.values())}, but {late}: taken for cameras that began later")
    return tuple(notes)


def timing_notes(capture: Capture, infos: Mapping[str, VideoInfo], clock: ClockMode) -> tuple[str, ...]:
    """How t_offsets.json was understood, or why it was not."""
    if capture.offsets is None:
        return ()
    if clock is not ClockMode.TRUSTED:
        why = {
            ClockMode.TRIGGERED: "by which the cameras film at the same times, whatever their clocks say",
            ClockMode.CONTENT: "by which pictures and sound tell when each began",
        }
        return (f"{capture.offsets.name} is passed over for clock = '{clock}', {why[clock]}",)
    moves = read_offsets(capture.offsets, capture.cameras)
    period_ns = round(NANOSECONDS / median_low(info.rate for info in infos.values()))
    return tuple(offset_notes(capture.offsets, moves, capture.cameras, period_ns))


def load_timecodes(
    capture: Capture, infos: Mapping[str, VideoInfo], clock: ClockMode | None = None
) -> dict[str, Timecodes]:
    """Timecodes of every camera, numbered by the frames of its video, ready to align.

    They come from the timecode files, or from the containers if no camera has a file.

    Args:
        infos: what `probe_video` found, by camera.
        clock: how the times are matched; None means as capture.toml says.

    Raises:
        ValueError: some cameras have timecode files and others have not (their times would not be comparable), a file
            does not parse, or its lines do not fit the frames of the video.
    """
    told, clock = _told_timecodes(capture, infos), capture.settings.clock if clock is None else clock
    if not capture.timecodes:
        if clock is not ClockMode.CONTENT:
            told = _beside_labels(told, infos)
        begun = {name: infos[name].begun_ns for name, codes in told.items() if codes.source == CONTAINER_TIMES}
        told = {camera: codes.noting(*_begun_notes(camera, begun)) for camera, codes in told.items()}
    return with_offsets(capture, told, clock)


def _beside_labels(told: dict[str, Timecodes], infos: Mapping[str, VideoInfo]) -> dict[str, Timecodes]:
    """Where some containers have labels and others none: that is said, or raised as ValueError where the times of
    those without lie beside all of the others."""
    labelled = [camera for camera in told if infos[camera].start_label]
    bare = [camera for camera in told if not infos[camera].start_label]
    if not labelled or not bare:
        return told
    first, last = (pick(pick(told[name].times_ns) for name in labelled) for pick in (min, max))
    apart = [name for name in bare if told[name].times_ns.max() < first or told[name].times_ns.min() > last]
    if apart:
        heard = "".join(f"; {note}" for name in apart for note in infos[name].notes)
        raise ValueError(
            f"{', '.join(apart)} must have a start label or LTC that is heard on a sound track, as "
            f"{', '.join(labelled)} have, but their times count from 0 where the others' are times of day{heard}; add "
            "timecodes/ for all, set clock = 'content' in capture.toml, by which pictures and sound tell when each "
            "began, or list them under 'ignore'"
        )
    note = f"it has no start label, as {', '.join(labelled)} have: its times count from 0"
    return {name: codes.noting(note) if name in bare else codes for name, codes in told.items()}


def load_durations(capture: Capture, infos: Mapping[str, VideoInfo]) -> dict[str, Timecodes]:
    """The same of cameras whose times tell only how long they have filmed: without what is added to them."""
    return _told_timecodes(capture, infos)


def with_offsets(capture: Capture, timecodes: Mapping[str, Timecodes], clock: ClockMode) -> dict[str, Timecodes]:
    """Timecodes with what `offsets_of` adds to them; what capture.toml says is said by camera."""
    said, added = capture.settings.time_offset_s, offsets_of(capture, clock)
    return {
        camera: codes.moved(int(added.get(camera, 0) * NANOSECONDS)).noting(*_moved_notes(said.get(camera)))
        for camera, codes in timecodes.items()
    }


def _moved_notes(said: Decimal | None) -> Iterator[str]:
    if said:
        yield f"{float(said):+.6g} s are added to its times, as time_offset_s in capture.toml says"


def offsets_of(capture: Capture, clock: ClockMode) -> dict[str, Decimal]:
    """Seconds to add to the times of cameras: `time_offset_s` of capture.toml and, where clocks are trusted,
    t_offsets.json."""
    said, read = dict(capture.settings.time_offset_s), _read_offsets(capture, clock)
    return said | {camera: said.get(camera, Decimal(0)) + seconds for camera, seconds in read.items()}


def _read_offsets(capture: Capture, clock: ClockMode) -> dict[str, Decimal]:
    if capture.offsets is None or clock is not ClockMode.TRUSTED:
        return {}
    return read_offsets(capture.offsets, capture.cameras)


def _told_timecodes(capture: Capture, infos: Mapping[str, VideoInfo]) -> dict[str, Timecodes]:
    """As files and containers tell them."""
    if not capture.timecodes:
        told = {camera: container_timecodes(infos[camera]) for camera in capture.cameras}
        if all(info.start_label in UNSET and info.heard_ns is None for info in infos.values()):
            told = {camera: replace(codes, source=CONTAINER_TIMES) for camera, codes in told.items()}
        return together(told)
    frames = {camera: infos[camera].frame_count for camera in capture.cameras}
    periods = {camera: period for camera in capture.cameras if (period := _period_ns(infos[camera]))}
    rates = {camera: infos[camera].rate for camera in capture.cameras if not infos[camera].numbered}
    found = together(file_timecodes(capture, frames, rates))
    labels = {camera: container_timecodes(infos[camera]) for camera in found if infos[camera].start_label}
    return {
        camera: codes.noting(
            *_rate_notes(capture.timecodes[camera], codes, periods.get(camera)), *_label_notes(camera, found, labels)
        )
        for camera, codes in found.items()
    }


def _period_ns(info: VideoInfo) -> int:
    """Median time between two frames in the container; 0 for a single one, and for pictures, whose rate is assumed."""
    return int(np.median(np.diff(info.pts_ns))) if info.frame_count > 1 and not info.numbered else 0


def _rate_notes(path: Path, codes: Timecodes, video_ns: int | None) -> Iterator[str]:
    """Where times run at another rate than the video; raises ValueError where they are off by a unit."""
    steps = np.diff(codes.times_ns)
    own = int(np.median(steps[steps > 0])) if (steps > 0).any() else 0
    if not own or not video_ns:
        return
    ratio = own / video_ns
    for power in UNITS_APART:
        if abs(ratio / 10.0**power - 1) < RATE_OFF:
            raise ValueError(
                f"{path}: frames would be {own / 1e6:.6g} ms apart, but in the video they are {video_ns / 1e6:.6g} ms "
                "apart, so the unit is another; name the right one in the column, as timestamp_ms"
            )
    if abs(ratio - 1) > RATE_OFF:
        yield f"its timecodes are {own / 1e6:.4g} ms apart, the frames of its video {video_ns / 1e6:.4g} ms"


def _begun_notes(camera: str, begun_ns: Mapping[str, int | None]) -> Iterator[str]:
    """Where cameras were begun seconds apart by their own clocks, if these seem to have been set."""
    begun = {name: when for name, when in begun_ns.items() if when is not None}
    if camera not in begun:
        return
    apart_s = (begun[camera] - median_low(begun.values())) / NANOSECONDS
    spread_s = (max(begun.values()) - min(begun.values())) / NANOSECONDS
    if abs(apart_s) > BEGUN_APART_S and spread_s < CLOCKS_SET_S:
        side = "after" if apart_s > 0 else "before"
        yield (
            f"its file was begun {abs(apart_s):.0f} s {side} those of most cameras, by its creation_time, but its "
            "times count from its first frame; unless one trigger started all, set clock = 'content' in capture.toml"
        )


def _label_notes(camera: str, found: Mapping[str, Timecodes], labels: Mapping[str, Timecodes]) -> Iterator[str]:
    """Where the container's label and the timecode file disagree about when a camera began, seen from the first one."""
    first = next(iter(found))
    if camera == first or not {camera, first} <= labels.keys():
        return
    by_file, by_label = (
        int(times[camera].times_ns[0] - times[first].times_ns[0]) for times in (found, together(labels))
    )
    steps = np.diff(found[camera].times_ns)
    if len(steps) and abs(by_file - by_label) > LABELS_APART * float(np.median(np.abs(steps))):
        yield (
            f"it begins {by_file / 1e9:+.3f} s after {first} by the timecode files, {by_label / 1e9:+.3f} s by the "
            "labels in the containers; the files are believed"
        )


def file_timecodes(
    capture: Capture, frames: Mapping[str, int], rates: Mapping[str, Fraction] | None = None
) -> dict[str, Timecodes]:
    """Timecodes of these cameras from their files, numbered by the frames of their videos.

    Args:
        frames: how many the video has, by camera.
        rates: of these per second in the container, by camera, where it is known: labels count at it, units follow.

    Raises:
        ValueError: as `load_timecodes`.
    """
    lacking = [camera for camera in frames if camera not in capture.timecodes]
    if lacking:
        raise ValueError(
            f"{capture.folder / 'timecodes'} has no file for {lacking}, though it has for others; "
            "add these, or list the cameras under 'ignore' in capture.toml"
        )
    settings, rates = capture.settings, rates or {}
    counted = {camera: _label_rate(settings.fps, rates.get(camera)) for camera in capture.cameras}
    periods = {camera: round(NANOSECONDS / rate) for camera, rate in rates.items()}
    paths = set(capture.timecodes.values())
    if len(paths) == 1:
        read = read_shared_timecodes(
            paths.pop(), capture.cameras, rates=counted, column=settings.timecode_column, period_ns=periods
        )
    else:
        read = {
            camera: read_timecodes(
                capture.timecodes[camera],
                camera=camera,
                rate=counted[camera],
                column=settings.timecode_column,
                period_ns=periods.get(camera),
                others=capture.cameras,
            )
            for camera in frames
        }
    return {
        camera: replace(
            numbered(read[camera], capture.videos[camera], count, camera=camera),
            source=f"timecodes/{capture.timecodes[camera].name}",
        ).noting(*_counting_notes(read[camera], settings.fps, counted[camera]))
        for camera, count in frames.items()
    }


def _label_rate(said: Fraction | None, video: Fraction | None) -> Fraction | None:
    """At which a camera's labels count: what capture.toml says, unless the video runs at a rate that is no multiple of
    that; then, and where nothing is said, that of the video."""
    if said is None or video is None:
        return said or video
    ratio = max(said / video, video / said)
    return said if abs(ratio / round(ratio) - 1) < RATE_OFF / 2 else video


def _counting_notes(codes: Timecodes, said: Fraction | None, counted: Fraction | None) -> Iterator[str]:
    if codes.labelled and said is not None and counted != said:
        yield f"its labels are counted at {counted} per second, the rate of its video, and not at fps = {said}"


def numbered(codes: Timecodes, video: Path, count: int, *, camera: str) -> Timecodes:
    """Timecodes with the numbers of their frames in a video of `count` frames, see `frame_numbers`.

    Of a folder of pictures with missing numbers, a file may have a line for each number instead: those of the missing
    ones are left out.
    """
    if video.is_dir() and len(codes) != count:
        pictures = list_pictures(video)
        places = pictures.places()
        if pictures.counted and len(codes) == int(places[-1]) + 1:
            return replace(codes, times_ns=codes.times_ns[places], indices=np.arange(len(places), dtype=np.int64))
    return codes.numbered(count, camera=camera)


def check_name(name: str) -> str:
    """The name of a sequence, which becomes that of a folder.

    >>> check_name("take 2 (Mariä)")
    'take 2 (Mariä)'

    Raises:
        ValueError: it could lead out of that folder, hide it, or be refused by a file system.
    """
    # marks follow the letters of many scripts, and those of others where macOS takes letters apart
    fits = all(character in " ._-()+" or unicodedata.category(character) in LETTERS for character in name)
    if not (fits and name[:1].isalnum() and name[-1] not in " ." and _is_short(name)):
        raise ValueError(
            f"a sequence's name must have 1 to {LONGEST_NAME} letters, digits, spaces and any of . _ - ( ) +, begin "
            f"with a letter or digit and end with no dot or space, but is {name!r}"
        )
    return name


def _name(folder: Path, settings: CaptureSettings) -> str:
    try:
        return check_name(folder.resolve().name if settings.name is None else settings.name)
    except ValueError as error:
        source = ", the folder's; set 'name'" if settings.name is None else "; change 'name'"
        raise ValueError(f"{error}{source} in {folder / SETTINGS}") from None


def _is_short(name: str) -> bool:
    return len(name) <= LONGEST_NAME and len(name.encode("utf-8", "surrogatepass")) <= LONGEST_NAME_BYTES


def _beside(capture: Capture, key: str, source: str) -> Path:
    """The folder that a key of capture.toml names."""
    folder = capture.folder.absolute().parent / source
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{capture.folder / SETTINGS}: {key} = {source!r}, but there is no folder {folder}; it is looked for "
            f"beside {capture.folder.absolute().name}/, or give an absolute path"
        )
    return folder


def _find_videos(folder: Path) -> tuple[Path, dict[str, Path]]:
    """The folder in which they lie, and the videos by camera."""
    places = [folder / name for name in VIDEO_FOLDERS if (folder / name).is_dir()]
    if not places:
        raise ValueError(f"{folder} is no capture: it must have a folder 'videos' with one file per camera")
    inside = next((place for place in places if cameras_in(place)), places[0])
    _check_joined(folder, inside)
    videos = by_camera(inside, cameras_in(inside))
    for camera in videos:
        # a line break would be lines of its own in a COLMAP model, which also reads names of cameras from paths of
        # other systems; an escape sequence would be a command to the terminal
        if not (camera.isprintable() and "\\" not in camera and camera.strip() == camera and _is_short(camera)):
            raise ValueError(
                f"a camera's name must have 1 to {LONGEST_NAME} printable characters, no \\ and no space at its ends, "
                f"but is {camera!r}, that of a video in {inside}; rename the video"
            )
    return inside, videos


def _check_joined(folder: Path, inside: Path) -> None:
    """Raises ValueError where a camera has chapters, of which each would count as a camera, or for nothing."""
    for camera, chapters in unjoined(inside):
        names = ", ".join(path.name for _, path in sorted(chapters.items()))
        raise ValueError(
            f"each camera must have one video, but {camera} has what its recorder cut it into, {names}; join them: "
            f"packuv join {folder}"
        )


def _check_masks(folder: Path, videos: Mapping[str, Path]) -> None:
    """Raises ValueError for what is named as masks of another camera, and would be filmed pictures otherwise."""
    for camera, path in videos.items():
        if (match := MASKS_OF.fullmatch(camera)) and match[1] in videos:
            raise ValueError(
                f"{path} seems to be masks of {match[1]}, and would be a camera of its own; move it to masks/"
                f"{match[1]}{path.suffix if path.is_file() else ''}, or list it under 'ignore' in {folder / SETTINGS}"
            )


def cameras_in(inside: Path) -> list[Path]:
    """Videos, and folders of numbered pictures, in no order."""
    seen = [path for path in inside.iterdir() if not path.name.startswith(".")]
    files = [path for path in seen if path.suffix.lower() not in SIDECAR_SUFFIXES | PICTURE_SUFFIXES and path.is_file()]
    return files + [path for path in seen if path.is_dir() and holds_pictures(path)]


def _passed_over(folder: Path, inside: Path, videos: Mapping[str, Path]) -> tuple[str, ...]:
    """What could be a camera's, and is not taken for it."""
    notes, cameras = [], set(videos.values())
    for path in sorted(inside.iterdir(), key=lambda path: natural_key(path.name)):
        if path.is_dir() and path not in cameras and not path.name.startswith((".", "__", "@")):
            kinds = ", ".join(sorted(PICTURE_SUFFIXES))
            notes.append(f"{path.relative_to(folder)}/ is passed over: it holds no numbered pictures ({kinds})")
    loose = sorted((path.name for path in inside.iterdir() if is_picture(path.name)), key=natural_key)
    loose = [name for name in loose if not any(_belongs(name, video) for video in videos.values())]
    if loose:
        notes.append(
            f"{inside.name}/ holds {len(loose)} pictures that belong to no video ({loose[0]}): passed over; those of a "
            f"camera belong in a folder of its own, as {inside.name}/cam01/000000.png"
        )
    for name in VIDEO_FOLDERS:
        if (other := folder / name) != inside and other.is_dir() and (there := cameras_in(other)):
            notes.append(
                f"{name}/ holds {len(there)} cameras, too, and is passed over: those of {inside.name}/ are read"
            )
    return tuple(notes)


def _belongs(picture: str, video: Path) -> bool:
    """Whether a picture's name is that of a preview: cam1.jpg and cam1.mp4.jpg of cam1.mp4."""
    stem = picture.rpartition(".")[0].lower()
    return stem in (video.stem.lower(), video.name.lower())


def _advice(notes: Iterable[str]) -> str:
    return "".join(f"; {note}" for note in notes)


def _find_timecodes(folder: Path, videos: Mapping[str, Path]) -> dict[str, Path]:
    inside = folder / "timecodes"
    there = sorted(inside.iterdir()) if inside.is_dir() else []
    there = [path for path in there if path.is_file() and not path.name.startswith(".")]
    files = [path for path in there if path.suffix.lower() in SUFFIXES]
    unknown = [path for path in there if path.suffix.lower() not in {*SUFFIXES, *BESIDE_TIMECODES}]
    if unread := [path for path in unknown if camera_of(path) in videos or not files]:
        raise ValueError(
            f"timecodes are read from files that end in {', '.join(SUFFIXES)}, but {unread[0]} does not; rename it, "
            "convert it, or take it out of the folder"
        )
    alone = len(files) == 1
    shared = [
        path
        for path in files
        if camera_of(path) not in videos
        and (path.name == SHARED_TIMECODES or (alone and path.suffix.lower() in SHARED_SUFFIXES))
    ]
    if shared and alone:
        return dict.fromkeys(videos, shared[0])
    if shared:
        others = [path.name for path in files if path not in shared]
        raise ValueError(f"{inside} must hold {SHARED_TIMECODES} or one file per camera, but has it and {others}")
    found = by_camera(inside, files)
    for camera in found:
        if camera not in videos:
            raise ValueError(f"{found[camera]} belongs to no video{suggest(camera, videos)}; name it like its video")
    return found


def camera_of(path: Path) -> str:
    """The camera that a file or folder is called after."""
    return composed(path.name if path.is_dir() else path.stem)


def composed(name: str) -> str:
    """With umlauts as one character: systems and editors differ in how they write them."""
    return unicodedata.normalize("NFC", name)


def by_camera(folder: Path, files: Iterable[Path]) -> dict[str, Path]:
    """In natural order. Raises ValueError for two of one camera."""
    found: dict[str, Path] = {}
    named = {path: camera_of(path) for path in files}
    for path in sorted(named, key=lambda path: (natural_key(named[path]), path.name)):
        name = named[path]
        if name in found:
            raise ValueError(f"{folder} has two files for {name!r}: {found[name].name} and {path.name}")
        found[name] = path
    return found


def _find_calibration(folder: Path, source: str | None) -> Path | None:
    """The file or folder to import: the one that is named, else the only kind in calibration/."""
    if source == SOLVE:
        return None
    if source is not None:
        if not (folder / source).exists():
            raise ValueError(f"capture.toml: calibration = {source!r}, but {folder / source} is not there")
        return folder / source
    found = _calibrations(folder / "calibration")
    if len(found) > 1:
        names = [str(path.relative_to(folder)) for path in found]
        raise ValueError(f"{folder} has several calibrations; choose one in capture.toml: calibration = one of {names}")
    if found:
        return found[0]
    inside = folder / "calibration"
    held = inside.is_dir() and any(path.is_file() and not path.name.startswith(".") for path in inside.rglob("*"))
    return inside if held else None  # of a kind that `calibration` may know: files there are never passed over


def _calibrations(inside: Path) -> list[Path]:
    models = [inside, *(inside / name for name in ("sparse/0", "sparse", "0", "colmap", "colmap/sparse/0"))]
    found = [place for place in models if any((place / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))]
    found += [
        inside / name for name in ("rig.json", "transforms.json", "poses_bounds.npy") if (inside / name).is_file()
    ]
    if all((inside / name).is_file() for name in ("intri.yml", "extri.yml")):
        found.append(inside)
    return found + (sorted(inside.glob("*.toml")) if inside.is_dir() else [])


def _check_names(path: Path, settings: CaptureSettings, videos: Mapping[str, Path]) -> None:
    for key in ("reference", "held_out", "ignore", "time_offset_s"):
        value = getattr(settings, key)
        for camera in (value,) if isinstance(value, str) else value or ():
            if camera not in videos:
                raise ValueError(f"{path}: {key} names {camera!r}, which has no video{suggest(camera, videos)}")
    both = [camera for camera in (settings.reference, *settings.held_out) if camera in settings.ignore]
    if both:
        raise ValueError(f"{path}: {both} cannot be ignored and used as reference or held out")


def _check_scale(path: Path, settings: CaptureSettings) -> None:
    said = [key for key in ("board", "distance", "up") if getattr(settings, key)]
    if said and settings.rig_from is not None:
        raise ValueError(
            f"{path}: {', '.join(said)} say how large a rig is, and where up is, but this one comes from rig_from; "
            f"write them into the {SETTINGS} of that take"
        )
    if settings.up == "board" and settings.board is None:
        raise ValueError(
            f"{path}: up = 'board' needs a [board] that lies on the floor; describe it, or give up otherwise"
        )


def _checked(path: Path, key: str, value: Any) -> Any:
    """The value of a key in the form that `CaptureSettings` holds."""
    try:
        if key == "fps":
            return parse_rate(value)
        if key == "clock":
            return ClockMode(value)
    except ValueError as error:
        raise ValueError(f"{path}: {key}: {error}; clocks are {[str(mode) for mode in ClockMode]}") from None
    if key == "transfer" and value not in TRANSFERS:
        close = suggest(str(value), TRANSFERS)
        raise ValueError(f"{path}: transfer must be one of {', '.join(TRANSFERS)}, but is {value!r}{close}")
    if key == "time_offset_s":
        return _checked_offsets(path, value)
    if key == "board":
        return _checked_tables(path, key, [value])[0]
    if key == "distance":
        return _checked_tables(path, key, value if isinstance(value, list) else [value])
    if key == "up":
        return _checked_up(path, value)
    many = key in ("tags", "held_out", "ignore")
    texts = value if many else [value]
    if not isinstance(texts, list) or not all(isinstance(text, str) and text for text in texts):
        raise ValueError(f"{path}: {key} must be {'a list of texts' if many else 'a text'}, but is {value!r}")
    if key in ("reference", "held_out", "ignore"):
        texts = [composed(text) for text in texts]
    return tuple(texts) if many else texts[0]


def _checked_offsets(path: Path, value: Any) -> dict[str, Decimal]:
    if not isinstance(value, dict):
        raise ValueError(f"{path}: time_offset_s must be a table of seconds by camera, but is {value!r}")
    for camera, seconds in value.items():
        number = isinstance(seconds, (int, Decimal)) and not isinstance(seconds, bool)
        if not number or not Decimal(seconds).is_finite() or not -MOST_OFFSET_S <= seconds <= MOST_OFFSET_S:
            raise ValueError(
                f"{path}: time_offset_s of {camera!r} must be a number of seconds, at most {MOST_OFFSET_S} either "
                f"way, but is {seconds!r}"
            )
    return {composed(camera): Decimal(seconds) for camera, seconds in value.items()}


def _checked_tables(path: Path, key: str, tables: list[Any]) -> tuple[dict[str, Any], ...]:
    """With decimals as floats."""
    if not tables or not all(isinstance(table, dict) for table in tables):
        raise ValueError(f"{path}: {key} must be a table, but is {tables[0] if len(tables) == 1 else tables!r}")
    return tuple(
        {name: float(value) if isinstance(value, Decimal) else value for name, value in table.items()}
        for table in tables
    )


def _checked_up(path: Path, value: Any) -> str | tuple[float, float, float]:
    if isinstance(value, str) and value in UPWARD:
        return value
    numbers = value if isinstance(value, list) and len(value) == 3 else []
    right = [isinstance(number, (int, Decimal)) and not isinstance(number, bool) for number in numbers]
    x, y, z = map(float, numbers) if right and all(right) else (0.0, 0.0, 0.0)
    if not 0 < x * x + y * y + z * z < float("inf"):
        known = " or ".join(map(repr, UPWARD))
        raise ValueError(f"{path}: up must be {known} or a direction [x, y, z] other than 0, but is {value!r}")
    return x, y, z


def suggest(name: str, known: Iterable[str]) -> str:
    """The end of a message about a name that nobody knows."""
    close = get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
