"""Pictures in files: PNG, JPEG and EXR, with an Exif orientation where one is asked for."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np


def exif(orientation: int) -> bytes:
    """The TIFF structure of Exif with one entry."""
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01" + orientation.to_bytes(2) + b"\0\0"
    return b"MM\0\x2a\0\0\0\x08\0\x01" + entry + b"\0\0\0\0"


def write_picture(path: Path, picture: np.ndarray, *, orientation: int = 0) -> Path:
    """RGB or grey, uint8 or uint16, as the suffix says."""
    stored = picture[..., ::-1] if picture.ndim == 3 else picture
    content = bytes(cv2.imencode(path.suffix.lower(), stored)[1])
    if orientation:
        assert content[:2] == b"\xff\xd8"
        segment = b"Exif\0\0" + exif(orientation)
        content = content[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2) + segment + content[2:]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def write_exr(path: Path, light: np.ndarray) -> Path:
    """Linear RGB, float32 [H, W, 3]."""
    codec = av.CodecContext.create("exr", "w")
    assert isinstance(codec, av.VideoCodecContext)
    codec.height, codec.width = light.shape[:2]
    codec.pix_fmt, codec.framerate = "gbrpf32le", 25
    frame = av.VideoFrame(codec.width, codec.height, "gbrpf32le")
    for plane, channel in zip(frame.planes, (1, 2, 0), strict=True):
        memory = np.frombuffer(plane, np.float32).reshape(codec.height, plane.line_size // 4)
        memory[:, : codec.width] = light[..., channel]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)]))
    return path
