"""How long a run will take, from a cost model that finished runs on two cores were measured for.

Every cost is a product of what the capture and the settings are and a figure that was measured; docs/pareto.md states
the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipelines.options import SequenceOptions
from pipelines.request import STAGES
from sync.capture import Capture
from sync.probe import probe_video
from tasks.stages.plan import Plan

REFERENCE_CORES = 2
"""On which `SECONDS` were measured"""
CORES_EXPONENT = 0.8
"""Twice the cores, 2^0.8 times as fast; not measured beyond two"""
SPREAD = 0.8
"""An iteration costs (pixels x Gaussians)^SPREAD: 0.7 from 640x360 to 1280x720, 0.9 from there to 1920x1200"""
SEGMENT = 37.5
"""Frames of a segment, at default settings of keyframes"""
ROUNDS, LEAST = 170, 48
"""Iterations of a frame at a `settle` of 0.02, and at any, on average"""
SETTLE_EXPONENT = -0.75
"""From 170 at 0.02 to 48 at 0.1"""

SECONDS: Mapping[str, float] = {
    "starts": 0.15,
    "sync": 2.6e-4,
    "rig and points": 1.8,
    "light": 0.0106,
    "flow": 0.045,
    "background": 0.074,
    "shell": 3.55,
    "backdrop iterations": 3.2e-3,
    "keyframes": 1.1,
    "keyframe iterations": 1.25e-3,
    "frames": 0.1,
    "frame iterations": 8.3e-4,
    "previews": 2.2,
    "encode": 0.28,
    "verify": 0.21,
    "scores": 0.235,
}
"""Of one unit of each kind of work, see `work_of`: "basketball", 24 cameras of 640x360, 150 frames"""
STAGE_OF: Mapping[str, str] = {
    "starts": "sync",
    "sync": "sync",
    "rig and points": "calibrate",
    "light": "calibrate",
    "flow": "flow",
    **dict.fromkeys(
        ("background", "shell", "backdrop iterations", "keyframes", "keyframe iterations", "frames"), "fit"
    ),
    "frame iterations": "fit",
    "previews": "fit",
    "encode": "encode",
    "verify": "verify",
    "scores": "evaluate",
}
PER_SEGMENT = ("keyframes", "keyframe iterations", "frames", "frame iterations", "previews")
"""What segments that are fitted side by side share among them"""


@dataclass(frozen=True)
class Size:
    """What of a capture decides how long it takes."""

    frames: int
    fitted: tuple[tuple[int, int], ...]
    """Width and height of each fitted camera's pictures as filmed, pixels"""
    held_out: tuple[tuple[int, int], ...] = ()
    """Likewise, of those to score on"""

    def __post_init__(self) -> None:
        if self.frames < 1 or not self.fitted:
            raise ValueError(f"a run needs frames and cameras, but has {self.frames} and {len(self.fitted)}")


@dataclass(frozen=True)
class Machine:
    """What a run may keep busy."""

    cores: int = REFERENCE_CORES
    jobs: int = 1
    """Segments at once"""


def size_of(capture: Capture, plan: Plan) -> Size:
    """Of what a plan means to process; reads the videos' packets. Raises what `probe_video` raises."""
    videos = {name: probe_video(path) for name, path in capture.videos.items()}
    longest = max(video.frame_count for video in videos.values())
    frames = min(longest, plan.stop or longest) - plan.first
    if frames < 1:
        raise ValueError(f"the capture has {longest} instants, so none from {plan.first} on")
    sides = {name: (video.width, video.height) for name, video in videos.items()}
    return Size(frames, tuple(sides[name] for name in plan.fitted), tuple(sides[name] for name in plan.held_out))


def work_of(size: Size, options: SequenceOptions) -> dict[str, float]:
    """How much there is to do of each kind of work. Mpx: million pixels of one instant, all cameras together."""
    fit, frames = options.fit, size.frames
    filmed = sum(width * height for width, height in size.fitted + size.held_out) / 1e6
    fitted = sum(_pixels(*sides, options) for sides in size.fitted) / 1e6
    scored = sum(_pixels(*sides, options) for sides in size.held_out or size.fitted[:3]) / 1e6
    one, gaussians = max(_pixels(*sides, options) for sides in size.fitted) / 1e6, fit.density.cap / 1e3
    segments = max(1.0, frames / SEGMENT)
    step = (one * gaussians) ** SPREAD
    return {
        "starts": 11 + 2 * segments,
        "sync": frames * (len(size.fitted) + len(size.held_out)),
        "rig and points": filmed,
        "light": frames * filmed * options.light.enabled,
        "flow": frames * fitted,
        "background": fit.background.instants * fitted,
        "shell": fitted * fit.shell.enabled,
        "backdrop iterations": fit.iterations * step * fit.backdrop_share**SPREAD,
        "keyframes": segments * fitted,
        "keyframe iterations": segments * fit.key_iterations * step,
        "frames": frames * fitted,
        "frame iterations": frames * expected_iterations(options) * step,
        "previews": segments * scored,
        "encode": frames * gaussians / 1e3,
        "verify": frames * gaussians / 1e3,
        "scores": frames * scored,
    }


def forecast_minutes(size: Size, options: SequenceOptions, machine: Machine, stop_after: str = STAGES[-1]) -> float:
    """Minutes that a run up to this stage takes that finds nothing there, on a machine as fast as the measured one."""
    wanted = STAGES[: STAGES.index(stop_after) + 1]
    seconds = (
        SECONDS[kind] * work / _speed(kind, size, machine)
        for kind, work in work_of(size, options).items()
        if STAGE_OF[kind] in wanted
    )
    return sum(seconds) / 60


def pilot_minutes(size: Size, options: SequenceOptions, machine: Machine, frames: int) -> float:
    """Minutes of a pilot of so many frames: all before the fits, the backdrop, a keyframe and its frames, scored."""
    first = Size(frames, size.fitted, size.held_out)
    whole, short = work_of(size, options), work_of(first, options)
    few = (*PER_SEGMENT, "encode", "scores")
    work = {kind: short[kind] if kind in few else whole[kind] for kind in whole if kind not in ("verify", "previews")}
    return sum(SECONDS[kind] * value / _speed(kind, first, machine) for kind, value in work.items()) / 60


def expected_iterations(options: SequenceOptions) -> float:
    """Of a frame, on average: until it settles, or all that it has."""
    most, settle = options.fit.frame_iterations, options.fit.settle
    return most if settle <= 0 else min(most, max(LEAST, ROUNDS * (settle / 0.02) ** SETTLE_EXPONENT))


def _pixels(width: int, height: int, options: SequenceOptions) -> float:
    most = options.pictures.max_width
    return width * height if most is None or width <= most else most * most * height / width


def _speed(kind: str, size: Size, machine: Machine) -> float:
    """Of the machine, in that of the measured one. Never more segments at once than there are."""
    threads = max(1, machine.cores // machine.jobs)
    at_once = min(machine.jobs, machine.cores, max(1.0, size.frames / SEGMENT)) if kind in PER_SEGMENT else 1.0
    speed: float = at_once * (threads / REFERENCE_CORES) ** CORES_EXPONENT
    return speed
