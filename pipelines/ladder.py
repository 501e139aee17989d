"""Points of the curve of run time against error, from fast to fine; the presets are among them.

docs/pareto.md has what each was measured to cost and to reach. Light to import.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipelines.request import PRESETS


def _point(
    max_width: int | None,
    iterations: tuple[int, int, int],
    settle: float,
    gaussians: tuple[int, int],
    sh_degree: int = 0,
) -> Mapping[str, Any]:
    """Settings of a point, all that points differ in, so that they hold over any other point.

    Args:
        iterations: of the backdrop, of a keyframe, and of a frame at most.
        gaussians: at the start of the backdrop's fit, and in all at most.
    """
    first, key, frame = iterations
    start, cap = gaussians
    return {
        "pictures": {"max_width": max_width},
        "fit": {
            "iterations": first,
            "key_iterations": key,
            "frame_iterations": frame,
            "settle": settle,
            "sh_degree": sh_degree,
            "start": {"count": start},
            "density": {"cap": cap},
        },
    }


LADDER: Mapping[str, Mapping[str, Any]] = {
    "sketch": _point(640, (450, 200, 48), 0.2, (28_000, 40_000)),
    "draft": _point(640, (900, 400, 144), 0.1, (42_000, 60_000)),
    "medium": _point(960, (1800, 700, 288), 0.04, (45_000, 64_000)),
    "standard": _point(1280, (3000, 1200, 480), 0.02, (48_000, 68_000)),
    "fine": _point(1920, (3000, 1200, 560), 0.014, (58_000, 84_000)),
    "high": _point(None, (3000, 1200, 640), 0.01, (70_000, 100_000), sh_degree=3),
}
"""Settings, as for `packuv run --set`, by name"""
assert tuple(name for name in LADDER if name in PRESETS) == PRESETS


def up_to(preset: str) -> tuple[str, ...]:
    """The points from the fastest to this one.

    >>> up_to("draft")
    ('sketch', 'draft')
    """
    names = tuple(LADDER)
    return names[: names.index(preset) + 1]
