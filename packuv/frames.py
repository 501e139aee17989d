"""Pictures on demand: exact decoding per camera, and the undistorted, colour-balanced views that a fit sees.

Nothing is written to disk. A picture that differs from the one asked for is never returned: every decoded frame
must carry the timestamp that the container's packets give to that frame number.
"""

from __future__ import annotations

import base64
import zlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import av
import cv2
import numpy as np

from packuv.camera import PinholeCamera

if TYPE_CHECKING:
    from torchcodec.decoders import VideoDecoder

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
"""Coefficient counts that OpenCV's lens model knows, see `LensCamera.distortion`."""


class FrameReader:
    """Decoded frames by camera and frame number, counted from 0 in presentation order.

    Each camera keeps its decoder and its place in the stream, so frames read in ascending order never seek, whatever
    the other cameras do in between (27 cameras in turn: 3.8 ms of CPU a frame at 640x360, as fast as one pass by PyAV).
    A step back, or past the next key frame, seeks. Safe to use from several threads.
    """

    def __init__(self, videos: Mapping[str, Path], *, threads: int = 1, open_limit: int = 128) -> None:
        """`threads` decode one camera; beyond `open_limit` open decoders the longest unused one is closed.

        Keep the limit above the number of cameras: opening a decoder again scans its whole file.
        """
        if open_limit < 1 or threads < 1:
            raise ValueError(f"threads and open_limit must be at least 1, but are {threads} and {open_limit}")
        self.videos = {name: Path(path) for name, path in videos.items()}
        self._threads = threads
        self._open_limit = open_limit
        self._decoders: OrderedDict[str, VideoDecoder] = OrderedDict()
        self._timestamps: dict[str, np.ndarray] = {}
        self._guard = Lock()
        self._locks = {name: Lock() for name in self.videos}

    def frame_count(self, camera: str) -> int:
        """Frames that the container's packets hold; the header's word is not taken."""
        with self._lock(camera):
            return len(self._times(camera))

    def check_count(self, camera: str, expected: int) -> None:
        """Raise ValueError unless the video has `expected` frames, one per timecode."""
        count = self.frame_count(camera)
        if count != expected:
            raise ValueError(
                f"camera {camera!r}: {self.videos[camera]} has {count} frames, its timecodes {expected}; export the "
                "file again, or list the camera under ignore in capture.toml"
            )

    def read(self, camera: str, frame: int) -> np.ndarray:
        """One frame, uint8 [H, W, 3], RGB.

        Raises FileNotFoundError for a missing file; ValueError for a frame that is not there or cannot be decoded.
        """
        with self._lock(camera):
            return self._read(camera, int(frame))

    def read_many(self, camera: str, frames: Sequence[int] | np.ndarray) -> np.ndarray:
        """Frames in the order asked for, uint8 [n, H, W, 3]; decoded in ascending order, each once."""
        wanted, place = np.unique(np.asarray(frames, dtype=np.int64), return_inverse=True)
        if not len(wanted):
            raise ValueError(f"camera {camera!r}: read_many needs at least one frame number")
        with self._lock(camera):
            pictures = [self._read(camera, int(frame)) for frame in wanted]
        return np.stack([pictures[index] for index in place.ravel()])

    def close(self) -> None:
        """Free every decoder; reading again opens them again."""
        with self._guard:
            self._decoders.clear()

    def _lock(self, camera: str) -> Lock:
        if camera not in self._locks:
            raise ValueError(f"no video of camera {camera!r}; there are {sorted(self.videos)}")
        return self._locks[camera]

    def _times(self, camera: str) -> np.ndarray:
        if camera not in self._timestamps:
            self._timestamps[camera] = packet_seconds(self.videos[camera])
        return self._timestamps[camera]

    def _read(self, camera: str, frame: int) -> np.ndarray:
        times, path = self._times(camera), self.videos[camera]
        if not 0 <= frame < len(times):
            raise ValueError(f"{path} has frames 0 to {len(times) - 1}, but frame {frame} is asked for")
        try:
            decoded = self._decoder(camera).get_frame_at(frame)
        except (RuntimeError, IndexError, ValueError) as error:
            reason = f"cannot be decoded ({_first_line(error)})"
            raise ValueError(f"{path}: frame {frame} {reason}; {_remux_advice(path)}") from error
        # Half a microsecond: far below any frame time, far above float64 rounding of seconds.
        if abs(decoded.pts_seconds - times[frame]) > 5e-7:
            raise ValueError(
                f"{path}: frame {frame} should be shown at {times[frame]:.6f} s, but the decoder returned the "
                f"picture of {decoded.pts_seconds:.6f} s; {_remux_advice(path)}"
            )
        return decoded.data.numpy()

    def _decoder(self, camera: str) -> VideoDecoder:
        with self._guard:
            decoder = self._decoders.pop(camera, None)
        if decoder is None:
            from torchcodec.decoders import VideoDecoder  # takes seconds, and torch; many processes read no video

            decoder = VideoDecoder(
                str(self.videos[camera]), dimension_order="NHWC", num_ffmpeg_threads=self._threads, seek_mode="exact"
            )
        with self._guard:
            self._decoders[camera] = decoder
            while len(self._decoders) > self._open_limit:
                self._decoders.popitem(last=False)
        return decoder


def packet_seconds(path: Path) -> np.ndarray:
    """When each frame of a video is shown, by demuxing alone: float64 [n], seconds, ascending."""
    if not path.is_file():
        raise FileNotFoundError(f"no video at {path}")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            # Packets that an edit list cuts away are marked for discarding; no decoder shows them.
            ticks = [p.pts for p in container.demux(stream) if p.pts is not None and p.size and not p.is_discard]
            base = stream.time_base
    except (av.FFmpegError, IndexError) as error:
        raise ValueError(f"{path} cannot be read as a video ({_first_line(error)}); export it again") from error
    if not ticks or base is None:
        raise ValueError(f"{path} holds no timed video frames; remux it (ffmpeg -i {path.name} -c copy out.mkv)")
    return np.sort(np.array(ticks, dtype=np.int64)) * float(base)


def _remux_advice(path: Path) -> str:
    remux = f"ffmpeg -i {path.name} -c copy {path.stem}.mkv"
    return f"the file is damaged or its container cannot be searched: remux it ({remux}), or record it again"


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


@dataclass(frozen=True)
class LensCamera:
    """A camera as it films: its pinhole, the lens in front of it, and its colours."""

    pinhole: PinholeCamera
    """Intrinsics and pose in the video's own pixels; the name is the key of its video"""
    distortion: tuple[float, ...] = ()
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1..s4 [tx ty]]]]; empty for a pinhole camera"""
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear-light factors r g b that bring this camera to the rig's common colour"""

    def __post_init__(self) -> None:
        if len(self.distortion) not in DISTORTION_LENGTHS:
            raise ValueError(
                f"camera {self.pinhole.name!r}: a lens has one of {DISTORTION_LENGTHS} coefficients, "
                f"not {len(self.distortion)}"
            )
        if len(self.gains) != 3 or not all(np.isfinite(gain) and gain > 0 for gain in self.gains):
            raise ValueError(f"camera {self.pinhole.name!r}: gains must be three positive numbers, not {self.gains}")

    def to_json(self) -> dict[str, Any]:
        # All floats, so that a round trip through JSON gives the same text: caches compare by it.
        floats = {key: float(getattr(self.pinhole, key)) for key in ("fx", "fy", "cx", "cy")}
        lens = {"distortion": [float(k) for k in self.distortion], "gains": [float(gain) for gain in self.gains]}
        return {**self.pinhole.to_json(), **floats, **lens}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> LensCamera:
        red, green, blue = data["gains"]
        return cls(PinholeCamera.from_json(data), tuple(data["distortion"]), (red, green, blue))


class Views:
    """What a fit and an evaluation see: undistorted, colour-balanced pictures by camera and instant.

    A camera is an index into `cameras`, an instant a row of `frames`. Pictures of the last instants stay in memory
    as bytes, up to `cache_bytes`; reading instants in ascending order decodes every frame once.
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
        cache_bytes: int = 1 << 30,
        reader: FrameReader | None = None,
    ) -> None:
        """`frames` is int [T, C]: frame number in the video of camera c at instant t, -1 where it has none.

        Pictures wider than `max_width` are scaled down to it. `reader` is shared with others if given.
        Raises ValueError where shapes disagree, a camera has no video, or a lens cannot be undistorted.
        """
        names = [lens.pinhole.name for lens in lenses]
        if frames.ndim != 2 or frames.shape[1] != len(lenses) or not len(lenses):
            raise ValueError(f"frames must be [T, C] with C = {len(lenses)} cameras, but are {frames.shape}")
        if missing := sorted(set(names) - set(videos)):
            raise ValueError(f"cameras {missing} have no video; there are videos of {sorted(videos)}")
        self.lenses = tuple(lenses)
        self.frames = frames.astype(np.int32)
        self.max_width = max_width
        self.reader = reader or FrameReader({name: Path(videos[name]) for name in names})
        self._videos = {name: Path(videos[name]) for name in names}
        undistorted = [undistorted_camera(lens) for lens in lenses]
        self._maps = [undistortion_maps(lens, camera) for lens, camera in zip(lenses, undistorted, strict=True)]
        self.cameras = tuple(_limited(camera, max_width) for camera in undistorted)
        self._tables = [gain_table(lens.gains) for lens in lenses]
        self._cache: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self._cache_bytes = cache_bytes
        self._cached_bytes = 0
        self._guard = Lock()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    def __len__(self) -> int:
        """Number of instants, T."""
        return len(self.frames)

    def picture(self, camera: int, instant: int) -> np.ndarray | None:
        """Colour-balanced picture, float32 [3, H, W] in [0, 1], or None where the camera has no frame."""
        pixels = self.pixels(camera, instant)
        return None if pixels is None else self.balanced(camera, pixels)

    def balanced(self, camera: int, pixels: np.ndarray) -> np.ndarray:
        """Pixels of a camera, uint8 [H, W, 3], in the rig's common colour: float32 [3, H, W] in [0, 1]."""
        picture = np.empty((3, *pixels.shape[:2]), dtype=np.float32)
        for channel, table in enumerate(self._tables[camera]):
            picture[channel] = cv2.LUT(cv2.extractChannel(pixels, channel), table)
        return picture

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
        pixels = self._undistorted(camera, frame)
        pixels.setflags(write=False)
        if remember:
            self._remember(key, pixels)
        return pixels

    def to_spec(self) -> dict[str, Any]:
        """Everything `from_spec` needs to build these views in another process, as JSON."""
        return {
            "videos": {name: str(path.resolve()) for name, path in self._videos.items()},
            "cameras": [lens.to_json() for lens in self.lenses],
            "frames": _packed(self.frames),
            "max_width": self.max_width,
        }

    @classmethod
    def from_spec(cls, spec: Mapping[str, Any]) -> Views:
        """Inverse of `to_spec`."""
        lenses = [LensCamera.from_json(item) for item in spec["cameras"]]
        frames = _unpacked(spec["frames"], len(lenses))
        videos = {name: Path(path) for name, path in spec["videos"].items()}
        return cls(videos, frames, lenses, max_width=spec["max_width"])

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
        if maps := self._maps[camera]:
            pixels = cv2.remap(pixels, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if target.width != lens.width:
            pixels = cv2.resize(pixels, (target.width, target.height), interpolation=cv2.INTER_AREA)
        return pixels

    def _remember(self, key: tuple[int, int], pixels: np.ndarray) -> None:
        with self._guard:
            if key in self._cache:
                return
            self._cache[key] = pixels
            self._cached_bytes += pixels.nbytes
            while self._cached_bytes > self._cache_bytes and len(self._cache) > 1:
                self._cached_bytes -= self._cache.popitem(last=False)[1].nbytes


def _packed(frames: np.ndarray) -> str:
    """Steps between instants, deflated: frame numbers mostly count by one, so hours fit into a line of JSON."""
    steps = np.diff(frames, axis=0, prepend=np.zeros_like(frames[:1]))
    return base64.b64encode(zlib.compress(steps.T.astype("<i4").tobytes(), 6)).decode()


def _unpacked(text: str, cameras: int) -> np.ndarray:
    """int32 [T, cameras]; the inverse of `_packed`."""
    steps = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype="<i4").reshape(cameras, -1)
    return np.cumsum(steps.T, axis=0, dtype=np.int32)


def _limited(camera: PinholeCamera, max_width: int | None) -> PinholeCamera:
    if max_width is None or camera.width <= max_width:
        return camera
    return camera.scaled(max_width, max(1, round(camera.height * max_width / camera.width)))


def gain_table(gains: tuple[float, float, float]) -> np.ndarray:
    """float32 [3, 256]: sRGB in [0, 1] of each 8-bit sRGB value times a gain in linear light."""
    value = np.arange(256) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    scaled = np.clip(linear * np.asarray(gains)[:, None], 0, 1)  # [3, 256]
    encoded = np.where(scaled <= 0.0031308, scaled * 12.92, 1.055 * scaled ** (1 / 2.4) - 0.055)
    return np.clip(encoded, 0, 1).astype(np.float32)


def undistorted_camera(lens: LensCamera) -> PinholeCamera:
    """The widest pinhole camera with this centre and picture size that shows only what the lens filmed.

    Raises ValueError for coefficients that fold the picture over itself.
    """
    if not any(lens.distortion):
        return lens.pinhole
    zooms = np.geomspace(4, 1 / 4, 81)
    valid = [_covered(lens, zoom) for zoom in zooms]
    if not valid[0]:
        raise ValueError(
            f"camera {lens.pinhole.name!r}: lens coefficients {lens.distortion} do not map the picture one to one, "
            "not even at its centre; check the calibration"
        )
    good = zooms[valid.index(False) - 1] if False in valid else zooms[-1]
    low = good * zooms[1] / zooms[0]
    for _ in range(12):
        middle = (low * good) ** 0.5
        low, good = (low, middle) if _covered(lens, middle) else (middle, good)
    return _zoomed(lens.pinhole, good)


def _zoomed(camera: PinholeCamera, zoom: float) -> PinholeCamera:
    return PinholeCamera(
        camera.name, camera.width, camera.height, camera.fx * zoom, camera.fy * zoom, camera.cx, camera.cy,
        camera.camera_from_world,
    )  # fmt: skip


def _covered(lens: LensCamera, zoom: float) -> bool:
    """Whether rays through the border of the zoomed picture land inside the filmed one, without a fold on the way."""
    camera = lens.pinhole
    across, down = np.linspace(0, camera.width, 33), np.linspace(0, camera.height, 33)
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(across, y), axis=1) for y in (0, camera.height)]
        + [np.stack(np.broadcast_arrays(x, down), axis=1) for x in (0, camera.width)]
    )  # [132, 2], pixels
    rays = (border - [camera.cx, camera.cy]) / [camera.fx * zoom, camera.fy * zoom]
    # From the centre outwards; the short last step catches a fold right at the border.
    steps = np.append(np.linspace(0, 1, 33)[1:-1], [0.999, 1])[:, None, None] * rays  # [33, 132, 2]
    filmed = _filmed(lens, steps.reshape(-1, 2)).reshape(steps.shape)
    radius = np.linalg.norm(filmed - [camera.cx, camera.cy], axis=2)
    inside = (filmed >= 0) & (filmed <= [camera.width, camera.height])
    return bool(inside.all() and (np.diff(radius, axis=0) > 0).all())


def _filmed(lens: LensCamera, rays: np.ndarray) -> np.ndarray:
    """Pixels, float64 [n, 2], where a lens shows rays [n, 2], given at depth 1."""
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.pinhole.matrix, np.array(lens.distortion))
    return pixels.reshape(-1, 2)


def undistortion_maps(lens: LensCamera, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray] | None:
    """Fixed-point maps for cv2.remap from the filmed picture to the pinhole one; None for a pinhole lens."""
    if not any(lens.distortion):
        return None
    # OpenCV puts the centre of the first pixel at 0, we put it at 0.5.
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    size = (camera.width, camera.height)
    maps = cv2.initUndistortRectifyMap(
        lens.pinhole.matrix - shift, np.array(lens.distortion), np.eye(3), camera.matrix - shift, size, cv2.CV_16SC2
    )
    return maps[0], maps[1]
