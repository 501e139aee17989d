"""PlayCanvas's SOG: lossless WebP pictures, a texel for each Gaussian, and meta.json; a folder, or one zip archive.

Positions are 16-bit on a symmetric-log scale, rotations drop their largest component, scales and colours are indices
into codebooks (version 2) or shares of a range (version 1), SH bands above 0 index a palette.
"""

from __future__ import annotations

import errno
import math
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from packuv.bounds import (
    MOST_GAUSSIANS,
    MOST_JSON_BYTES,
    MOST_PIXELS,
    check_unpacked,
    field,
    fields,
    finite,
    items,
    numbers,
    shown,
    whole,
    words,
)
from packuv.files import load_json, parse_json
from packuv.gaussians.floats import Gaussians
from packuv.interchange.conventions import logits_of_alpha, restore_largest

META = "meta.json"
PALETTE_ROW = 64
"""Palette entries in a row of the centroids' picture."""
PICTURES = 5
"""Pictures of a scene without SH bands, a texel of 4 bytes for each Gaussian."""
MOST_PICTURE_BYTES = 4 * MOST_PIXELS
"""Of a WebP file: not more than its texels take."""
MESSAGE = 300
"""Characters of a message of the zip reader, which may repeat a header."""
SLACK = 1 << 16
"""Texels that a picture may have beyond twice the Gaussians: sides are rounded up."""
MOST_LOG = 60
"""Of a position, symmetric: float32 ends at 88."""
MOST_PALETTE = 1 << 20
"""Texels of the centroids' picture: 65,536 entries of 15 coefficients."""

_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    cv2.error,
    KeyError,
    EOFError,
    RuntimeError,
)
"""What the zip reader and OpenCV raise."""

_Pictures = Callable[[str], np.ndarray]


def read_sog(path: Path) -> Gaussians:
    """Gaussians of a .sog archive, of an unpacked folder, or of its meta.json; axes stay as they are.

    Raises FileNotFoundError, or ValueError for a file that is damaged, lacks a picture, or is of an unknown version.
    """
    path = Path(path)
    try:
        if path.is_dir() or path.name == META:
            folder = path if path.is_dir() else path.parent
            packed = sum(entry.stat().st_size for entry in folder.iterdir() if entry.is_file())
            meta = load_json(folder / META)
            return _gaussians(meta, lambda name: _in_folder(folder, name), packed)
        with zipfile.ZipFile(path) as archive:
            meta = parse_json(_in_archive(archive, META), META)
            return _gaussians(meta, lambda name: _in_archive(archive, name), path.stat().st_size)
    except OSError as error:
        if error.errno != errno.EINVAL:  # what a place before the file's start gives
            raise
        raise ValueError(f"{path} is no SOG scene, or damaged: it points outside itself") from None
    except (*_DAMAGED, ValueError) as error:
        raise ValueError(f"{path} is no SOG scene, or damaged: {str(error)[:MESSAGE]}") from None


def antialiased(path: Path) -> bool:
    """Whether a SOG scene that `read_sog` reads says that it was trained with the opacities of Mip-Splatting."""
    path = Path(path)
    if path.is_dir() or path.name == META:
        meta = load_json((path if path.is_dir() else path.parent) / META)
    else:
        with zipfile.ZipFile(path) as archive:
            meta = parse_json(_in_archive(archive, META), META)
    return meta.get("antialias") is True


def _in_folder(folder: Path, name: str) -> bytes:
    if Path(name).name != name:
        raise ValueError(f"{META} names a picture outside its folder: {name!r}")
    return (folder / name).read_bytes()


def _in_archive(archive: zipfile.ZipFile, name: str) -> bytes:
    """The content of an entry, which may say that it is smaller than it is."""
    entry = archive.getinfo(name)
    most = MOST_JSON_BYTES if name == META else MOST_PICTURE_BYTES
    with archive.open(entry) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"{name} must have at most {most} bytes unpacked, but has more")
    return content


def _gaussians(meta: Any, read: Callable[[str], bytes], packed_bytes: int) -> Gaussians:
    version = fields(meta, META).get("version", 1)
    if version not in (1, 2):
        raise ValueError(f"it is SOG version {shown(version)}, this program reads 1 and 2")
    parts = {name: fields(field(meta, name, META), name) for name in ("means", "scales", "quats", "sh0")}
    said = meta["count"] if "count" in meta else items(field(parts["means"], "shape", "means"), "shape", most=4)[:1]
    count = whole(said[0] if isinstance(said, list) and said else said, "its count", most=MOST_GAUSSIANS)
    check_unpacked(4 * PICTURES * count, packed_bytes, "it")

    def texels(name: str) -> np.ndarray:
        return _texels(name, read(name), count)

    base = texels(_files(parts["sh0"], "sh0", 1)[0])  # [n, 4]
    dc = _values(parts["sh0"], "sh0", base[:, :3], slice(0, 3))[:, None]
    opacity = logits_of_alpha(base[:, 3])
    if "codebook" not in parts["sh0"]:  # version 1 keeps the logit, on a range of its own
        opacity = _values(parts["sh0"], "sh0", base[:, 3], 3).astype(np.float32)
    sh = dc if "shN" not in meta else np.concatenate([dc, _bands(fields(meta["shN"], "shN"), texels, read)], axis=1)
    scales = texels(_files(parts["scales"], "scales", 1)[0])[:, :3]
    return Gaussians(
        _positions(parts["means"], texels),
        _values(parts["scales"], "scales", scales, slice(0, 3)).astype(np.float32),
        _rotations(texels(_files(parts["quats"], "quats", 1)[0])),
        opacity,
        sh.astype(np.float32),
    )


def _files(meta: Mapping[str, Any], what: str, count: int) -> list[str]:
    """The first `count` names of pictures of a part."""
    names = items(field(meta, "files", what), f"{what}: files", most=8)
    if len(names) < count:
        raise ValueError(f"{what}: files must name {count} pictures, but names {len(names)}")
    return [words(name, f"{what}: files") for name in names[:count]]


def _check_size(name: str, content: bytes, most: int) -> None:
    """Raises ValueError for a WebP picture of more texels, before it is decoded."""
    match content[12:16]:
        case b"VP8L":
            bits = int.from_bytes(content[21:25], "little")
            width, height = (bits & 16383) + 1, (bits >> 14 & 16383) + 1
        case b"VP8X":
            width, height = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (24, 27))
        case b"VP8 ":
            width, height = (int.from_bytes(content[at : at + 2], "little") & 16383 for at in (26, 28))
        case _:
            raise ValueError(f"{name} is no 8-bit colour picture of WebP")
    if width * height > most:
        raise ValueError(f"{name} must have at most {most} texels, but has {width} x {height}")


def _picture(name: str, content: bytes, most: int) -> np.ndarray:
    """uint8 [height, width, 4], r g b a."""
    _check_size(name, content, most)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 3 or picture.dtype != np.uint8 or picture.shape[0] * picture.shape[1] > most:
        raise ValueError(f"{name} is no 8-bit colour picture")
    return cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA if picture.shape[2] == 4 else cv2.COLOR_BGR2RGBA)


def _texels(name: str, content: bytes, count: int) -> np.ndarray:
    """The first `count` texels, row by row, uint8 [count, 4]."""
    texels = _picture(name, content, 2 * count + SLACK).reshape(-1, 4)
    if len(texels) < count:
        raise ValueError(f"{name} has {len(texels)} texels for {count} Gaussians")
    return texels[:count]


def _values(meta: Mapping[str, Any], what: str, codes: np.ndarray, columns: slice | int) -> np.ndarray:
    """Entries of the codebook, or shares of the range of the columns, float64."""
    if "codebook" in meta:
        return _entries(meta, what, codes)
    low, high = (_range(meta, what, end, 3 if isinstance(columns, slice) else 4)[columns] for end in ("mins", "maxs"))
    values: np.ndarray = low + codes / 255 * (high - low)
    return values


def _range(meta: Mapping[str, Any], what: str, end: str, count: int) -> np.ndarray:
    """One end of at least so many ranges, float64."""
    listed = items(field(meta, end, what), f"{what}: {end}", most=4)
    return numbers(listed, f"{what}: {end}", (max(count, len(listed)),))


def _entries(meta: Mapping[str, Any], what: str, codes: np.ndarray) -> np.ndarray:
    book = items(meta["codebook"], f"{what}: codebook", most=256)
    if codes.max(initial=0) >= len(book):
        raise ValueError(f"{what}: its pictures point at entry {codes.max()} of a codebook of {len(book)}")
    entries: np.ndarray = numbers(book, f"{what}: codebook", (len(book),))[codes]
    return entries


def _positions(meta: Mapping[str, Any], texels: _Pictures) -> np.ndarray:
    """float32 [n, 3]."""
    lower, upper = (texels(name)[:, :3].astype(np.float64) for name in _files(meta, "means", 2))
    low, high = (_range(meta, "means", end, 3)[:3] for end in ("mins", "maxs"))
    if max(np.abs(low).max(), np.abs(high).max()) > MOST_LOG:
        raise ValueError(f"means: mins and maxs are logarithms up to {MOST_LOG}, but are {low} and {high}")
    t = low + (upper * 256 + lower) / 65535 * (high - low)
    positions: np.ndarray = (np.sign(t) * np.expm1(np.abs(t))).astype(np.float32)
    return positions


def _rotations(texels: np.ndarray) -> np.ndarray:
    """w x y z, float32 [n, 4]: alpha is 252 plus the component that was dropped."""
    if (texels[:, 3] < 252).any():
        raise ValueError("a rotation must name its largest component as 252 to 255 in alpha; was it saved lossily?")
    return restore_largest(texels[:, 3].astype(np.int64) - 252, (texels[:, :3] / 255 - 0.5) * math.sqrt(2))


def _bands(meta: Mapping[str, Any], texels: _Pictures, read: Callable[[str], bytes]) -> np.ndarray:
    """SH bands above 0, float64 [n, coefficients, 3]."""
    centroids, labels = _files(meta, "shN", 2)
    picture = _picture(centroids, read(centroids), MOST_PALETTE)[:, :, :3]
    bands = whole(meta["bands"], "shN: bands", most=3) if "bands" in meta else None
    coefficients = picture.shape[1] // PALETTE_ROW if bands is None else bands * (bands + 2)
    if coefficients not in (3, 8, 15) or picture.shape[1] < PALETTE_ROW * coefficients:
        raise ValueError(f"{centroids} is {picture.shape[1]} texels wide, too narrow for {coefficients} coefficients")
    palette = picture[:, : PALETTE_ROW * coefficients].reshape(-1, coefficients, 3)
    label = texels(labels)[:, :2].astype(np.int64) @ (1, 256)
    if label.max(initial=0) >= len(palette):
        raise ValueError(f"{labels} points at palette entry {label.max()} of {len(palette)}")
    # Version 1 has one range for all coefficients.
    if "codebook" in meta:
        return _entries(meta, "shN", palette[label])
    low, high = (finite(field(meta, end, "shN"), f"shN: {end}") for end in ("mins", "maxs"))
    values: np.ndarray = low + palette[label] / 255 * (high - low)
    return values
