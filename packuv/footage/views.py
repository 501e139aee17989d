"""Pictures on demand: exact decoding per camera, and the undistorted views that a fit sees, with what the camera makes
of the rig's colours.

Nothing is written to disk. A picture that differs from the one asked for is never returned: every decoded frame
must carry the timestamp that the container's packets give to that frame number.
"""

from __future__ import annotations

import base64
import zlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np

from packuv.budget import Budget
from packuv.camera import PinholeCamera
from packuv.colour import OFFSET, light_factors
from packuv.footage.lens import LensCamera, undistorted_camera, undistortion_maps
from packuv.footage.planes import as_planes
from packuv.footage.reader import FrameReader
from packuv.footage.response import Response
from packuv.footage.spill import Spill
from packuv.footage.transfer import Transfer


class Views:
    """What a fit and an evaluation see: undistorted pictures by camera and instant, and each camera's response.

    A camera is an index into `cameras`, an instant a row of `frames`. Pictures of the last instants stay in memory
    as bytes as far as the budget goes, the rest on disk where `spill` names a folder for it; reading instants in
    ascending order decodes every frame once.
    """

    cameras: tuple[PinholeCamera, ...]
    """The undistorted cameras, at the size of the pictures"""

    def __init__(
        self,
        videos: Mapping[str, Path],
        frames: np.ndarray,
        lenses: Sequence[LensCamera],
        *,
        max_width: int | None = None,
        transfer: Transfer | None = None,
        light: np.ndarray | None = None,
        budget: Budget | None = None,
        spill: Path | None = None,
        reader: FrameReader | None = None,
    ) -> None:
        """`frames` is int [T, C]: frame number in the video of camera c at instant t, -1 where it has none.

        `light`, float [T, C, 3], is the natural logarithm of what the light of the instant and the camera's own
        exposure make of linear light, None where both are steady. Pictures wider than `max_width` are scaled down to
        it. `transfer` is what the code values of all videos mean, None what each is tagged with. `budget` is for
        pictures and maps of lenses, and for what others hold; None: 1 GiB of its own. `reader`, which has a transfer of
        its own, is shared with others if given.
        Raises ValueError where shapes disagree, a camera has no video, or a lens cannot be undistorted.
        """
        names = [lens.pinhole.name for lens in lenses]
        if frames.ndim != 2 or frames.shape[1] != len(lenses) or not len(lenses):
            raise ValueError(f"frames must be [T, C] with C = {len(lenses)} cameras, but are {frames.shape}")
        if missing := sorted(set(names) - set(videos)):
            raise ValueError(f"cameras {missing} have no video; there are videos of {sorted(videos)}")
        if light is not None and light.shape != (*frames.shape, 3):
            raise ValueError(f"light must be {(*frames.shape, 3)} as the frames are, but is {light.shape}")
        self.lenses = tuple(lenses)
        self.light = None if light is None else light.astype(np.float32)
        self.frames = frames.astype(np.int32)
        self.max_width = max_width
        self.transfer = transfer
        self.reader = reader or FrameReader({name: Path(videos[name]) for name in names}, transfer=transfer)
        self._videos = {name: Path(videos[name]) for name in names}
        undistorted = [undistorted_camera(lens) for lens in lenses]
        self._undistorted_cameras = undistorted
        self._maps: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.cameras = tuple(_limited(camera, max_width) for camera in undistorted)
        self._cache: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self.budget = Budget(1 << 30) if budget is None else budget
        self._spill = None if spill is None else Spill(spill)
        self._guard = Lock()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    def __len__(self) -> int:
        """Number of instants, T."""
        return len(self.frames)

    def has(self, camera: int, instant: int) -> bool:
        """Whether there is a picture."""
        return bool(self.frames[instant, camera] >= 0)

    def filmed(self, camera: int, instant: int) -> np.ndarray | None:
        """Undistorted picture in the camera's own colours, float32 [3, H, W] in [0, 1], or None without a frame."""
        pixels = self.pixels(camera, instant)
        return None if pixels is None else as_planes(pixels)

    def picture(self, camera: int, instant: int) -> np.ndarray | None:
        """Picture in the rig's common colour and steady light, float32 [3, H, W], or None where there is no frame."""
        filmed = self.filmed(camera, instant)
        return None if filmed is None else self.response(camera, instant).undone(filmed)

    def response(self, camera: int, instant: int | None) -> Response:
        """What the camera makes of the rig's colours at an instant; None: in steady light."""
        light = None if self.light is None or instant is None else self.light[instant, camera]
        return Response.of(self.lenses[camera], self.cameras[camera], light)

    def steady(self, camera: int, instant: int, *, remember: bool = True) -> np.ndarray | None:
        """`pixels` as steady light and exposure would have them: what differs between two of them has moved."""
        pixels = self.pixels(camera, instant, remember=remember)
        return None if pixels is None else self.steadied(pixels, camera, instant)

    def steadied(self, pixels: np.ndarray, camera: int, instant: int) -> np.ndarray:
        """What `steady` makes of the `pixels` of a camera and instant, uint8 [H, W, 3]."""
        if self.light is None or not self.light[instant, camera].any():
            return pixels
        factors = light_factors(self.light[instant, camera])
        table = (np.arange(256)[:, None] / 255 + OFFSET) / factors - OFFSET  # [256, 3]
        steady: np.ndarray = cv2.LUT(pixels, np.rint(255 * np.clip(table, 0, 1)).astype(np.uint8)[None])
        return steady

    def pixels(self, camera: int, instant: int, *, remember: bool = True) -> np.ndarray | None:
        """Undistorted picture in the camera's own colours, uint8 [H, W, 3], read-only, or None."""
        frame = int(self.frames[instant, camera])
        if frame < 0:
            return None
        key = (camera, frame)
        with self._guard:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
            pixels = self._spill.read(key) if self._spill is not None and key in self._spill else None
        if pixels is None:
            pixels = self._undistorted(camera, frame)
        pixels.setflags(write=False)
        if remember:
            self._remember(key, pixels)
        return pixels

    def forget(self) -> None:
        """Let go of all pictures: the next ones are of other instants."""
        with self._guard:
            while self._cache:
                self.budget.give(self._cache.popitem()[1].nbytes)
            if self._spill is not None:
                self._spill.clear()

    def to_spec(self) -> dict[str, Any]:
        """Everything `from_spec` needs to build these views in another process, as JSON."""
        return {
            "videos": {name: str(path.resolve()) for name, path in self._videos.items()},
            "cameras": [lens.to_json() for lens in self.lenses],
            "frames": _packed(self.frames),
            "max_width": self.max_width,
            "transfer": self.transfer,
            "light": None if self.light is None else _text(self.light),
        }

    @classmethod
    def from_spec(cls, spec: Mapping[str, Any]) -> Views:
        """Inverse of `to_spec`."""
        lenses = [LensCamera.from_json(item) for item in spec["cameras"]]
        frames = _unpacked(spec["frames"], len(lenses))
        videos = {name: Path(path) for name, path in spec["videos"].items()}
        transfer = Transfer(spec["transfer"]) if spec["transfer"] else None
        light = None if spec["light"] is None else _numbers(spec["light"], "<f4").reshape(*frames.shape, 3)
        return cls(videos, frames, lenses, max_width=spec["max_width"], transfer=transfer, light=light)

    def __reduce__(self) -> tuple[Any, ...]:
        return (Views.from_spec, (self.to_spec(),))

    def _undistorted(self, camera: int, frame: int) -> np.ndarray:
        lens, target = self.lenses[camera].pinhole, self.cameras[camera]
        pixels = self.reader.read(lens.name, frame)
        if pixels.shape[:2] != (lens.height, lens.width):
            raise ValueError(
                f"camera {lens.name!r}: the video is {pixels.shape[1]}x{pixels.shape[0]}, its calibration "
                f"{lens.width}x{lens.height}; scale the calibration to the video"
            )
        if maps := self._lens_maps(camera):
            pixels = cv2.remap(pixels, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if target.width != lens.width:
            pixels = cv2.resize(pixels, (target.width, target.height), interpolation=cv2.INTER_AREA)
        return pixels

    def _lens_maps(self, camera: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Kept as far as the budget goes."""
        if camera in self._maps:
            return self._maps[camera]
        maps = undistortion_maps(self.lenses[camera], self._undistorted_cameras[camera])
        with self._guard:
            room = maps is not None and camera not in self._maps
            if maps is not None and room and self.budget.take(sum(part.nbytes for part in maps)):
                self._maps[camera] = maps
        return maps

    def _remember(self, key: tuple[int, int], pixels: np.ndarray) -> None:
        """Keep a picture, in place of those that nobody asked for longest."""
        with self._guard:
            if key in self._cache:
                return
            while not self.budget.take(pixels.nbytes):
                if not self._cache:
                    self._put_aside(key, pixels)
                    return
                oldest, lost = self._cache.popitem(last=False)
                self.budget.give(lost.nbytes)
                self._put_aside(oldest, lost)
            self._cache[key] = pixels

    def _put_aside(self, key: tuple[int, int], pixels: np.ndarray) -> None:
        if self._spill is None:
            return
        with suppress(OSError):  # a full disk: the picture is decoded again
            self._spill.write(key, pixels)


def _packed(frames: np.ndarray) -> str:
    """Steps between instants, so that hours fit into a line of JSON: frame numbers mostly count by one."""
    steps = np.diff(frames, axis=0, prepend=np.zeros_like(frames[:1]))
    return _text(steps.T.astype("<i4"))


def _unpacked(text: str, cameras: int) -> np.ndarray:
    """int32 [T, cameras]; the inverse of `_packed`."""
    return np.cumsum(_numbers(text, "<i4").reshape(cameras, -1).T, axis=0, dtype=np.int32)


def _text(numbers: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(numbers.tobytes(), 6)).decode()


def _numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype=kind)


def _limited(camera: PinholeCamera, max_width: int | None) -> PinholeCamera:
    if max_width is None or camera.width <= max_width:
        return camera
    return camera.scaled(max_width, max(1, round(camera.height * max_width / camera.width)))
