"""Pictures on demand: exact decoding per camera."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import av
import numpy as np

if TYPE_CHECKING:
    from torchcodec.decoders import VideoDecoder  # type: ignore[attr-defined]  # it lists no __all__


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
            # Here, since it takes seconds, and torch; many processes read no video.
            from torchcodec.decoders import VideoDecoder  # type: ignore[attr-defined]  # it lists no __all__

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
