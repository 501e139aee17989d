"""PackUV: Gaussians in a multi-scale UV atlas, fitted from many cameras, coded as lossless video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from packuv.scene import Scene


def open(path: str | Path, *, threads: int = 0) -> Scene:
    """Open a scene file: frames by number or time, as integers or as float32 arrays.

    Use it in a `with` statement. Raises what `packuv.scene.reader.open_scene` raises.
    """
    from packuv.scene import open_scene  # here, so that the package's other parts load without a video library

    return open_scene(Path(path), threads=threads)
