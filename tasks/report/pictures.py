"""Truth, render and difference as the page shows them: JPEG within the page, no wider than it needs."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tasks.report.facts import Comparison, FrameScore

PICTURE_WIDTH = 640
"""Wider pictures are scaled down for the page, px"""
JPEG_QUALITY = 88
DIFFERENCE_GAIN = 4
"""Absolute differences are shown this many times brighter"""


def comparison(item: Comparison, scores: Mapping[tuple[str, int], FrameScore]) -> dict[str, Any]:
    """One view of the scene beside what was filmed, with its score where there is one."""
    truth, render = _shown(item.truth), _shown(item.render)
    if truth.shape != render.shape:
        raise ValueError(
            f"truth and render of {item.camera}, frame {item.frame}, must have one size, but have "
            f"{truth.shape[1]}x{truth.shape[0]} and {render.shape[1]}x{render.shape[0]}"
        )
    difference = np.clip(np.abs(truth.astype(np.int16) - render) * DIFFERENCE_GAIN, 0, 255).astype(np.uint8)
    named = {"truth": truth, "render": render, f"difference × {DIFFERENCE_GAIN}": difference}
    return {
        "camera": item.camera,
        "frame": item.frame,
        "choice": item.choice,
        "score": scores.get((item.camera, item.frame)),
        "pictures": [_picture(name, pixels) for name, pixels in named.items()],
    }


def _picture(name: str, pixels: np.ndarray) -> dict[str, Any]:
    return {"name": name, "url": _data_url(pixels), "width": pixels.shape[1], "height": pixels.shape[0]}


def _shown(picture: Path | np.ndarray) -> np.ndarray:
    """The picture as uint8 [H, W, 3] RGB, no wider than the page needs."""
    pixels = _read(picture) if isinstance(picture, Path) else picture
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"a picture must be uint8 [H, W, 3], but is {pixels.dtype} {pixels.shape}")
    height, width = pixels.shape[:2]
    if width <= PICTURE_WIDTH:
        return pixels
    size = (PICTURE_WIDTH, max(1, round(height * PICTURE_WIDTH / width)))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _read(path: Path) -> np.ndarray:
    if not path.is_file():
        raise FileNotFoundError(f"the report needs the picture {path}, which is not there")
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError(f"{path} cannot be read as a picture")
    return pixels[..., ::-1]


def _data_url(pixels: np.ndarray) -> str:
    good, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not good:
        raise ValueError(f"a picture of {pixels.shape} cannot be written as JPEG")
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"
