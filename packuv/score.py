"""How good pictures of a scene are beside what cameras filmed: PSNR and SSIM, what a common gain explains, moving and
still areas apart, the foreground where masks tell it, motion, flicker, LPIPS. docs/scores.md defines each.
"""

from __future__ import annotations

import math
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, cast

import cv2
import numpy as np
import pyarrow as pa

from packuv.camera import PinholeCamera
from packuv.colour import GAMMA, OFFSET, linear_from_srgb, lit, srgb_from_linear
from packuv.files import open_npz, save_json, save_npz, whole_file
from packuv.footage import Silhouettes, Views
from packuv.footage.planes import as_planes
from packuv.gaussians.floats import Gaussians
from packuv.metrics import cut_out, decibels, likenesses, ssim, trend
from packuv.motion import Follower, one_opencv_thread
from packuv.progress import Progress
from packuv.raster import Arena, RasterOptions, render
from packuv.scene import Scene
from packuv.tables import column_types


@dataclass(frozen=True)
class Score:
    """One picture against its truth. PSNR in dB; None where the two are equal, or there is no such area."""

    frame: Annotated[int, pa.int32()]
    time_ns: int
    camera: str
    held_out: bool
    psnr_db: float | None
    """Against the picture as filmed, the render in the scene's light of the instant"""
    ssim: float
    psnr_calibrated_db: float | None
    """Against the picture as filmed, the render as the camera would film it: its exposure, gain and lens shading"""
    ssim_calibrated: float
    psnr_own_db: float | None
    """Against the picture as filmed, the calibrated render with the one gain per channel that fits this picture best"""
    ssim_own: float
    flicker: float | None
    """Mean absolute change, since the camera's last frame, of the difference between calibrated render and truth: what
    blinks in the render but not in the truth, whatever moves. None in a first frame"""
    psnr_moving_db: float | None
    """Of the calibrated render, where the camera's filmed picture moved since its last one. None in a first frame"""
    psnr_still_db: float | None
    """Likewise, everywhere else"""
    moving_share: float | None
    """Of the picture; None in a first frame"""
    tof_px: float | None
    """tOF: mean length of the difference between optical flow of filmed and of rendered pictures since the camera's
    last frame, pixels. None in a first frame"""
    lpips: float | None
    """Of the calibrated render; None where no backbone weights were given"""
    psnr_never_moving_db: float | None = None
    """Of the calibrated render, in blocks of a fortieth of the picture's width through which nothing moves in any
    scored frame"""
    foreground_share: float | None = None
    """Of the picture, what its mask covers; None without a mask, or with an empty one"""
    psnr_foreground_db: float | None = None
    """Of the calibrated render, there"""
    ssim_foreground: float | None = None
    """Of the calibrated render, in the box around the mask, with black outside the mask in render and truth"""
    lpips_foreground: float | None = None
    """Likewise; None also where no backbone weights were given"""


COLUMNS = pa.schema(list(column_types(Score).items()))
FOREGROUND = ("foreground_share", "psnr_foreground_db", "ssim_foreground", "lpips_foreground")
"""Fields that masks give; a table without any has no such columns"""
SCHEMA = pa.schema([column for column in COLUMNS if column.name not in FOREGROUND])
FIGURES = tuple(column.name for column in SCHEMA if column.type == pa.float64())
"""Fields of which means say something, beside those of the foreground"""
LEAST_PERCEIVED_PX = 64
"""Side of the least box whose LPIPS is measured: a network's last layer has some places left then"""
TRENDS = {"still_trend_db": "psnr_still_db", "never_moving_trend_db": "psnr_never_moving_db"}
"""What is said of their course, dB per 100 frames"""
BLOCKS = 40
"""Across a picture, by which places are known through which nothing ever moves"""
PART = 256
"""Frames that are scored, written down and let go of together; what a kill costs"""
AHEAD = 2
"""Drawn pictures that may wait for each worker"""

Measure = Callable[[np.ndarray, np.ndarray], float]
"""Of a picture and its truth, float32 [3, H, W], sRGB"""


def score(
    scene: Scene,
    views: Views,
    progress: Progress,
    *,
    lpips: Measure | None = None,
    silhouettes: Silhouettes | None = None,
    workers: int = 2,
    scratch: Path | None = None,
    device: str = "cpu",
) -> list[Score]:
    """Score every frame on all cameras of the views, whose instant i is frame i of the scene.

    A camera without a picture at an instant is not scored there. `silhouettes` of some cameras have their foreground
    scored, too. One thread draws, on the `device`, cpu or cuda; `workers` others compare, and the scores
    do not depend on their number. What is scored goes to the folder `scratch`, from which the same scoring goes on
    after a kill; None: to one that goes away.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) if scratch is None else scratch
        parts = [_Part(folder, range(len(scene))[first : first + PART]) for first in range(0, len(scene), PART)]
        stack.enter_context(one_opencv_thread())
        pool = stack.enter_context(ThreadPoolExecutor(workers))
        scorer = _Scorer(scene, views, Artist(scene, device), lpips, silhouettes, pool, AHEAD * workers)
        for part in parts:
            if part.there:
                scorer.pass_over(part.frames, part.scores(), progress)
            else:
                part.write(scorer.scores(part.frames, progress), [judge.watch for judge in scorer.judges])
        still = [_never_moving(parts, camera) for camera in range(len(views.names))]
        return [item for part in parts for item in part.finished(views.names, still)]


class _Scorer:
    """Scores frames in order, from any one on."""

    def __init__(
        self,
        scene: Scene,
        views: Views,
        artist: Artist,
        lpips: Measure | None,
        silhouettes: Silhouettes | None,
        pool: ThreadPoolExecutor,
        most_waiting: int,
    ) -> None:
        self._scene, self._views, self._artist = scene, views, artist
        self._pool, self._most_waiting = pool, most_waiting
        held_out = scene.header.held_out
        self.judges = [
            _Judge(views, index, name in held_out, lpips, silhouettes) for index, name in enumerate(views.names)
        ]
        self._gaussians, self._shown = scene.gaussians(0), 0  # what was read last
        self._at = 0
        self._total_db, self._count = 0.0, 0

    def scores(self, frames: range, progress: Progress) -> list[Score]:
        """Of all pictures of these frames; what moves and what flickers is told from the pictures before them."""
        if frames.start != self._at:
            self._look_before(frames.start)
        waiting, scores = deque[Future[Score]](), list[Score]()
        for frame in frames:
            for camera in range(len(self._views.cameras)):
                if self._views.has(camera, frame):
                    waiting.append(self._submit(camera, frame))
                while len(waiting) > self._most_waiting:
                    scores.append(self._heard(waiting.popleft().result()))
            progress(frame + 1, len(self._scene), self._note)
        self._at = frames.stop
        return scores + [self._heard(future.result()) for future in waiting]

    def pass_over(self, frames: range, scores: Sequence[Score], progress: Progress) -> None:
        """These frames were scored before."""
        for item in scores:
            self._heard(item)
        progress(frames.stop, len(self._scene), self._note)

    def _look_before(self, start: int) -> None:
        """Look at each camera's last picture before a frame."""
        there = self._views.frames[:start] >= 0  # [start, C]
        cameras = np.flatnonzero(there.any(axis=0)).tolist()
        last = {camera: int(np.flatnonzero(there[:, camera])[-1]) for camera in cameras}
        for camera, frame in sorted(last.items(), key=lambda item: item[1]):
            self._submit(camera, frame).result()
        for judge in self.judges:
            judge.watch.forget()

    def _submit(self, camera: int, frame: int) -> Future[Score]:
        if frame != self._shown:
            self._gaussians, self._shown = self._scene.gaussians(frame, into=self._gaussians), frame
        drawn = self._artist.draw(self._gaussians, self._views.cameras[camera])
        return self.judges[camera].submit(self._pool, _Shot.of(self._views, camera, frame, drawn, self._scene))

    def _heard(self, item: Score) -> Score:
        if item.psnr_calibrated_db is not None:
            self._total_db, self._count = self._total_db + item.psnr_calibrated_db, self._count + 1
        return item

    @property
    def _note(self) -> str:
        return f"{self._total_db / max(1, self._count):.2f} dB"


@dataclass(frozen=True)
class _Part:
    """Some frames on disk, with what is known when all are scored: errors by place, and where anything moved."""

    folder: Path
    frames: range

    @property
    def there(self) -> bool:
        return self._table.exists()

    @property
    def _table(self) -> Path:
        return self.folder / f"{self.frames.start:09d}.arrow"

    @property
    def _places(self) -> Path:
        return self._table.with_suffix(".npz")

    def write(self, scores: Sequence[Score], watches: Sequence[_Watch]) -> None:
        """Write all that is known of these frames; the watches forget them."""
        arrays = {}
        for camera, watch in enumerate(watches):
            if watch.blocks:
                arrays[f"blocks_{camera}"] = np.stack(watch.blocks)
            if watch.moved is not None:
                arrays[f"moved_{camera}"] = watch.moved
            watch.forget()
        save_npz(self._places, arrays)
        with whole_file(self._table) as partial:  # the last one: with it the part is there
            write_table(partial, scores)

    def scores(self) -> tuple[Score, ...]:
        return read_table(self._table)

    def moved(self, camera: int) -> np.ndarray | None:
        """bool [rows, BLOCKS]: something moved there; None where no two pictures follow one another."""
        with open_npz(self._places) as arrays:
            found: np.ndarray | None = arrays.get(f"moved_{camera}")
            return found

    def finished(self, names: Sequence[str], still: Sequence[np.ndarray | None]) -> Iterator[Score]:
        """The scores, with those of the places where nothing ever moves, bool [rows, BLOCKS] by camera."""
        with open_npz(self._places) as arrays:
            levels = {
                name: iter(_still_levels(arrays[f"blocks_{camera}"], still[camera]))
                for camera, name in enumerate(names)
                if f"blocks_{camera}" in arrays
            }
        return (replace(item, psnr_never_moving_db=next(levels[item.camera])) for item in self.scores())


def _never_moving(parts: Sequence[_Part], camera: int) -> np.ndarray | None:
    """bool [rows, BLOCKS]: nothing moves there in any part; None where that is not known."""
    known = [moved for part in parts if (moved := part.moved(camera)) is not None]
    return ~np.logical_or.reduce(known) if known else None


def _still_levels(blocks: Sequence[np.ndarray] | np.ndarray, still: np.ndarray | None) -> list[float | None]:
    """PSNR of each picture in some places, dB; of mean squared errors, float32 [rows, BLOCKS] each."""
    return [None if still is None or not still.any() else _level(block[still]) for block in blocks]


@dataclass(frozen=True)
class _Shot:
    """A drawn frame as one camera shows it."""

    frame: int
    time_ns: int
    pixels: np.ndarray
    """uint8 [H, W, 3], as filmed"""
    truth: np.ndarray
    """float32 [3, H, W], likewise"""
    seen: np.ndarray
    """float32 [3, H, W], in the scene's light of the instant"""
    shown: np.ndarray
    """float32 [3, H, W], as the camera films it"""
    steady: np.ndarray
    """uint8 [H, W, 3], as the camera films it in steady light"""

    @classmethod
    def of(cls, views: Views, camera: int, frame: int, drawn: np.ndarray, scene: Scene) -> _Shot:
        pixels = views.pixels(camera, frame, remember=False)  # one pass needs it once
        assert pixels is not None, "only pictures that there are can be scored"
        shown = views.response(camera, frame).shown(drawn)
        steady = shown if views.light is None else views.response(camera, None).shown(drawn)
        seen = np.clip(lit(drawn, scene.light(frame)), 0, 1)
        time_ns = int(scene.header.times_ns[frame])
        return cls(frame, time_ns, pixels, as_planes(pixels), seen, shown, as_pixels(steady))


class _Judge:
    """Compares one camera's pictures with what it filmed, in order, in other threads."""

    def __init__(
        self, views: Views, camera: int, held_out: bool, lpips: Measure | None, silhouettes: Silhouettes | None
    ) -> None:
        self.name, self.watch = views.names[camera], _Watch()
        self._views, self._camera, self._held_out, self._lpips = views, camera, held_out, lpips
        self._silhouettes = silhouettes
        self._error: np.ndarray | None = None
        self._last: Future[Score] | None = None

    def submit(self, pool: ThreadPoolExecutor, shot: _Shot) -> Future[Score]:
        """The score of the next picture, when it is there."""
        self._last = pool.submit(self._score, shot, self._last)
        return self._last

    def _score(self, shot: _Shot, before: Future[Score] | None) -> Score:
        truth, filmed = shot.truth, self._views.steadied(shot.pixels, self._camera, shot.frame)
        pictures = shot.seen, shot.shown, with_own_gain(shot.shown, truth)
        raw, calibrated, own = (
            (level if math.isfinite(level) else None, alike) for level, alike in likenesses(pictures, truth)
        )
        perceived = self._lpips(shot.shown, truth) if self._lpips else None
        error = shot.shown - truth
        ahead = self._foreground(shot, error)
        if before:
            before.result()  # a pool begins in order, so this one has begun
        flicker = None if self._error is None else float(np.abs(error - self._error).mean())
        self._error = error
        areas = self.watch.see(filmed, shot.steady, error)
        return Score(
            shot.frame,
            shot.time_ns,
            self.name,
            self._held_out,
            *raw,
            *calibrated,
            *own,
            flicker,
            *areas,
            perceived,
            None,  # until all frames are scored
            *ahead,
        )

    def _foreground(self, shot: _Shot, error: np.ndarray) -> Areas:
        """What `FOREGROUND` names; None where no mask tells."""
        mask = self._silhouettes.of(self.name, shot.frame) if self._silhouettes else None
        if mask is None or not mask.any():
            return None, None, None, None
        alike = ssim(cut_out(shot.shown, mask), cut_out(shot.truth, mask))
        pair = (cut_out(picture, mask, least_px=LEAST_PERCEIVED_PX) for picture in (shot.shown, shot.truth))
        perceived = self._lpips(*pair) if self._lpips else None
        level = _level(np.square(error[:, mask]))
        return float(mask.mean()), level, alike, perceived


Areas = tuple[float | None, float | None, float | None, float | None]
"""PSNR of what moves and of what is still, dB, share of the picture that moves, tOF in pixels; or `FOREGROUND`"""


@dataclass
class _Watch:
    """One camera's pictures from frame to frame: what moves in them, and the errors of places where nothing does."""

    follower: Follower = field(default_factory=Follower)
    blocks: list[np.ndarray] = field(default_factory=list)
    """Mean squared errors of each picture, float32 [rows, BLOCKS]: two kilobytes a picture"""
    moved: np.ndarray | None = None
    """bool [rows, BLOCKS]: something moved there at some time"""

    def see(self, filmed: np.ndarray, render: np.ndarray, error: np.ndarray) -> Areas:
        """The next picture; `error` is float32 [3, H, W]."""
        squared = np.square(error).mean(axis=0)  # [H, W]
        self.blocks.append(_shrunk(squared))
        change = self.follower.step(filmed, render)
        if change is None:
            return None, None, None, None
        moved = _shrunk(change.moving.astype(np.float32)) > 0
        self.moved = moved if self.moved is None else self.moved | moved
        share = float(change.moving.mean())
        return _level(squared[change.moving]), _level(squared[~change.moving]), share, change.tof_px

    def never_moving(self) -> list[float | None]:
        """PSNR of each picture where nothing ever moved, dB."""
        return _still_levels(self.blocks, None if self.moved is None else ~self.moved)

    def forget(self) -> None:
        """Let go of all but the last picture."""
        self.blocks, self.moved = [], None


def _shrunk(plane: np.ndarray) -> np.ndarray:
    """Means over blocks of a float32 [H, W]: [rows, BLOCKS]."""
    height, width = plane.shape
    size = min(BLOCKS, width), max(1, min(height, round(BLOCKS * height / width)))
    return cv2.resize(plane, size, interpolation=cv2.INTER_AREA)


def _level(squared: np.ndarray) -> float | None:
    """PSNR of squared errors, dB; None without any, or where all are 0."""
    mean = float(squared.mean(dtype=np.float64)) if squared.size else 0.0
    return decibels(mean) if mean else None


@dataclass(frozen=True)
class Likeness:
    """How close one picture, rendered as the camera would film it, is to its truth."""

    camera: str
    frame: int
    psnr_calibrated_db: float | None
    """dB; None where the two are equal"""
    ssim_calibrated: float


def glance(scene: Scene, views: Views, frames: Sequence[int], progress: Progress) -> list[Likeness]:
    """The likeness of a few frames on all cameras of the views, without what needs the frame before. A camera without
    a picture at an instant is not scored there."""
    artist, found = Artist(scene), list[Likeness]()
    for done, frame in enumerate(frames, start=1):
        gaussians = scene.gaussians(frame)
        for camera, name in enumerate(views.names):
            pixels = views.pixels(camera, frame, remember=False)
            if pixels is not None:
                shown = views.response(camera, frame).shown(artist.draw(gaussians, views.cameras[camera]))
                level, alike = likenesses([shown], as_planes(pixels))[0]
                found.append(Likeness(name, frame, level if math.isfinite(level) else None, alike))
        progress(done, len(frames), "fitted cameras")
    return found


def segment_starts(scene: Scene) -> list[int]:
    """First frames of the segments after the first one."""
    return [entry.first for entry in scene.index.segments[1:]]


def write_pictures(folder: Path, scene: Scene, views: Views, chosen: Sequence[tuple[str, int, str]]) -> None:
    """Render, as the camera would film it, and truth of chosen cameras and frames; index.json says why each was."""
    folder.mkdir()
    artist, index = Artist(scene), []
    for camera, frame, why in sorted(chosen, key=lambda choice: choice[1]):
        place = views.names.index(camera)
        truth = views.filmed(place, frame)
        if truth is None:
            continue
        drawn = artist.draw(scene.gaussians(frame), views.cameras[place])
        names = {kind: f"{camera}_{frame:06d}_{kind}.png" for kind in ("render", "truth")}
        write_picture(folder / names["render"], views.response(place, frame).shown(drawn))
        write_picture(folder / names["truth"], truth)
        index.append({"camera": camera, "frame": frame, "choice": why, **names})
    save_json(folder / "index.json", {"pictures": index})


class Artist:
    """Draws Gaussians of a scene as its fit did."""

    def __init__(self, scene: Scene, device: str = "cpu") -> None:
        self._options = RasterOptions(near=scene.header.near, device=device)
        self._arena = Arena()

    def draw(self, gaussians: Gaussians, camera: PinholeCamera) -> np.ndarray:
        """float32 [3, H, W], in the rig's common colour and steady light; lamps are brighter than 1."""
        rendering = render(gaussians, camera, options=self._options, arena=self._arena)
        return cast(np.ndarray, rendering.colour)


def with_own_gain(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The picture with one gain per channel in linear light that brings it nearest to the truth.

    Both are float32 [3, H, W], sRGB. sRGB is (light ^ (1 / 2.4) * 1.055) - 0.055 but for the darkest tones, so a gain
    is a factor on sRGB + 0.055, and least squares give that factor at once, in the scale on which PSNR counts.
    """
    shown, wanted = picture + np.float32(OFFSET), truth + np.float32(OFFSET)
    factor = (shown * wanted).sum(axis=(1, 2)) / (shown * shown).sum(axis=(1, 2))
    return srgb_from_linear(linear_from_srgb(picture) * (factor**GAMMA)[:, None, None]).astype(np.float32)


def write_picture(path: Path, picture: np.ndarray) -> None:
    """float32 [3, H, W] in [0, 1], RGB, as an 8-bit PNG."""
    path.write_bytes(cv2.imencode(".png", np.ascontiguousarray(as_pixels(picture)[:, :, ::-1]))[1].tobytes())


def as_pixels(picture: np.ndarray) -> np.ndarray:
    """float32 [3, H, W] as uint8 [H, W, 3], clipped to [0, 1] first."""
    pixels: np.ndarray = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8).transpose(1, 2, 0)
    return pixels


def write_table(path: Path, scores: Sequence[Score]) -> None:
    """One row per frame and camera."""
    schema = COLUMNS if _know_foreground(scores) else SCHEMA
    table = pa.Table.from_pylist([vars(item) for item in scores], schema=schema)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, schema) as writer:
        writer.write_table(table)


def read_table(path: Path) -> tuple[Score, ...]:
    """What `write_table` wrote."""
    with pa.memory_map(str(path)) as source:
        return tuple(Score(**row) for row in pa.ipc.open_file(source).read_all().to_pylist())


def summary(scores: Sequence[Score], *, frames: int, size_bytes: int, borders: Sequence[int]) -> dict[str, Any]:
    """Means over the frames, per camera and over all, the size of the scene file, and how much segment borders show.

    `borders` are the first frames of segments. `seam` is their flicker over that of all other frames; 1 is seamless.
    Trends are in dB per 100 frames; that of all cameras is the mean of theirs.
    """
    names = list(dict.fromkeys(item.camera for item in scores))
    figures = FIGURES + FOREGROUND * _know_foreground(scores)
    by_camera = {name: _facts([item for item in scores if item.camera == name], figures) for name in names}
    trends = {name: _mean([facts[name] for facts in by_camera.values()]) for name in TRENDS}
    return {
        "frames": frames,
        "cameras": names,
        "held_out": all(item.held_out for item in scores),
        "mean": _means(scores, figures) | trends,
        "by_camera": by_camera,
        "seam": _seam(scores, set(borders)),
        "bytes": size_bytes,
        "bytes_per_frame": size_bytes / frames,
    }


def _seam(scores: Sequence[Score], borders: set[int]) -> float | None:
    """None for a scene of one segment, or one in which nothing flickers."""
    at_border = _mean([item.flicker for item in scores if item.frame in borders])
    inside = _mean([item.flicker for item in scores if item.frame not in borders])
    return at_border / inside if at_border is not None and inside else None


def _know_foreground(scores: Sequence[Score]) -> bool:
    return any(item.foreground_share is not None for item in scores)


def _facts(scores: Sequence[Score], figures: Sequence[str]) -> dict[str, float | None]:
    """Of one camera: means, and trends."""
    return _means(scores, figures) | {name: _trend(scores, level) for name, level in TRENDS.items()}


def _trend(scores: Sequence[Score], name: str) -> float | None:
    known = [(item.frame, level) for item in scores if (level := getattr(item, name)) is not None]
    return trend([frame for frame, _ in known], [level for _, level in known])


def _means(scores: Sequence[Score], figures: Sequence[str]) -> dict[str, float | None]:
    return {name: _mean([getattr(item, name) for item in scores]) for name in figures}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
