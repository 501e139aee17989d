"""glTF 2.0 with KHR_gaussian_splatting (release candidate of July 2026): one frame as a binary .glb file.

Float attributes throughout: positions, unit quaternions x y z w, standard deviations, alpha, and SH coefficients as 3D
Gaussian Splatting has them. glTF has y up and z back: frames take half a turn about x, in the numbers, since viewers
do not agree on how SH turn with a node.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import whole_file
from packuv.gaussians.floats import Gaussians, opacity
from packuv.interchange.conventions import half_turn, is_drawn, rows_out, unit

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _POINTS, _VERTICES = 5126, 0, 34962
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf(path: Path, gaussians: Gaussians, *, keep_rows: bool = False) -> int:
    """Write a .glb file and return the number of drawn Gaussians in it; what is not drawn is left out, or has alpha 0.

    Raises ValueError for a frame without any, which glTF cannot hold.
    """
    mask = is_drawn(gaussians)
    kept = half_turn(rows_out(gaussians, mask, keep_rows=keep_rows))
    if not len(kept):
        raise ValueError(
            f"glTF holds no frame without Gaussians, but that of {path.name} has none; leave it out, or choose PLY"
        )
    columns = [(name, values.astype("<f4")) for name, values in _attributes(kept)]
    document, data = _document(columns), b"".join(values.tobytes() for _, values in columns)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0")
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(data)) + chunks)
        file.write(data)
    return int(mask.sum())


def _attributes(kept: Gaussians) -> Iterator[tuple[str, np.ndarray]]:
    yield "POSITION", kept.means
    yield f"{EXTENSION}:ROTATION", unit(kept.quaternions)[:, [1, 2, 3, 0]]
    yield f"{EXTENSION}:SCALE", np.exp(kept.log_scales)
    yield f"{EXTENSION}:OPACITY", opacity(kept)[:, None]
    for degree in range(kept.sh_degree + 1):
        for order in range(2 * degree + 1):
            yield f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}", kept.sh[:, degree**2 + order]


def _document(columns: list[tuple[str, np.ndarray]]) -> dict[str, Any]:
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    at = 0
    for number, (_, values) in enumerate(columns):
        views.append({"buffer": 0, "byteOffset": at, "byteLength": values.nbytes, "target": _VERTICES})
        accessors.append(
            {"bufferView": number, "componentType": _FLOAT, "count": len(values), "type": _KINDS[values.shape[1]]}
        )
        at += values.nbytes
    positions = columns[0][1]
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    primitive = {
        "mode": _POINTS,
        "attributes": {name: number for number, (name, _) in enumerate(columns)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return {
        "asset": {"version": "2.0", "generator": "packuv"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": at}],
    }
