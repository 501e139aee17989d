"""PlayCanvas's SOG: lossless WebP pictures, a texel for each Gaussian, and meta.json; a folder, or one zip archive.

Positions are 16-bit on a symmetric-log scale, rotations drop their largest component, scales and colours are indices
into codebooks (version 2) or shares of a range (version 1), SH bands above 0 index a palette.
"""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from packuv.gaussians.floats import Gaussians
from packuv.interchange.conventions import logits_of_alpha, restore_largest

META = "meta.json"
PALETTE_ROW = 64
"""Palette entries in a row of the centroids' picture."""

_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    cv2.error,
    KeyError,
    TypeError,
    AttributeError,
    IndexError,
    OverflowError,
    EOFError,
    RuntimeError,
    json.JSONDecodeError,
    UnicodeDecodeError,
)
"""What the zip reader, the JSON reader, OpenCV and look-ups in a strange document raise."""

_Pictures = Callable[[str], np.ndarray]


def read_sog(path: Path) -> Gaussians:
    """Gaussians of a .sog archive, of an unpacked folder, or of its meta.json; axes stay as they are.

    Raises FileNotFoundError, or ValueError for a file that is damaged, lacks a picture, or is of an unknown version.
    """
    path = Path(path)
    try:
        if path.is_dir() or path.name == META:
            folder = path if path.is_dir() else path.parent
            return _gaussians(json.loads((folder / META).read_text()), lambda name: _inside(folder, name).read_bytes())
        with zipfile.ZipFile(path) as archive:
            return _gaussians(json.loads(archive.read(META)), archive.read)
    except _DAMAGED as error:
        raise ValueError(f"{path} is no SOG scene, or damaged: {error}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _inside(folder: Path, name: str) -> Path:
    if Path(name).name != name:
        raise ValueError(f"{META} names a picture outside its folder: {name!r}")
    return folder / name


def _gaussians(meta: Mapping[str, Any], read: Callable[[str], bytes]) -> Gaussians:
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise ValueError(f"it is SOG version {version}, this program reads 1 and 2")
    count = int(meta["count"] if "count" in meta else meta["means"]["shape"][0])
    if count < 0:
        raise ValueError(f"it says that it holds {count} Gaussians")

    def texels(name: str) -> np.ndarray:
        return _texels(name, read(name), count)

    base = texels(meta["sh0"]["files"][0])  # [n, 4]
    dc = _values(meta["sh0"], base[:, :3], slice(0, 3))[:, None]
    opacity = logits_of_alpha(base[:, 3])
    if "codebook" not in meta["sh0"]:  # version 1 keeps the logit, on a range of its own
        opacity = _values(meta["sh0"], base[:, 3], 3).astype(np.float32)
    sh = np.concatenate([dc, _bands(meta["shN"], texels, read)], axis=1) if "shN" in meta else dc
    return Gaussians(
        _positions(meta["means"], texels),
        _values(meta["scales"], texels(meta["scales"]["files"][0])[:, :3], slice(0, 3)).astype(np.float32),
        _rotations(texels(meta["quats"]["files"][0])),
        opacity,
        sh.astype(np.float32),
    )


def _picture(name: str, content: bytes) -> np.ndarray:
    """uint8 [height, width, 4], r g b a."""
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    if picture is None or picture.ndim != 3 or picture.dtype != np.uint8:
        raise ValueError(f"{name} is no 8-bit colour picture")
    return cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA if picture.shape[2] == 4 else cv2.COLOR_BGR2RGBA)


def _texels(name: str, content: bytes, count: int) -> np.ndarray:
    """The first `count` texels, row by row, uint8 [count, 4]."""
    texels = _picture(name, content).reshape(-1, 4)
    if len(texels) < count:
        raise ValueError(f"{name} has {len(texels)} texels for {count} Gaussians")
    return texels[:count]


def _values(meta: Mapping[str, Any], codes: np.ndarray, columns: slice | int) -> np.ndarray:
    """Entries of the codebook, or shares of the range of the columns, float64."""
    if "codebook" in meta:
        return _entries(meta, codes)
    low, high = (np.asarray(meta[end], np.float64)[columns] for end in ("mins", "maxs"))
    return low + codes / 255 * (high - low)


def _entries(meta: Mapping[str, Any], codes: np.ndarray) -> np.ndarray:
    entries: np.ndarray = np.asarray(meta["codebook"], np.float64)[codes]
    return entries


def _positions(meta: Mapping[str, Any], texels: _Pictures) -> np.ndarray:
    """float32 [n, 3]."""
    lower, upper = (texels(name)[:, :3].astype(np.float64) for name in meta["files"])
    low, high = np.asarray(meta["mins"], np.float64), np.asarray(meta["maxs"], np.float64)
    t = low + (upper * 256 + lower) / 65535 * (high - low)
    return (np.sign(t) * np.expm1(np.abs(t))).astype(np.float32)


def _rotations(texels: np.ndarray) -> np.ndarray:
    """w x y z, float32 [n, 4]: alpha is 252 plus the component that was dropped."""
    if (texels[:, 3] < 252).any():
        raise ValueError("a rotation must name its largest component as 252 to 255 in alpha; was it saved lossily?")
    return restore_largest(texels[:, 3].astype(np.int64) - 252, (texels[:, :3] / 255 - 0.5) * math.sqrt(2))


def _bands(meta: Mapping[str, Any], texels: _Pictures, read: Callable[[str], bytes]) -> np.ndarray:
    """SH bands above 0, float64 [n, coefficients, 3]."""
    centroids, labels = meta["files"][:2]
    picture = _picture(centroids, read(centroids))[:, :, :3]
    coefficients = int(meta["bands"]) * (int(meta["bands"]) + 2) if "bands" in meta else picture.shape[1] // PALETTE_ROW
    if coefficients not in (3, 8, 15) or picture.shape[1] < PALETTE_ROW * coefficients:
        raise ValueError(f"{centroids} is {picture.shape[1]} texels wide, too narrow for {coefficients} coefficients")
    palette = picture[:, : PALETTE_ROW * coefficients].reshape(-1, coefficients, 3)
    label = texels(labels)[:, :2].astype(np.int64) @ (1, 256)
    if label.max(initial=0) >= len(palette):
        raise ValueError(f"{labels} points at palette entry {label.max()} of {len(palette)}")
    # Version 1 has one range for all coefficients.
    if "codebook" in meta:
        return _entries(meta, palette[label])
    low, high = float(meta["mins"]), float(meta["maxs"])
    values: np.ndarray = low + palette[label] / 255 * (high - low)
    return values
