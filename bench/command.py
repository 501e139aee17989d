"""`packuv bench NAME`: measure this machine, or a fitted scene on it.

`pipelines` finds this command by its entry point in pyproject.toml, so nothing below knows of the benchmarks.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.plugins import Add

if TYPE_CHECKING:
    from packuv.scene import Scene

BENCHMARKS = (
    "ablation",
    "codec",
    "compression",
    "content",
    "doubts",
    "forecast",
    "front_end",
    "gpu",
    "gpu_model",
    "kills",
    "long",
    "masks",
    "mishaps",
    "motion",
    "networks",
    "page",
    "pareto",
    "raster",
    "reading",
    "scaling",
    "sequence",
    "size",
    "skips",
    "stress_fit",
    "sync_index",
)


def register(add: Add) -> None:
    """The grammar of the command."""
    command = add("bench.command:run", "run one of the benchmarks")
    command.add_argument("name", choices=BENCHMARKS, metavar="NAME", help=", ".join(BENCHMARKS))
    command.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="the benchmark's own arguments, or -h")


def run(arguments: argparse.Namespace) -> int:
    """Run a benchmark as `python -m bench.NAME` does, with what follows its name."""
    importlib.import_module(f"bench.{arguments.name}").main(arguments.rest)
    return 0


def parser(name: str, text: str | None) -> argparse.ArgumentParser:
    """For the own arguments of a benchmark."""
    return argparse.ArgumentParser(
        prog=f"packuv bench {name}", description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )


@contextmanager
def lossless(path: Path) -> Iterator[Scene]:
    """A scene file to measure on. Raises ValueError for one that is lossy, and what `open_scene` raises."""
    from packuv.scene import open_scene

    with open_scene(path) as scene:
        if not scene.lossless:
            raise ValueError(f"{path} is lossy; measure on a lossless scene file")
        yield scene
