"""Write PlayCanvas's SOG, version 2: an archive of lossless WebP pictures and meta.json, as `sog` reads it.

Log scales and colours get codebooks of 256 values each. SH bands above 0 get a palette: every Gaussian its own entry
where there are no more than the format holds, and shares one with its likes otherwise.
"""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from packuv.files import whole_file
from packuv.gaussians.floats import Gaussians
from packuv.interchange.compressed_ply import LOG_SCALE_LIMIT
from packuv.interchange.conventions import alpha_codes, drop_largest, is_drawn, rows_out
from packuv.interchange.sog import META, PALETTE_ROW

BOOK = 256
ROUNDS = 12
"""Of moving the values of a codebook to the mean of what they stand for"""
MOST_ENTRIES = 1 << 16
"""Of a palette"""
_STAMP = (1980, 1, 1, 0, 0, 0)
"""Of all entries of the archive: same scene, same bytes"""


def write_sog(path: Path, gaussians: Gaussians, *, antialiased: bool = False, keep_rows: bool = False) -> int:
    """Write a .sog archive and return the number of drawn Gaussians in it; axes and order of rows stay as they are.

    What is not drawn is left out, or has alpha 0 where rows are kept.
    """
    mask = is_drawn(gaussians)
    kept = rows_out(gaussians, mask, keep_rows=keep_rows)
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "packuv"}, "count": len(kept)}
    if antialiased:
        meta["antialias"] = True
    pictures: dict[str, bytes] = {}
    for name, part, texels in (_means(kept), _scales(kept), _quats(kept), _colours(kept)):
        meta[name] = {**part, "files": [f"{file}.webp" for file in texels]}
        pictures.update({f"{file}.webp": _webp(_picture(values)) for file, values in texels.items()})
    if kept.sh_degree and len(kept):
        meta["shN"], palette = _bands(kept)
        pictures.update(palette)
    with whole_file(path) as partial, zipfile.ZipFile(partial, "w") as archive:  # pictures are packed already
        for file, content in {META: json.dumps(meta).encode(), **pictures}.items():
            archive.writestr(zipfile.ZipInfo(file, _STAMP), content)
    return int(mask.sum())


_Part = tuple[str, dict[str, Any], dict[str, np.ndarray]]
"""Name in meta.json, what is said there, and texels uint8 [n, 3 or 4] by picture"""


def _means(kept: Gaussians) -> _Part:
    """16 bits an axis, on the range of the symmetric logarithm, in two pictures."""
    means = kept.means.astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (end(logs, axis=0, initial=edge) for end, edge in ((np.min, np.inf), (np.max, -np.inf)))
    if not len(logs):
        low = high = np.zeros(3)
    codes = np.rint((logs - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.int64)
    halves = {"means_l": (codes & 255).astype(np.uint8), "means_u": (codes >> 8).astype(np.uint8)}
    return "means", {"mins": low.tolist(), "maxs": high.tolist()}, halves


def _scales(kept: Gaussians) -> _Part:
    book, codes = _codebook(np.clip(kept.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT))
    return "scales", {"codebook": book}, {"scales": codes}


def _quats(kept: Gaussians) -> _Part:
    """Three components over the square root of 2 in 8 bits; alpha is 252 plus the one that was dropped, w x y z."""
    largest, others = drop_largest(kept.quaternions)
    shares = np.clip(np.rint((others / math.sqrt(2) + 0.5) * 255), 0, 255)
    return "quats", {}, {"quats": np.column_stack([shares, 252 + largest]).astype(np.uint8)}


def _colours(kept: Gaussians) -> _Part:
    book, codes = _codebook(kept.sh[:, 0])
    return "sh0", {"codebook": book}, {"sh0": np.column_stack([codes, alpha_codes(kept.opacity_logits)])}


def _bands(kept: Gaussians) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What meta.json says of SH above band 0, and its two pictures."""
    sh = kept.sh[:, 1:].reshape(len(kept), -1)  # [n, 3 coefficients]
    labels = _groups(sh, MOST_ENTRIES)
    count = int(labels.max()) + 1
    sizes = np.bincount(labels, minlength=count)
    palette = np.stack([np.bincount(labels, column, count) / sizes for column in sh.T], axis=1)
    book, codes = _codebook(palette)
    coefficients = kept.sh.shape[1] - 1
    rows = np.zeros((-(-count // PALETTE_ROW) * PALETTE_ROW, coefficients, 3), np.uint8)
    rows[:count] = codes.reshape(count, coefficients, 3)
    names = ["shN_centroids.webp", "shN_labels.webp"]
    picture = rows.reshape(-1, PALETTE_ROW * coefficients, 3)
    label = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)]).astype(np.uint8)
    said = {"count": count, "bands": kept.sh_degree, "codebook": book, "files": names}
    return said, dict(zip(names, (_webp(_opaque(picture)), _webp(_picture(label))), strict=True))


def _groups(rows: np.ndarray, most: int) -> np.ndarray:
    """Number of the group of each row [n, k], int64 [n]: equal rows have the same one, and likes where they are many.

    Groups are halved at the median along their widest column until there are as many as may be.
    """
    distinct, labels = np.unique(rows, axis=0, return_inverse=True)
    labels = labels.reshape(-1)
    if len(distinct) <= most:
        return labels
    leaves = [np.arange(len(distinct))]
    while 2 * len(leaves) <= most:
        leaves = [half for leaf in leaves for half in _halves(distinct, leaf) if len(half)]
    of_distinct = np.empty(len(distinct), np.int64)
    for number, leaf in enumerate(leaves):
        of_distinct[leaf] = number
    return of_distinct[labels]


def _halves(rows: np.ndarray, leaf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    widest = np.ptp(rows[leaf], axis=0).argmax()
    order = leaf[np.argsort(rows[leaf, widest], kind="stable")]
    return order[: len(order) // 2], order[len(order) // 2 :]


def _codebook(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """256 rising values, and the number of the nearest for each of `values`, uint8 of their shape.

    They begin half by quantiles and half evenly, so that the few values far out are met as well as the many.
    """
    flat = np.sort(values.astype(np.float64), axis=None)
    if not len(flat):
        return [0.0] * BOOK, np.zeros(values.shape, np.uint8)
    book = np.sort(
        np.concatenate([np.quantile(flat, np.linspace(0, 1, BOOK // 2)), np.linspace(flat[0], flat[-1], BOOK // 2)])
    )
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(flat, (book[1:] + book[:-1]) / 2), [len(flat)]])
        sizes = np.diff(ends)
        book = np.where(sizes > 0, np.diff(sums[ends]) / np.maximum(sizes, 1), book)
    book = np.sort(book.astype(np.float32).astype(np.float64))
    codes = np.searchsorted((book[1:] + book[:-1]) / 2, values.astype(np.float64)).astype(np.uint8)
    return book.tolist(), codes


def _picture(texels: np.ndarray) -> np.ndarray:
    """Texels [n, 3 or 4] row by row in a picture about square, uint8 [height, width, 4], the rest 0."""
    width = max(4, 4 * math.ceil(math.sqrt(len(texels)) / 4))
    height = max(1, -(-len(texels) // width))
    whole = np.zeros((height * width, texels.shape[1]), np.uint8)
    whole[: len(texels)] = texels
    picture = whole.reshape(height, width, -1)
    return picture if texels.shape[1] == 4 else _opaque(picture)


def _opaque(picture: np.ndarray) -> np.ndarray:
    return np.concatenate([picture, np.full((*picture.shape[:2], 1), 255, np.uint8)], axis=2)


def _webp(picture: np.ndarray) -> bytes:
    """Lossless; a quality above 100 means so."""
    done, content = cv2.imencode(".webp", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, 101])
    if not done:
        raise ValueError(f"a WebP picture holds at most 16,383 x 16,383 texels, but SOG needs {picture.shape[:2]}")
    return content.tobytes()
