"""PackUV: Gaussians in a multi-scale UV atlas, fitted from many cameras, coded as lossless video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from packuv.scene import Scene

    __version__: str

__all__ = ["__version__", "open", "open_scene"]


def open_scene(path: str | Path, *, threads: int = 0) -> Scene:
    """Open a scene file: frames by number or time, as integers or as float32 arrays.

    Use it in a `with` statement. Raises what `packuv.scene.reader.open_scene` raises.
    """
    from packuv.scene import open_scene  # here, so that the package's other parts load without a video library

    return open_scene(Path(path), threads=threads)


open = open_scene


def __getattr__(name: str) -> str:
    """`__version__`, looked up when it is asked for, because that reads the metadata of what is installed."""
    if name == "__version__":
        return _version()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _version() -> str:
    """As installed; in a checkout that is not installed, as pyproject.toml says."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("packuv")
    except PackageNotFoundError:
        import tomllib

        project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
        return str(project["version"])
