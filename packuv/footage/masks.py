"""Foreground masks that come beside the footage: what is a person or thing, by camera and frame."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import cv2
import numpy as np

from packuv.footage.lens import LensCamera
from packuv.footage.pictures import picture_names
from packuv.footage.png import MARK, png_size
from packuv.footage.reader import FrameReader
from packuv.footage.views import Views

SHAPES_APART = 0.01
"""By which the ratio of a mask's sides may differ from its camera's: sides are whole pixels"""
HALF = 128


class MaskReader(FrameReader):
    """Masks by camera and number of the frame, in the size of the camera's pictures.

    In PNG all but 0 is foreground, so labels are, too; codecs that lose something blur the border, so in JPEG and video
    it is what is at least half white.
    """

    def __init__(self, masks: Mapping[str, Path], sizes: Mapping[str, tuple[int, int]]) -> None:
        """`sizes` are widths and heights of the cameras' pictures."""
        super().__init__(masks, careful=True)
        self._sizes = sizes
        self._pictures = {name: picture_names(path) if path.is_dir() else [] for name, path in self.videos.items()}

    def read(self, camera: str, frame: int) -> np.ndarray:
        """uint8 [H, W, 3], 255 in the foreground and 0 elsewhere.

        Raises what FrameReader does, and ValueError for a mask of another shape than the camera's pictures.
        """
        pixels, (width, height) = self._raw(camera, frame), self._sizes[camera]
        self._check_shape(camera, frame, pixels.shape[1], pixels.shape[0])
        mask = np.where(pixels.max(axis=2, keepdims=True) >= (1 if self._labels(camera) else HALF), 255, 0).astype(
            np.uint8
        )
        resized = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
        return np.repeat(resized[:, :, None], 3, axis=2)

    def check(self, camera: str) -> None:
        """Raise ValueError that names the first mask that is damaged or of another shape than the camera's pictures.

        PNG is looked at by its checksums, all else is decoded.
        """
        for frame in range(self.frame_count(camera)):
            self._check_shape(camera, frame, *self._size_of(camera, frame))
        if damaged := self.damage(camera):
            self._refuse(camera, min(damaged), "parts of it cannot be decoded")

    def _size_of(self, camera: str, frame: int) -> tuple[int, int]:
        """Width and height."""
        names = self._pictures[camera]
        file = (self.videos[camera] / names[frame]).read_bytes() if names else b""
        if not file.startswith(MARK):
            height, width = super().read(camera, frame).shape[:2]
            return width, height
        try:
            return png_size(file)
        except ValueError as error:
            self._refuse(camera, frame, str(error))

    def _check_shape(self, camera: str, frame: int, own_width: int, own_height: int) -> None:
        width, height = self._sizes[camera]
        if abs(own_width * height - own_height * width) > SHAPES_APART * own_height * width:
            raise ValueError(
                f"{self.videos[camera]} must have masks in the shape of the pictures of {camera}, {width}x{height}, "
                f"but {self._called(camera, frame)} is {own_width}x{own_height}; make them anew of these pictures, or "
                "take them out"
            )

    def _refuse(self, camera: str, frame: int, why: str) -> NoReturn:
        name = self._called(camera, frame)
        raise ValueError(f"{self.videos[camera]}: {name} is damaged: {why}; copy it again, or make it anew")

    def _called(self, camera: str, frame: int) -> str:
        names = self._pictures[camera]
        return names[frame] if names else f"mask {frame}"

    def _raw(self, camera: str, frame: int) -> np.ndarray:
        """[H, W, C] without alpha; of PNG the values in the file, since 16 bits rounded to 8 lose small labels."""
        if not self._labels(camera):
            return super().read(camera, frame)
        path = self.videos[camera] / self._pictures[camera][frame]
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise ValueError(f"{path} cannot be decoded; copy it again")
        return np.asarray(np.atleast_3d(pixels)[:, :, :3])

    def _labels(self, camera: str) -> bool:
        """Whether masks are PNG, and neither JPEG nor video."""
        names = self._pictures[camera]
        return bool(names) and names[0].lower().endswith(".png")


def foreground(pixels: np.ndarray) -> np.ndarray:
    """bool [H, W] of a mask as `Views` undistort and scale it, uint8 [H, W, 3]: at least half of the pixel."""
    return np.asarray(pixels[:, :, 0] >= HALF)


def laid_over(
    masks: Mapping[str, Path], frames: np.ndarray, lenses: Sequence[LensCamera], *, max_width: int | None
) -> Views:
    """Masks of these cameras as `Views` give their pictures, of which arguments are the same."""
    sizes = {lens.pinhole.name: (lens.pinhole.width, lens.pinhole.height) for lens in lenses}
    return Views(masks, frames, lenses, max_width=max_width, reader=MaskReader(masks, sizes))


class Silhouettes:
    """Where the foreground is in the pictures of some cameras, which are known by name."""

    def __init__(self, masks: Views, *, but: Container[str] = ()) -> None:
        """`masks` are laid over the pictures, instant by instant; those of some cameras may be left out."""
        self._masks = masks
        self._places = {name: place for place, name in enumerate(masks.names) if name not in but}

    def of(self, camera: str, instant: int) -> np.ndarray | None:
        """bool [H, W] of a picture; None where there is no mask of it."""
        if camera not in self._places:
            return None
        pixels = self._masks.pixels(self._places[camera], instant, remember=False)
        return None if pixels is None else foreground(pixels)
