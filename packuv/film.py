"""A film of a scene along a camera path: the path as a file, the cameras between its views, and the MP4.

The viewer writes such files; docs/viewer.md describes them.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import OutputContainer

from packuv.bounds import field, fields, finite, items, whole
from packuv.camera import PinholeCamera
from packuv.colour import lit
from packuv.files import load_json, whole_file
from packuv.progress import Progress
from packuv.scene import Scene
from packuv.scene.sound import RATE
from packuv.score import Artist, as_pixels

FORMAT, VERSION = "packuv-path", 1
MOST_VIEWS, MOST_SECONDS = 1000, 3600.0
CODING = {"crf": "16", "preset": "medium", "x264-params": "threads=1:sliced-threads=0:cpu-independent=1"}
"""Of x264; one thread, for its output depends on their number, and no choice of code by the processor, for its
macroblock tree for AVX-512 reads memory that nobody wrote"""
SOUND_RATE = RATE
"""Samples a second of a film's sound: as of a scene's"""
PACE = 0.02
"""Share by which frames may pass faster or slower than they were filmed, for their sound to be heard; and one frame"""


@dataclass(frozen=True)
class PathView:
    """Where the camera is at one moment of the film."""

    seconds: float
    """From the start of the film"""
    frame: int
    """Of the scene"""
    camera: PinholeCamera


@dataclass(frozen=True)
class CameraPath:
    """Views at least one, in order of time; between them the eye goes on a smooth curve, turning evenly."""

    views: tuple[PathView, ...]

    def __post_init__(self) -> None:
        if not self.views:
            raise ValueError("a camera path needs a view, but has none; add one in the viewer (K)")
        times = [view.seconds for view in self.views]
        if times[0] != 0 or any(after <= before for before, after in pairwise(times)):
            raise ValueError(f"the seconds of a path's views must begin at 0 and rise, but are {times[:8]}")

    @classmethod
    def load(cls, path: Path) -> CameraPath:
        """Raises ValueError, which names the file, for one that holds no path."""
        try:
            told = fields(load_json(path), "a camera path")
            if (told.get("format"), told.get("version")) != (FORMAT, VERSION):
                raise ValueError(f"a camera path says format {FORMAT!r} and version {VERSION}")
            listed = items(field(told, "views", "a camera path"), "views", most=MOST_VIEWS)
            return cls(tuple(_view(one, f"view {number}") for number, one in enumerate(listed)))
        except ValueError as error:
            raise ValueError(f"{path} is no camera path: {error}") from None

    @property
    def seconds(self) -> float:
        """Of the whole film."""
        return self.views[-1].seconds

    def at(self, seconds: float) -> tuple[int, PinholeCamera]:
        """Frame of the scene and camera at a moment of the film; before and after it, of its ends."""
        times = [view.seconds for view in self.views]
        place = min(max(bisect_right(times, seconds) - 1, 0), max(len(times) - 2, 0))
        before, after = self.views[place], self.views[min(place + 1, len(times) - 1)]
        share = min(max((seconds - before.seconds) / ((after.seconds - before.seconds) or 1), 0.0), 1.0)
        frame = round(before.frame + share * (after.frame - before.frame))
        turned = _turned(before.camera.camera_from_world[:3, :3], after.camera.camera_from_world[:3, :3], share)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turned, -turned @ self._eye(place, share)
        return frame, _between(before.camera, after.camera, share, pose)

    def _eye(self, place: int, share: float) -> np.ndarray:
        """On a cubic through all eyes, [3]: as fast at a view as the line from the one before to the one after it."""
        eyes, times = [view.camera.centre for view in self.views], [view.seconds for view in self.views]

        def speed(index: int) -> np.ndarray:
            low, high = max(index - 1, 0), min(index + 1, len(eyes) - 1)
            return np.asarray((eyes[high] - eyes[low]) / ((times[high] - times[low]) or 1))

        last = min(place + 1, len(eyes) - 1)
        span, s = times[last] - times[place], share
        start, end = speed(place) * span, speed(last) * span
        return np.asarray(
            (2 * s**3 - 3 * s**2 + 1) * eyes[place]
            + (s**3 - 2 * s**2 + s) * start
            + (3 * s**2 - 2 * s**3) * eyes[last]
            + (s**3 - s**2) * end
        )


def _view(told: object, what: str) -> PathView:
    one = fields(told, what)
    seconds = finite(field(one, "seconds", what), f"{what}: seconds")
    if not 0 <= seconds <= MOST_SECONDS:
        raise ValueError(f"{what}: seconds must be from 0 to {MOST_SECONDS:g}, but are {seconds:g}")
    frame = whole(field(one, "frame", what), f"{what}: frame", most=10**9)
    camera = fields(field(one, "camera", what), f"{what}: camera")
    found = PinholeCamera.from_json({"name": what, **camera})
    turn = found.camera_from_world[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
        raise ValueError(f"{what}: camera_from_world must begin with a rotation, but has {turn.round(3).tolist()}")
    return PathView(seconds, frame, found)


def _turned(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """The rotation [3, 3] a share of the way from one to another, about one axis."""
    between = b @ a.T
    vector = cv2.Rodrigues(between)[0][:, 0]
    if not vector.any():  # it takes turns below 1e-5 for none
        vector = (between - between.T)[[2, 0, 1], [1, 2, 0]] / 2
    return np.asarray(cv2.Rodrigues(share * vector)[0] @ a)


def _between(a: PinholeCamera, b: PinholeCamera, share: float, pose: np.ndarray) -> PinholeCamera:
    """Optics between those of two cameras, in the picture size of the first one."""
    b = fitted(b, a.width, a.height)
    fx, fy, cx, cy = (getattr(a, name) + share * (getattr(b, name) - getattr(a, name)) for name in OPTICS)
    return replace(a, fx=fx, fy=fy, cx=cx, cy=cy, camera_from_world=pose)


OPTICS = ("fx", "fy", "cx", "cy")


def fitted(camera: PinholeCamera, width: int, height: int) -> PinholeCamera:
    """The camera in a picture of this size, in the middle of which the whole of its own picture lies, as the viewer
    shows it."""
    scale = min(width / camera.width, height / camera.height)
    left, top = (width - scale * camera.width) / 2, (height - scale * camera.height) / 2
    return replace(
        camera, width=width, height=height, fx=scale * camera.fx, fy=scale * camera.fy,
        cx=scale * camera.cx + left, cy=scale * camera.cy + top,
    )  # fmt: skip


def film(
    scene: Scene,
    path: CameraPath,
    output: Path,
    progress: Progress,
    *,
    rate: Fraction | None = None,
    size: tuple[int, int] | None = None,
    device: str = "cpu",
    sound: np.ndarray | None = None,
) -> int:
    """Write an MP4 (H.264, 4:2:0) of the scene along a path, in the light of its frames; returns its pictures.

    `rate` is the film's, by default the scene's; `size` the width and height, by default those of the first view, made
    even. `sound`, float32 [2, n] at SOUND_RATE, is what was heard from the earliest frame on that the path shows; it
    goes along as AAC, see `sound_along`. The file is whole or not there. Raises ValueError for a path that names frames
    which the scene lacks.
    """
    rate = rate or scene.header.rate
    first = path.views[0].camera
    width, height = size or (first.width // 2 * 2, first.height // 2 * 2)
    if width % 2 or height % 2 or min(width, height) < 2:
        raise ValueError(f"H.264 needs even width and height, but the film's size is {width}x{height}")
    if missing := [view.frame for view in path.views if view.frame >= len(scene)]:
        raise ValueError(f"the scene has frames 0 to {len(scene) - 1}, but the path shows {missing[0]}")
    count = int(Fraction(path.seconds) * rate) + 1
    with whole_file(output) as part, av.open(str(part), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=rate, options=CODING)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        if sound is not None:
            times = scene.header.times_ns / 1e9
            _add_sound(container, sound_along(path, sound, times, count / rate))
        moments = [path.at(float(number / rate)) for number in range(count)]
        for done, picture in enumerate(_pictures(scene, moments, (width, height), device), start=1):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            progress(done, count)
        container.mux(stream.encode(None))
    return count


def sound_along(path: CameraPath, sound: np.ndarray, times: np.ndarray, seconds: Fraction) -> np.ndarray:
    """What is heard along a path for so long, float32 [2, n] at SOUND_RATE: `sound`, which begins at the earliest frame
    of the path, where frames pass as fast as they were filmed, and silence where they stand, race or go back.

    `times` are those of the scene's frames, seconds.
    """
    heard = np.zeros((2, int(seconds * SOUND_RATE)), np.float32)
    origin = times[min(view.frame for view in path.views)]
    for before, after in pairwise(path.views):
        span, filmed = after.seconds - before.seconds, times[after.frame] - times[before.frame]
        slack = max(PACE * span, float(np.diff(times).max(initial=0)))
        if filmed <= 0 or abs(filmed - span) > slack:
            continue
        start, source = (round(at * SOUND_RATE) for at in (before.seconds, times[before.frame] - origin))
        part = sound[:, source : source + round(span * SOUND_RATE)][:, : heard.shape[1] - start]
        heard[:, start : start + part.shape[1]] = part
    return heard


def _add_sound(container: OutputContainer, heard: np.ndarray) -> None:
    voice = container.add_stream("aac", rate=SOUND_RATE, layout="stereo")
    frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(heard), format="fltp", layout="stereo")
    frame.sample_rate, frame.pts = SOUND_RATE, 0
    for packet in (*voice.encode(frame), *voice.encode(None)):
        container.mux(packet)


def _pictures(
    scene: Scene, moments: Sequence[tuple[int, PinholeCamera]], size: tuple[int, int], device: str
) -> Iterator[np.ndarray]:
    """uint8 [H, W, 3] of each moment."""
    artist, shown, gaussians = Artist(scene, device), -1, scene.gaussians(moments[0][0])
    for frame, camera in moments:
        if frame != shown:
            gaussians, shown = scene.gaussians(frame), frame
        drawn = artist.draw(gaussians, fitted(camera, *size))
        yield np.ascontiguousarray(as_pixels(lit(drawn, scene.light(frame))))
