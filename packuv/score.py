"""How good pictures of a scene are beside what cameras filmed: PSNR and SSIM, what a common gain explains, moving and
still areas apart, motion, flicker, LPIPS. docs/scores.md defines each.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, cast

import cv2
import numpy as np
import pyarrow as pa

from packuv.camera import PinholeCamera
from packuv.colour import GAMMA, OFFSET, linear_from_srgb, lit, srgb_from_linear
from packuv.files import save_json
from packuv.footage import Views
from packuv.gaussians.floats import Gaussians
from packuv.metrics import decibels, likenesses, trend
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


SCHEMA = pa.schema(list(column_types(Score).items()))
FIGURES = tuple(column.name for column in SCHEMA if column.type == pa.float64())
"""Fields of which means say something"""
TRENDS = {"still_trend_db": "psnr_still_db", "never_moving_trend_db": "psnr_never_moving_db"}
"""What is said of their course, dB per 100 frames"""
BLOCKS = 40
"""Across a picture, by which places are known through which nothing ever moves"""
AHEAD = 2
"""Drawn pictures that may wait for each worker"""

Measure = Callable[[np.ndarray, np.ndarray], float]
"""Of a picture and its truth, float32 [3, H, W], sRGB"""


def score(
    scene: Scene, views: Views, progress: Progress, *, lpips: Measure | None = None, workers: int = 2
) -> list[Score]:
    """Score every frame on all cameras of the views, whose instant i is frame i of the scene.

    A camera without a picture at an instant is not scored there. One thread draws, `workers` others compare; the scores
    do not depend on their number.
    """
    artist, waiting, scores = Artist(scene), deque[Future[Score]](), list[Score]()
    held_out = scene.header.held_out
    judges = [_Judge(views, index, name in held_out, lpips) for index, name in enumerate(views.names)]
    gaussians = None
    with one_opencv_thread(), ThreadPoolExecutor(workers) as pool:
        for frame in range(len(scene)):
            gaussians = scene.gaussians(frame, into=gaussians)
            for index, camera in enumerate(views.cameras):
                truth = views.filmed(index, frame)
                if truth is None:
                    continue
                drawn = artist.draw(gaussians, camera)
                shot = _Shot.of(views, index, frame, truth, drawn, scene)
                waiting.append(judges[index].submit(pool, shot))
                while len(waiting) > AHEAD * workers:
                    scores.append(waiting.popleft().result())
            progress(frame + 1, len(scene), f"{_mean([s.psnr_calibrated_db for s in scores]) or 0:.2f} dB")
        scores += [future.result() for future in waiting]
    never = {judge.name: judge.watch.never_moving() for judge in judges}
    return [replace(item, psnr_never_moving_db=next(never[item.camera])) for item in scores]


@dataclass(frozen=True)
class _Shot:
    """A drawn frame as one camera shows it."""

    frame: int
    time_ns: int
    truth: np.ndarray
    """float32 [3, H, W], as filmed"""
    seen: np.ndarray
    """float32 [3, H, W], in the scene's light of the instant"""
    shown: np.ndarray
    """float32 [3, H, W], as the camera films it"""
    steady: np.ndarray
    """uint8 [H, W, 3], as the camera films it in steady light"""

    @classmethod
    def of(cls, views: Views, camera: int, frame: int, truth: np.ndarray, drawn: np.ndarray, scene: Scene) -> _Shot:
        shown = views.response(camera, frame).shown(drawn)
        steady = shown if views.light is None else views.response(camera, None).shown(drawn)
        seen = np.clip(lit(drawn, scene.light(frame)), 0, 1)
        return cls(frame, int(scene.header.times_ns[frame]), truth, seen, shown, as_pixels(steady))


class _Judge:
    """Compares one camera's pictures with what it filmed, in order, in other threads."""

    def __init__(self, views: Views, camera: int, held_out: bool, lpips: Measure | None) -> None:
        self.name, self.watch = views.names[camera], _Watch()
        self._views, self._camera, self._held_out, self._lpips = views, camera, held_out, lpips
        self._error: np.ndarray | None = None
        self._last: Future[Score] | None = None

    def submit(self, pool: ThreadPoolExecutor, shot: _Shot) -> Future[Score]:
        """The score of the next picture, when it is there."""
        self._last = pool.submit(self._score, shot, self._last)
        return self._last

    def _score(self, shot: _Shot, before: Future[Score] | None) -> Score:
        truth, filmed = shot.truth, self._views.steady(self._camera, shot.frame)
        assert filmed is not None, "what has a picture as filmed has one in steady light"
        pictures = shot.seen, shot.shown, with_own_gain(shot.shown, truth)
        raw, calibrated, own = (
            (level if math.isfinite(level) else None, alike) for level, alike in likenesses(pictures, truth)
        )
        perceived = self._lpips(shot.shown, truth) if self._lpips else None
        error = shot.shown - truth
        if before:
            before.result()  # a pool begins in order, so this one has begun
        flicker = None if self._error is None else float(np.abs(error - self._error).mean())
        self._error = error
        areas = self.watch.see(filmed, shot.steady, error)
        return Score(
            shot.frame, shot.time_ns, self.name, self._held_out, *raw, *calibrated, *own, flicker, *areas, perceived
        )


Areas = tuple[float | None, float | None, float | None, float | None]
"""PSNR of what moves and of what is still, dB, share of the picture that moves, tOF in pixels"""


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

    def never_moving(self) -> Iterator[float | None]:
        """PSNR of each picture where nothing ever moved, dB."""
        still = np.zeros(0, bool) if self.moved is None else ~self.moved
        return (_level(block[still]) if still.size else None for block in self.blocks)


def _shrunk(plane: np.ndarray) -> np.ndarray:
    """Means over blocks of a float32 [H, W]: [rows, BLOCKS]."""
    height, width = plane.shape
    size = min(BLOCKS, width), max(1, min(height, round(BLOCKS * height / width)))
    return cv2.resize(plane, size, interpolation=cv2.INTER_AREA)


def _level(squared: np.ndarray) -> float | None:
    """PSNR of squared errors, dB; None without any, or where all are 0."""
    mean = float(squared.mean(dtype=np.float64)) if squared.size else 0.0
    return decibels(mean) if mean else None


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
    table = pa.Table.from_pylist([vars(item) for item in scores], schema=SCHEMA)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, SCHEMA) as writer:
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
    by_camera = {name: _facts([item for item in scores if item.camera == name]) for name in names}
    trends = {name: _mean([facts[name] for facts in by_camera.values()]) for name in TRENDS}
    return {
        "frames": frames,
        "cameras": names,
        "held_out": all(item.held_out for item in scores),
        "mean": _means(scores) | trends,
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


def _facts(scores: Sequence[Score]) -> dict[str, float | None]:
    """Of one camera: means, and trends."""
    return _means(scores) | {name: _trend(scores, level) for name, level in TRENDS.items()}


def _trend(scores: Sequence[Score], name: str) -> float | None:
    known = [(item.frame, level) for item in scores if (level := getattr(item, name)) is not None]
    return trend([frame for frame, _ in known], [level for _, level in known])


def _means(scores: Sequence[Score]) -> dict[str, float | None]:
    return {name: _mean([getattr(item, name) for item in scores]) for name in FIGURES}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def spread(names: Sequence[str], count: int) -> tuple[str, ...]:
    """`count` of the names at equal distances; all of them if there are fewer.

    >>> spread(["a", "b", "c", "d", "e", "f"], 3)
    ('b', 'd', 'f')
    """
    if count >= len(names):
        return tuple(names)
    return tuple(names[(2 * place + 1) * len(names) // (2 * count)] for place in range(count))
