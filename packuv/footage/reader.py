"""Pictures on demand: exact decoding per camera."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import av
import numpy as np

from packuv.footage.damage import Damage, DamagedPictureError
from packuv.footage.exact import ExactDecoder
from packuv.footage.packets import Packets
from packuv.footage.pictures import PictureDecoder
from packuv.footage.transfer import Transfer

if TYPE_CHECKING:
    from torchcodec.decoders import VideoDecoder  # type: ignore[attr-defined]  # it lists no __all__


LONG = 1000
"""Frames of a video from which on what its packets tell is worth a file"""
TABLES = 1
"""Version of these files"""


class FrameReader:
    """Decoded frames by camera and frame number, counted from 0 in presentation order.

    Each camera keeps its decoder and its place in the stream, so frames read in ascending order never seek, whatever
    the other cameras do in between (27 cameras in turn: 3.8 ms of CPU a frame at 640x360, as fast as one pass by PyAV).
    A step back, or past the next key frame, seeks. Safe to use from several threads.

    Every picture is display-referred sRGB, whatever its video holds: more than 8 bits are rounded once, at the end, and
    log curves become light before (`packuv.footage.transfer`). PyAV decodes. FFmpeg makes pictures of what it shows as
    it is meant, 8-bit video with its matrix named; of the rest we convert the planes. A folder is a video of pictures.

    Pictures are turned as their file says. What the decoder had to conceal is given, and so is what is predicted from
    it; `damage` tells which frames these are.
    """

    def __init__(
        self,
        videos: Mapping[str, Path],
        *,
        transfer: Transfer | None = None,
        threads: int = 1,
        open_limit: int = 128,
        kept: Path | None = None,
        careful: bool = False,
    ) -> None:
        """`transfer` is what code values mean; None leaves it to the tags: HLG, PQ, or else a finished picture.

        `kept` is a folder for what the packets of long videos tell, so that the next reader need not demux them.

        `careful` looks for damage of which decoders say nothing, that of JPEG data (60 % more time for these).

        `threads` decode one camera; beyond `open_limit` open decoders the longest unused one is closed.

        Keep the limit above the number of cameras: opening a decoder again scans its whole file.
        """
        if open_limit < 1 or threads < 1:
            raise ValueError(f"threads and open_limit must be at least 1, but are {threads} and {open_limit}")
        self.videos = {name: Path(path) for name, path in videos.items()}
        self.transfer = transfer
        self._threads = threads
        self._open_limit = open_limit
        self._careful = careful
        self._decoders: OrderedDict[str, Decoder] = OrderedDict()
        self._damage: dict[str, dict[int, Damage]] = {name: {} for name in self.videos}
        self._found: dict[str, Packets] = {}
        self._kept = kept
        self._guard = Lock()
        self._locks = {name: Lock() for name in self.videos}

    def frame_count(self, camera: str) -> int:
        """Frames that the container's packets hold; the header's word is not taken."""
        with self._lock(camera):
            return len(self._packets(camera).ticks)

    def check_count(self, camera: str, expected: int) -> None:
        """Raise ValueError unless the video has `expected` frames, one per timecode."""
        count = self.frame_count(camera)
        if count != expected:
            raise ValueError(
                f"camera {camera!r}: {self.videos[camera]} has {count} frames, its timecodes {expected}; export the "
                "file again, or list the camera under ignore in capture.toml"
            )

    def damage(self, camera: str) -> Mapping[int, Damage]:
        """What is wrong with the frames that were read so far, and with those that rely on them, by number."""
        with self._lock(camera):
            return dict(self._damage[camera])

    def read(self, camera: str, frame: int) -> np.ndarray:
        """One frame, uint8 [H, W, 3], RGB.

        Raises FileNotFoundError for a missing file; ValueError for a frame that is not there, DamagedPictureError for
        one of which nothing can be decoded.
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

    def _packets(self, camera: str) -> Packets:
        if camera not in self._found:
            self._found[camera] = Packets.read(self.videos[camera], self._kept)
        return self._found[camera]

    def _read(self, camera: str, frame: int) -> np.ndarray:
        packets, path = self._packets(camera), self.videos[camera]
        if not 0 <= frame < len(packets.ticks):
            raise ValueError(f"{path} has frames 0 to {len(packets.ticks) - 1}, but frame {frame} is asked for")
        try:
            pixels, seconds = self._decoder(camera).read(frame)
        except (RuntimeError, IndexError, ValueError, av.FFmpegError) as error:
            kind = DamagedPictureError if isinstance(error, DamagedPictureError) else ValueError
            reason = f"cannot be decoded ({_first_line(error)})"
            raise kind(f"{path}: frame {frame} {reason}; {_remux_advice(path)}") from error
        # Half a microsecond: far below any frame time, far above float64 rounding of seconds.
        expected = packets.ticks[frame] * float(packets.base)
        if abs(seconds - expected) > 5e-7:
            raise ValueError(
                f"{path}: frame {frame} should be shown at {expected:.6f} s, but the decoder returned the "
                f"picture of {seconds:.6f} s; {_remux_advice(path)}"
            )
        return pixels

    def _decoder(self, camera: str) -> Decoder:
        with self._guard:
            decoder = self._decoders.pop(camera, None)
        if decoder is None:
            path, packets, damage = self.videos[camera], self._packets(camera), self._damage[camera]
            said, careful = self.transfer, self._careful
            if packets.pictures:
                decoder = PictureDecoder(path, packets.pictures, damage, said=said, careful=careful)
            elif packets.coding.plain(self.transfer) and packets.coding.coarse:
                decoder = TorchDecoder(path, packets.index, threads=self._threads)
            else:
                decoder = ExactDecoder(path, packets, damage, said=said, threads=self._threads, careful=careful)
        with self._guard:
            self._decoders[camera] = decoder
            while len(self._decoders) > self._open_limit:
                self._decoders.popitem(last=False)
        return decoder


class TorchDecoder:
    """One open video with chroma coarser than FFmpeg's versions agree about, see `Coding.coarse`."""

    def __init__(self, path: Path, stream: int, *, threads: int) -> None:
        """`stream` is the number of the stream among all of the container."""
        # Here, since it takes seconds, and torch; many processes read no video.
        from torchcodec.decoders import VideoDecoder  # type: ignore[attr-defined]  # it lists no __all__

        self._decoder: VideoDecoder = VideoDecoder(
            str(path), stream_index=stream, dimension_order="NHWC", num_ffmpeg_threads=threads, seek_mode="exact"
        )

    def read(self, frame: int) -> tuple[np.ndarray, float]:
        """A picture, uint8 [H, W, 3], and when it is shown, seconds."""
        decoded = self._decoder.get_frame_at(frame)
        return decoded.data.numpy(), decoded.pts_seconds


Decoder = TorchDecoder | ExactDecoder | PictureDecoder


def _remux_advice(path: Path) -> str:
    if path.is_dir():
        return "copy it again"
    remux = f"ffmpeg -i {path.name} -c copy {path.stem}.mkv"
    return f"the file is damaged or its container cannot be searched: remux it ({remux}), or record it again"


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
