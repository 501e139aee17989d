"""What a run will take: time, memory, disk and the size of its scene file.

Every cost is a product of what the capture and the settings are, a figure that finished runs were measured for, and
the pace that a probe finds on this machine; docs/pareto.md states the model and how far it was off.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from calibration.importers import holds_lenses_alone
from packuv.budget import USUAL_BYTES
from packuv.fit.gpu_memory import FitLoad, fit_memory
from packuv.fit.pace import FitSize
from packuv.motion.step import fitted_size
from packuv.progress import Progress, no_progress
from pipelines.disk import size_text
from pipelines.options import SequenceOptions
from pipelines.probe import CAMERAS, INSTANTS, REFERENCE, Look, Probe, look, remember, remembered, spread
from pipelines.request import STAGES
from sync.capture import Capture, find_lender, probe_capture
from tasks.artefacts.jobs import Jobs
from tasks.stages.evaluate import GLANCE_FRAMES
from tasks.stages.footage import PictureOptions
from tasks.stages.plan import Plan

REFERENCE_STEP = 0.0265
"""Seconds of an iteration at `probe.REFERENCE` when `SECONDS` were measured, on two cores"""
SPREAD = 0.8
"""An iteration costs (pixels x Gaussians)^SPREAD: 0.4 below 640x360, 0.7 from there to 1280x720, 0.9 to 1920x1200"""
USUAL_MOVING, USUAL_PICTURE = 0.18, 0.0615
"""Those of "basketball", for which `SECONDS` and `STEPS` hold: share of tiles that move, seconds a million pixels"""
SEGMENT = 37.5
"""Frames of a segment, at default settings of keyframes"""
ROUNDS, LEAST = 170, 48
"""Iterations of a frame at a `settle` of 0.02, and at any, on average"""
SETTLE_EXPONENT = -0.75
"""From 170 at 0.02 to 48 at 0.1"""

SECONDS: Mapping[str, float] = {
    "jobs": 0.8,
    "sync": 2.6e-4,
    "lender": 2.6e-4,
    "rig and points": 1.7,
    "features": 0.71,
    "pairs": 0.26,
    "placing": 0.5,
    "light": 0.0103,
    "flow": 0.0436,
    "background": 0.06,
    "shell": 3.5,
    "keyframes": 1.1,
    "frames": 0.04,
    "encode": 0.25,
    "verify": 0.15,
    "scores": 0.28,
}
"""Of one unit of each kind of work, see `work_of`, at the reference's pace"""
STEPS: Mapping[str, float] = {"backdrop iterations": 1.38, "keyframe iterations": 0.46, "frame iterations": 0.43}
"""What an iteration costs on average, in those of a probe. How much Gaussians overlap differs: a backdrop's cost 1.17
times as much in "basketball", 1.63 times in the demo"""
STAGE_OF: Mapping[str, str] = {
    "sync": "sync",
    **dict.fromkeys(("lender", "rig and points", "features", "pairs", "placing"), "calibrate"),
    "light": "calibrate",
    "flow": "flow",
    **dict.fromkeys(("background", "shell", "keyframes", "frames", *STEPS), "fit"),
    "encode": "encode",
    "verify": "verify",
    "scores": "evaluate",
}
FEATURES = 0.02
"""Of a pixel of a textured picture; plain walls have a quarter of that"""
REFERENCE_FEATURES = 4096
"""Of a picture, with which `SECONDS` of a pair were measured; it goes by their square"""
ALL_PAIRS, PARTNERS = 40, 12
"""Cameras up to which a solve matches all pairs, and with how many it matches each beyond that"""
JOBS: Mapping[str, int] = {"sync": 1, "calibrate": 3, "flow": 3, "fit": 2, "encode": 1, "verify": 1, "evaluate": 1}
"""Processes that a stage starts, those of segments aside"""
JOBS_PER_SEGMENT = 3
PER_SEGMENT = ("keyframes", "keyframe iterations", "frames", "frame iterations")
"""What segments that are fitted side by side share among them"""

TIME_WITHIN, SIZE_WITHIN = 1.25, 1.5
"""Factors either way that runs so far stayed within, see docs/pareto.md: time, memory and disk; and the scene file"""

BASE_BYTES = 310_000_000
"""Memory of a job that has loaded its libraries"""
PIXEL_BYTES = 175
"""Of each fitted pixel of an instant: pictures, masks, and the backdrop's layers before and behind what moves"""
DECODER_BYTES = 12
"""Of each pixel of an instant as filmed: an open decoder a camera"""
WORKING_BYTES = 400
"""Of each pixel of the picture that is in work"""
CODE_BYTES = 14
"""Of one Gaussian without view dependence: three 16-bit positions, eight of ten 8-bit columns after removing repeats"""
COPIES = 1
"""Of all codes in all frames: most repeat, but lie in checkpoints, segments and the scene file"""
ONCE_BYTES, FRAME_BYTES = 15.0, 3.4
"""Of a scene file: for each Gaussian once, and for each one in each frame where all tiles move"""


@dataclass(frozen=True)
class Size:
    """What of a capture decides how long it takes."""

    frames: int
    fitted: tuple[tuple[int, int], ...]
    """Width and height of each fitted camera's pictures as filmed, pixels"""
    held_out: tuple[tuple[int, int], ...] = ()
    """Likewise, of those to score on"""
    solved: bool = False
    """Whether nothing says where the cameras stand"""
    lenses: bool = False
    """Whether their lenses are known then"""
    lender: Size | None = None
    """Of the take whose rig this one uses, where that rig is still to be made"""

    def __post_init__(self) -> None:
        if self.frames < 1 or not self.fitted:
            raise ValueError(f"a run needs frames and cameras, but has {self.frames} and {len(self.fitted)}")


@dataclass(frozen=True)
class Guess(Probe):
    """Of who has not looked: the pace of the machine that the constants were measured on."""

    steps: Mapping[str, float] = field(default_factory=dict)
    moving: float | None = None
    picture_seconds: float | None = None

    def step(self, size: FitSize) -> float:
        """By a power of the work that lies between what was seen of small pictures and of large ones."""
        work = size.width * size.height * size.gaussians / (REFERENCE.width * REFERENCE.height * REFERENCE.gaussians)
        return REFERENCE_STEP * float(work**SPREAD)


@dataclass(frozen=True)
class Machine:
    """What does the work."""

    probe: Probe
    """Of a job with its share of the cores"""
    jobs: int = 1
    """Segments at once"""
    memory_bytes: int = USUAL_BYTES
    """That a job may fill with pictures and layers"""

    @property
    def pace(self) -> float:
        """Seconds here for one where the constants were measured."""
        return self.probe.step(REFERENCE) / REFERENCE_STEP


@dataclass(frozen=True)
class Forecast:
    """What a run takes that finds nothing there."""

    seconds: Mapping[str, float]
    """By stage, see `pipelines.request.STAGES`"""
    memory_bytes: float
    """Of the largest job"""
    gpu_bytes: float
    """Of the largest fit, where a GPU does it"""
    disk_bytes: float
    """Of the store"""
    scene_bytes: float
    """Of the scene file; 0 where the run ends before it is written"""
    frames: int

    @property
    def minutes(self) -> float:
        return sum(self.seconds.values()) / 60

    @property
    def mb_per_frame(self) -> float:
        """Of the scene file."""
        return self.scene_bytes / self.frames / 1e6

    @property
    def told(self) -> str:
        """For people, in one line."""
        scene = f", a scene of {size_text(self.scene_bytes)}" if self.scene_bytes else ""
        return (
            f"{minutes_text(self.minutes / TIME_WITHIN)} to {minutes_text(self.minutes * TIME_WITHIN)}, "
            f"{size_text(self.memory_bytes)} of memory, {size_text(self.disk_bytes)} on disk{scene}"
        )


def minutes_text(minutes: float) -> str:
    """For people, as exact as a forecast is.

    >>> minutes_text(0.4), minutes_text(7.26), minutes_text(190)
    ('24 s', '7.3 min', '3.2 h')
    """
    if minutes < 1:
        return f"{60 * minutes:.0f} s"
    return f"{minutes:.1f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def size_of(capture: Capture, plan: Plan) -> Size:
    """Of what a plan means to process; reads the videos' packets. Raises what `probe_video` raises."""
    videos = probe_capture(capture, listen=False)
    told = {name: (video.width, video.height, video.frame_count) for name, video in videos.items()}
    return with_rig(size_told(told, plan), capture)


def size_told(videos: Mapping[str, tuple[int, int, int]], plan: Plan) -> Size:
    """The same where width, height and number of frames of each video are known. Raises ValueError without frames."""
    longest = max(frames for _, _, frames in videos.values())
    frames = min(longest, plan.stop or longest) - plan.first
    if frames < 1:
        raise ValueError(f"the capture has {longest} instants, so none from {plan.first} on")
    sides = {name: (width, height) for name, (width, height, _) in videos.items()}
    return Size(frames, tuple(sides[name] for name in plan.fitted), tuple(sides[name] for name in plan.held_out))


def with_rig(size: Size, capture: Capture) -> Size:
    """With what is known of where the cameras stand, also of the take whose rig this one uses. Raises ValueError for a
    calibration/ that holds none, and what `find_lender` raises."""
    given = (find_lender(capture) or capture).calibration
    lenses = given is not None and holds_lenses_alone(given)
    return replace(size, solved=given is None or lenses, lenses=lenses)


def fit_size(size: Size, options: SequenceOptions) -> FitSize:
    """What a probe has to time: the largest fitted picture, and the Gaussians of a backdrop half grown."""
    width, height = max(
        (_fitted(*sides, options.pictures) for sides in size.fitted), key=lambda side: side[0] * side[1]
    )
    room = options.fit.backdrop_share * options.fit.density.cap
    return FitSize(width, height, round((min(options.fit.start.count, room) + room) / 2))


def question_of(plan: Plan, size: Size, points: Sequence[SequenceOptions]) -> Look:
    """What to look at before any of these settings is forecast."""
    videos = [plan.videos[name] for name in plan.fitted]
    return Look(
        tuple(fit_size(size, options) for options in points),
        tuple(videos[index] for index in spread(len(videos), CAMERAS)),
        # An instant is hardly ever the frame of its number; to see how much moves it need not be.
        tuple(plan.first + index for index in spread(max(1, size.frames - 1), INSTANTS)),
        points[-1].motion,
    )


def machine_of(
    folder: Path,
    question: Look,
    jobs: Jobs,
    at_once: int,
    *,
    afresh: bool = False,
    progress: Progress = no_progress,
) -> Machine:
    """This machine, as a probe finds it, or as the last one for the same question found it. `folder` is the sequence's,
    or is not there, and then nothing is remembered. Raises what `Jobs.run` raises."""
    found = None if afresh else remembered(folder, question, jobs)
    if found is None:
        found = look(question, jobs, progress)
        if folder.is_dir():
            remember(folder, question, jobs, found)
    return Machine(found, at_once, jobs.memory_bytes)


def work_of(size: Size, options: SequenceOptions, probe: Probe) -> dict[str, float]:
    """How much there is to do of each kind of work. Mpx: million pixels of one instant, all cameras together."""
    picture = 1.0 if probe.picture_seconds is None else probe.picture_seconds / USUAL_PICTURE
    active = _tile_cost(_moving(probe)) / _tile_cost(USUAL_MOVING)
    fit, frames = options.fit, size.frames
    filmed = sum(width * height for width, height in size.fitted + size.held_out) / 1e6
    fitted, scored = (_mpx(sides, options) for sides in (size.fitted, size.held_out or size.fitted[:3]))
    beside = _mpx(size.fitted[: options.evaluate.fitted_cameras], options) if size.held_out else 0.0
    gaussians, segments = fit.density.cap / 1e6, _segments(size)
    lent = size.lender
    return {
        "sync": _pictures(size),
        "lender": _pictures(lent) if lent else 0,
        "rig and points": filmed + (sum(width * height for width, height in lent.fitted) / 1e6 if lent else 0),
        **_solving(lent or size, options),
        "light": frames * filmed * options.light.enabled,
        "flow": frames * fitted * picture,
        "background": fit.background.instants * fitted,
        "shell": fitted * fit.shell.enabled,
        "backdrop iterations": fit.iterations,
        "keyframes": segments * fitted,
        "keyframe iterations": segments * fit.key_iterations * active,
        "frames": frames * fitted,
        "frame iterations": frames * expected_iterations(options) * active,
        "encode": frames * gaussians,
        "verify": frames * gaussians,
        "scores": frames * scored + min(frames, GLANCE_FRAMES) * beside,
    }


def _pictures(size: Size) -> int:
    return size.frames * (len(size.fitted) + len(size.held_out))


def _solving(size: Size, options: SequenceOptions) -> dict[str, float]:
    """Of a solve, as far as its first attempt."""
    return _attempt(size, options, attempts(size, options)[0])


def _attempt(size: Size, options: SequenceOptions, instants: int) -> dict[str, float]:
    """Of a solve from so many: Mpx, pairs of pictures with `REFERENCE_FEATURES` each, and cameras to place."""
    sides, most = size.fitted + size.held_out, options.rig.solve.features.max_features
    pixels, count = sum(width * height for width, height in sides) * size.solved, len(sides) * size.solved
    features = min(most, FEATURES * pixels / max(1, count))
    pairs = count * (count - 1) / 2 if count <= ALL_PAIRS else count * PARTNERS
    return {
        "features": instants * pixels / 1e6,
        "pairs": instants * pairs * (features / REFERENCE_FEATURES) ** 2,
        "placing": count,
    }


def attempts(size: Size, options: SequenceOptions) -> tuple[int, int]:
    """Instants that a solve looks at, and those that it tries where they do not place all cameras."""
    several = min(options.rig.more_instants, size.frames)
    return (several, 1) if size.lenses else (1, several)


def again_seconds(size: Size, options: SequenceOptions, machine: Machine) -> float:
    """What a solve takes on top where its first attempt does not place all cameras."""
    work = _attempt(size, options, attempts(size, options)[1])
    return machine.pace * sum(SECONDS[kind] * work[kind] for kind in work)


def forecast(size: Size, options: SequenceOptions, machine: Machine, stop_after: str = STAGES[-1]) -> Forecast:
    """What a run up to this stage takes. Raises KeyError unless the probe timed `fit_size`."""
    wanted = STAGES[: STAGES.index(stop_after) + 1]
    seconds = {stage: _starting(stage, size, machine) for stage in wanted if stage in JOBS}
    for kind, cost in _costs(size, options, machine).items():
        if STAGE_OF[kind] in wanted:
            seconds[STAGE_OF[kind]] += cost
    return Forecast(
        seconds,
        memory_of(size, options, machine.memory_bytes),
        gpu_memory_of(size, options, machine.memory_bytes) if "fit" in wanted else 0,
        store_bytes(size, options) if "flow" in wanted else 0,
        scene_bytes(size, options, _moving(machine.probe)) if "encode" in wanted else 0,
        size.frames,
    )


def pilot_minutes(size: Size, options: SequenceOptions, machine: Machine, frames: int) -> float:
    """Minutes of a pilot of so many frames: all before the fits, the backdrop, a keyframe and its frames, scored."""
    first = replace(size, frames=frames)
    whole, short = (_costs(one, options, machine) for one in (size, first))
    few = (*PER_SEGMENT, "encode", "scores")
    starting = sum(_starting(stage, first, machine) for stage in JOBS if stage != "verify")
    return (starting + sum(short[kind] if kind in few else whole[kind] for kind in whole if kind != "verify")) / 60


def memory_of(size: Size, options: SequenceOptions, most: int) -> float:
    """Bytes of the largest job; `most`: that it may fill with pictures and layers."""
    held = min(PIXEL_BYTES * 1e6 * _mpx(size.fitted, options), most)
    filmed = sum(width * height for width, height in size.fitted)
    largest = max(_mpx([shape], options) for shape in size.fitted)
    return BASE_BYTES + held + DECODER_BYTES * filmed + WORKING_BYTES * 1e6 * largest


def gpu_memory_of(size: Size, options: SequenceOptions, most: int) -> float:
    """Bytes that the largest fit takes of a GPU, with its layers as far as `most` goes; see `packuv.fit.gpu_memory`."""
    fit, sides = options.fit, [_fitted(*side, options.pictures) for side in size.fitted]
    cap = fit.density.cap
    still = round(fit.backdrop_share * cap) if fit.background.instants else 0
    first = FitLoad(sides, still or cap, sh_degree=fit.sh_degree, depths=fit.shell.places)
    then = FitLoad(sides, cap - still + fit.spare, still, fit.sh_degree, instants=2)
    return max(fit_memory(load, budget_bytes=most).all_bytes for load in (first, then))


def store_bytes(size: Size, options: SequenceOptions) -> float:
    """That the flow cache and the fit take on disk."""
    pictures = sum(_motion_bytes(width, height, options) for width, height in size.fitted)
    columns = CODE_BYTES + 3 * ((options.fit.sh_degree + 1) ** 2 - 1)
    return size.frames * (pictures + COPIES * columns * options.fit.density.cap)


def scene_bytes(size: Size, options: SequenceOptions, moving: float) -> float:
    """Of the scene file."""
    more = 1 + 3 * ((options.fit.sh_degree + 1) ** 2 - 1) / CODE_BYTES
    return options.fit.density.cap * more * (ONCE_BYTES + FRAME_BYTES * moving * size.frames)


def expected_iterations(options: SequenceOptions) -> float:
    """Of a frame, on average: until it settles, or all that it has."""
    most, settle = options.fit.frame_iterations, options.fit.settle
    return most if settle <= 0 else min(most, max(LEAST, ROUNDS * (settle / 0.02) ** SETTLE_EXPONENT))


def _costs(size: Size, options: SequenceOptions, machine: Machine) -> dict[str, float]:
    """Seconds of each kind of work. Never more segments at once than there are."""
    step, at_once = machine.probe.step(fit_size(size, options)), min(machine.jobs, _segments(size))
    looked = machine.probe.picture_seconds is not None  # which tells the pace of decoding and motion itself
    each = {kind: seconds * (1 if kind == "flow" and looked else machine.pace) for kind, seconds in SECONDS.items()}
    each |= {kind: share * step for kind, share in STEPS.items()}
    work = work_of(size, options, machine.probe)
    return {kind: each[kind] * work[kind] / (at_once if kind in PER_SEGMENT else 1) for kind in work}


def _starting(stage: str, size: Size, machine: Machine) -> float:
    """Seconds in which the processes of a stage load their libraries."""
    started = JOBS[stage] + (JOBS_PER_SEGMENT * _segments(size) if stage == "fit" else 0)
    return started * SECONDS["jobs"] * machine.pace


def _segments(size: Size) -> float:
    return max(1.0, size.frames / SEGMENT)


def _moving(probe: Probe) -> float:
    return USUAL_MOVING if probe.moving is None else probe.moving


def _tile_cost(moving: float) -> float:
    """Of an iteration in which this share of the tiles moves, in iterations on whole pictures."""
    return 0.07 + 0.93 * moving


def _mpx(sides: Iterable[tuple[int, int]], options: SequenceOptions) -> float:
    fitted = (_fitted(width, height, options.pictures) for width, height in sides)
    return sum(width * height for width, height in fitted) / 1e6


def _motion_bytes(width: int, height: int, options: SequenceOptions) -> int:
    """Of one picture: flow as two float16 per pixel, the mask as bits."""
    width, height = _fitted(width, height, options.pictures)
    flow = fitted_size(width, height, min(options.motion.flow_width, options.motion.width))
    mask = fitted_size(width, height, options.motion.width)
    return (4 * flow[0] * flow[1] if options.motion.keep_flow else 0) + mask[0] * mask[1] // 8


def _fitted(width: int, height: int, options: PictureOptions) -> tuple[int, int]:
    if options.max_width is None or width <= options.max_width:
        return width, height
    return options.max_width, round(height * options.max_width / width)
