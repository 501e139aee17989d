"""How good pictures of a scene are beside what cameras filmed: PSNR, SSIM and what a common gain explains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import cv2
import numpy as np
import pyarrow as pa

from packuv.camera import PinholeCamera
from packuv.colour import linear_from_srgb, lit, srgb_from_linear
from packuv.files import save_json
from packuv.footage import Views
from packuv.gaussians.floats import Gaussians
from packuv.metrics import psnr, ssim
from packuv.progress import Progress
from packuv.raster import Arena, RasterOptions, render
from packuv.scene import Scene
from packuv.tables import column_types


@dataclass(frozen=True)
class Score:
    """One picture against its truth. PSNR in dB; None where the two are equal."""

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
    """Mean absolute change, since the camera's last frame, of the difference between render and truth in the rig's
    colour: what blinks in the render but not in the truth, whatever moves. None in a first frame"""


SCHEMA = pa.schema(list(column_types(Score).items()))
FIGURES = tuple(column.name for column in SCHEMA if column.type == pa.float64())
"""Fields of which means say something"""


def score(scene: Scene, views: Views, progress: Progress) -> list[Score]:
    """Score every frame on all cameras of the views, whose instant i is frame i of the scene.

    A camera without a picture at an instant is not scored there.
    """
    artist, scores = Artist(scene), list[Score]()
    last: dict[str, np.ndarray] = {}
    gaussians = None
    for frame in range(len(scene)):
        gaussians = scene.gaussians(frame, into=gaussians)
        time_ns = int(scene.header.times_ns[frame])
        for index, camera in enumerate(views.cameras):
            truth = views.filmed(index, frame)
            if truth is None:
                continue
            drawn = artist.draw(gaussians, camera)
            seen = np.clip(lit(drawn, scene.light(frame)), 0, 1)
            shown = views.response(index, frame).shown(drawn)
            error, before = shown - truth, last.get(camera.name)
            flicker = None if before is None else float(np.abs(error - before).mean())
            last[camera.name] = error
            held_out = camera.name in scene.header.held_out
            raw, calibrated, own = (_likeness(picture, truth) for picture in (seen, shown, with_own_gain(shown, truth)))
            scores.append(Score(frame, time_ns, camera.name, held_out, *raw, *calibrated, *own, flicker))
        progress(frame + 1, len(scene), f"{_mean([s.psnr_calibrated_db for s in scores]) or 0:.2f} dB")
    return scores


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


Likeness = tuple[float | None, float]
"""PSNR in dB, None where two pictures are equal, and SSIM"""


def _likeness(picture: np.ndarray, truth: np.ndarray) -> Likeness:
    decibel = psnr(picture, truth)
    return decibel if math.isfinite(decibel) else None, ssim(picture, truth)


def with_own_gain(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The picture with one gain per channel in linear light that brings it nearest to the truth.

    Both are float32 [3, H, W], sRGB. sRGB is (light ^ (1 / 2.4) * 1.055) - 0.055 but for the darkest tones, so a gain
    is a factor on sRGB + 0.055, and least squares give that factor at once, in the scale on which PSNR counts.
    """
    shown, wanted = picture + np.float32(0.055), truth + np.float32(0.055)
    factor = (shown * wanted).sum(axis=(1, 2)) / (shown * shown).sum(axis=(1, 2))
    return srgb_from_linear(linear_from_srgb(picture) * (factor**2.4)[:, None, None]).astype(np.float32)


def write_picture(path: Path, picture: np.ndarray) -> None:
    """float32 [3, H, W] in [0, 1], RGB, as an 8-bit PNG."""
    pixels = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8).transpose(1, 2, 0)
    path.write_bytes(cv2.imencode(".png", np.ascontiguousarray(pixels[:, :, ::-1]))[1].tobytes())


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
    """
    names = list(dict.fromkeys(item.camera for item in scores))
    return {
        "frames": frames,
        "cameras": names,
        "held_out": all(item.held_out for item in scores),
        "mean": _means(scores),
        "by_camera": {name: _means([item for item in scores if item.camera == name]) for name in names},
        "seam": _seam(scores, set(borders)),
        "bytes": size_bytes,
        "bytes_per_frame": size_bytes / frames,
    }


def _seam(scores: Sequence[Score], borders: set[int]) -> float | None:
    """None for a scene of one segment, or one in which nothing flickers."""
    at_border = _mean([item.flicker for item in scores if item.frame in borders])
    inside = _mean([item.flicker for item in scores if item.frame not in borders])
    return at_border / inside if at_border is not None and inside else None


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
