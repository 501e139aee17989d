"""The paper's picture: every frame's Gaussians in one multi-scale UV atlas, as 8-bit triplets.

A Gaussian has one texel for the whole of its segment (DESIGN section 4): the first layer that it wins by opacity, seen
where and as opaque as it first appears. A triplet is a picture of three channels; texels that no Gaussian fills in a
frame are 0 in all of them, and what is 0 in both position triplets holds none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from packuv.colour import lit
from packuv.files import whole_file
from packuv.gaussians.codes import DC, OPACITY, REST, ROTATION, SCALE, Codes, Quantizer, attribute_count
from packuv.gaussians.floats import SH_C0
from packuv.gaussians.uvmap import assign_slots, atlas_pixels, atlas_size
from packuv.gaussians.uvsize import UvOptions
from packuv.scene import Scene

POSITION_HI, POSITION_LO, OPACITIES = "position_hi", "position_lo", "opacity"
"""Triplets that are not three columns of the attributes; the third holds opacity, 255 where dynamic, and 0."""

SHEET_GAP, CAPTION = 8, 40
"""Pixels between the pictures of a sheet, and height of a caption."""


def attribute_triplets(sh_degree: int) -> dict[str, slice]:
    """Name of each triplet of three attributes, and its columns."""
    named = {"scale": SCALE, "rotation": ROTATION, "colour": DC}
    count = attribute_count(sh_degree)
    return named | {f"sh{k}": slice(first, first + 3) for k, first in enumerate(range(REST, count, 3), start=1)}


def triplet_names(sh_degree: int) -> tuple[str, ...]:
    """All triplets, in the order in which they are shown and stored."""
    return (POSITION_HI, POSITION_LO, OPACITIES, *attribute_triplets(sh_degree))


@dataclass(frozen=True)
class Seating:
    """Where the rows of one segment sit in the atlas."""

    first: int
    """Scene frame of the segment's key"""
    frames: int
    dynamic: int
    """Rows 0 to this may change"""
    pixels: np.ndarray
    """int32 [N, 2], y and x in the whole atlas; -1 where no layer took the row, or where it never appears"""

    @property
    def seated(self) -> np.ndarray:
        """bool [N]"""
        return self.pixels[:, 0] >= 0

    def visible(self, codes: Codes) -> np.ndarray:
        """Rows that are drawn in a frame and have a seat, in raster order, int64 [n].

        A Gaussian in the very corner of the position range, code 0 on all axes, looks like an empty texel and is none.
        """
        rows = np.flatnonzero(self.seated & (codes.attributes[:, OPACITY] > 0) & codes.xyz.any(axis=1))
        y, x = self.pixels[rows].T
        return rows[np.lexsort((x, y))]


def seat(scene: Scene, segment: int, *, options: UvOptions) -> Seating:
    """Choose the texels of a segment of a scene; reads all its frames."""
    entry = scene.index.segments[segment]
    codes = scene.codes(entry.first)
    waiting = codes.attributes[: entry.dynamic, OPACITY] == 0
    for frame in range(entry.first + 1, entry.first + entry.frames):
        if not waiting.any():
            break
        now = scene.codes(frame)
        born = np.flatnonzero(waiting & (now.attributes[: entry.dynamic, OPACITY] > 0))
        codes.xyz[born], codes.attributes[born] = now.xyz[born], now.attributes[born]
        waiting[born] = False
    return _seated(codes, entry.first, entry.frames, entry.dynamic, scene.header.quantizer, options)


def _seated(codes: Codes, first: int, frames: int, dynamic: int, quantizer: Quantizer, options: UvOptions) -> Seating:
    """Seats by the codes of every row at first sight."""
    opacity = codes.attributes[:, OPACITY]
    pixels = np.full((len(codes), 2), -1, np.int32)
    shown = np.flatnonzero(opacity > 0)
    points = quantizer.decode(codes[shown]).means
    slots = assign_slots(points, opacity[shown], quantizer.centre, options=options)
    pixels[shown] = atlas_pixels(slots, options=options)
    return Seating(first, frames, dynamic, pixels)


def draw_triplets(codes: Codes, seating: Seating, *, sh_degree: int, options: UvOptions) -> dict[str, np.ndarray]:
    """Every triplet of a frame of the segment, uint8 [height, width, 3] each."""
    rows = seating.visible(codes)
    y, x = seating.pixels[rows].T
    here = codes[rows]
    flags = np.stack([here.attributes[:, OPACITY], 255 * (rows < seating.dynamic), np.zeros(len(rows))], axis=1)
    values = {POSITION_HI: here.xyz >> 8, POSITION_LO: here.xyz & 255, OPACITIES: flags}
    values |= {name: here.attributes[:, columns] for name, columns in attribute_triplets(sh_degree).items()}
    pictures = {}
    for name in triplet_names(sh_degree):
        pictures[name] = np.zeros((*atlas_size(options), 3), np.uint8)
        pictures[name][y, x] = values[name]
    return pictures


def filled(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """Texels that hold a Gaussian, bool [height, width]."""
    texels: np.ndarray = (pictures[POSITION_HI] | pictures[POSITION_LO]).any(axis=2)
    return texels


def read_triplets(pictures: Mapping[str, np.ndarray], *, sh_degree: int) -> Codes:
    """The Gaussians of a frame, in raster order: inverse of `draw_triplets` for those that are visible."""
    high, low = pictures[POSITION_HI].astype(np.uint16), pictures[POSITION_LO]
    y, x = np.nonzero(filled(pictures))
    attributes = np.empty((len(y), attribute_count(sh_degree)), np.uint8)
    attributes[:, OPACITY] = pictures[OPACITIES][y, x, 0]
    for name, columns in attribute_triplets(sh_degree).items():
        attributes[:, columns] = pictures[name][y, x]
    return Codes(high[y, x] << 8 | low[y, x], attributes)


# For people


def sheet(scene: Scene, frame: int, *, options: UvOptions, triplet: str | None = None) -> np.ndarray:
    """A picture of a frame's atlas, uint8 [height, width, 3]: all triplets with captions, or the one that is named.

    The sheet shows the colours as they are seen and texels larger than they are; a single triplet is as stored. Raises
    ValueError for a triplet that the scene lacks, IndexError for a frame outside it.
    """
    degree = scene.header.quantizer.sh_degree
    if triplet is not None and triplet not in triplet_names(degree):
        raise ValueError(f"the scene has the triplets {', '.join(triplet_names(degree))}, but not {triplet!r}")
    seating, codes = seat(scene, scene.segment_at(frame), options=options), scene.codes(frame)
    pictures = draw_triplets(codes, seating, sh_degree=degree, options=options)
    if triplet is not None:
        return pictures[triplet]
    pictures["colour"] = _as_seen(pictures, scene.header.quantizer, scene.light(frame))
    return _tiled(pictures)


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write uint8 [height, width, 3] as a PNG, exactly; the name may have any suffix."""
    done, content = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    assert done
    with whole_file(path) as partial:
        partial.write_bytes(content.tobytes())


def _as_seen(pictures: Mapping[str, np.ndarray], quantizer: Quantizer, light: np.ndarray) -> np.ndarray:
    """The base colours on screen in this light, black where no Gaussian is."""
    values = np.stack([quantizer.attribute_table[DC][k][pictures["colour"][..., k]] for k in range(3)])
    shown = np.rint(np.clip(lit(0.5 + SH_C0 * values, light), 0, 1) * 255).astype(np.uint8).transpose(1, 2, 0)
    return np.where(filled(pictures)[..., None], shown, 0)


def _tiled(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """Pictures of one size, two across, each under its name."""
    height, width = next(iter(pictures.values())).shape[:2]
    down = -(-len(pictures) // 2)
    page = np.full((down * (height + CAPTION), 2 * width + SHEET_GAP, 3), 32, np.uint8)
    for place, (name, picture) in enumerate(pictures.items()):
        top, left = place // 2 * (height + CAPTION), place % 2 * (width + SHEET_GAP)
        cv2.putText(page, name, (left + 8, top + CAPTION - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (230, 230, 230), 2)
        page[top + CAPTION : top + CAPTION + height, left : left + width] = _thickened(picture)
    return page


def _thickened(picture: np.ndarray) -> np.ndarray:
    """Used texels grow into empty neighbours: most of an atlas is empty, and single pixels vanish on a screen."""
    grown = cv2.dilate(picture, np.ones((3, 3), np.uint8))
    return np.where(picture.any(axis=2, keepdims=True), picture, grown)
