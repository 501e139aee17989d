"""Evaluate: how close a scene's pictures are to what cameras filmed, above all those that were never fitted."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from packuv.bounds import MOST_NS, MOST_SIDE_PX, field, fields, whole
from packuv.each import spread
from packuv.files import save_json
from packuv.footage import LensCamera, Light, Silhouettes, Transfer, Views, laid_over
from packuv.footage.lens import unabridged
from packuv.footage.light import unpacked
from packuv.lpips import Lpips, lacking
from packuv.motion import MotionOptions, measure_motion
from packuv.motion.foreground import compare_masks
from packuv.progress import Progress
from packuv.scene import SceneHeader, open_scene
from packuv.scene.header import LENSES
from packuv.score import Likeness, Score, glance, score, segment_starts, summary, write_pictures, write_table
from sync.align import AlignOptions, FrameGroups, align
from sync.capture import find_capture, load_timecodes, probe_capture
from sync.clock import ClockMode
from sync.masks import find_masks
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.report.facts import FrameScore, frames_to_picture
from tasks.stages.encode import SCENE
from tasks.stages.footage import Footage, Take
from tasks.stages.masks import doubts
from tasks.stages.plan import Plan
from tasks.stages.synchronize import STARTS_NS, begun

METRICS, TABLE, PICTURES = "metrics.json", "metrics.arrow", "pictures"
FITTED = "fitted"
"""Of the metrics: what fitted cameras score beside unseen ones"""
SAME_NS = 200_000
"""By how much the times of one instant may differ: sound tells them to 0.1 ms, now as when the scene was made"""
GLANCE_FRAMES = 8
"""At which fitted cameras are scored beside unseen ones, spread over the scene"""


@dataclass(frozen=True)
class EvaluateOptions:
    """Which fitted cameras are scored, and whether LPIPS is measured."""

    fitted_cameras: int = 3
    """Fitted cameras to score, spread over the rig: where no camera is held out, at every frame; else beside those that
    are, at a few frames, which tells how much better a fit repeats what it saw"""
    lpips_weights: str | None = None
    """File of torchvision's AlexNet or VGG-16 weights, a state dict, to measure LPIPS with; nothing is downloaded"""

    def __post_init__(self) -> None:
        if self.fitted_cameras < 1:
            raise ValueError(f"evaluation needs at least one camera, but fitted_cameras is {self.fitted_cameras}")


@dataclass(frozen=True, kw_only=True)
class Evaluate(Stage):
    """Score every frame of the scene file on the cameras of a take, and the foreground where masks tell it:
    metrics.json, metrics.arrow, pictures/."""

    name, version = "evaluate", 5
    take: Take
    beside: tuple[str, ...] = ()
    """Fitted cameras to score at a few frames, beside unseen ones"""
    scene: Key
    backbone: Files | None = None
    """Digest of the file at `weights`; None where LPIPS is not measured"""
    weights: str = dataclasses.field(default="", compare=False)
    """Path of the backbone's weights"""
    no_lpips: str = dataclasses.field(default="", compare=False)
    """Why LPIPS is not measured"""
    device: str = dataclasses.field(default="cpu", compare=False)
    """Who draws: cpu or cuda"""

    def build(self, work: Work) -> Notes:
        footage, scene = Footage(self.take, work.site), work.path(self.scene) / SCENE
        fitted = Footage(replace(self.take, cameras=self.beside), work.site)
        views, silhouettes = footage.open_views(), footage.open_silhouettes()
        lpips = Lpips(Path(self.weights)) if self.backbone else None
        with open_scene(scene) as opened:
            scores = score(opened, views, work.progress, lpips=lpips, silhouettes=silhouettes,
                           workers=work.site.threads, scratch=work.scratch, device=self.device)  # fmt: skip
            write_table(work.out / TABLE, scores)
            write_pictures(work.out / PICTURES, opened, views, frames_to_picture(frame_scores(scores)))
            borders = segment_starts(opened)
            facts = summary(scores, frames=len(opened), size_bytes=scene.stat().st_size, borders=borders)
            if self.beside:
                few = spread(range(len(opened)), GLANCE_FRAMES)
                seen = glance(opened, fitted.open_views(), few, work.progress)
                facts[FITTED] = [asdict(likeness) for likeness in seen]
        save_json(work.out / METRICS, facts)
        notes = {name: facts[name] for name in ("cameras", "held_out", "mean")}
        return {**notes, "no_lpips": self.no_lpips} if self.no_lpips else notes

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        if "no_lpips" in notes:
            yield "LPIPS", notes["no_lpips"]


def scored_cameras(plan: Plan, options: EvaluateOptions) -> tuple[str, ...]:
    """Those that are held out; where none is, some of the fitted ones."""
    return plan.held_out or spread(plan.fitted, options.fitted_cameras)


def cameras_beside(plan: Plan, options: EvaluateOptions) -> tuple[str, ...]:
    """Fitted cameras that are scored beside those held out."""
    return spread(plan.fitted, options.fitted_cameras) if plan.held_out else ()


def fitted_scores(metrics: Mapping[str, Any]) -> tuple[FrameScore, ...]:
    """Scores of fitted cameras beside unseen ones, as the report shows them."""
    known = [Likeness(**item) for item in metrics.get(FITTED, ())]
    return tuple(
        FrameScore(item.camera, item.frame, _level(item.psnr_calibrated_db), item.ssim_calibrated) for item in known
    )


@dataclass(frozen=True)
class Matched:
    """A capture folder, and which pictures it has of the instants of a scene."""

    capture: Path
    cameras: tuple[str, ...]
    frames: np.ndarray
    """int [T, C], by the scene's frame and the camera"""


def evaluate_scene(
    scene: Path,
    capture: Path | Matched,
    cameras: Sequence[str] | None,
    options: EvaluateOptions,
    progress: Progress,
    *,
    device: str = "cpu",
) -> dict[str, Any]:
    """Score a scene file against a capture folder, without a store; the summary that `evaluate` writes. `device`, cpu
    or cuda, draws.

    The frames of a capture folder are matched again, see `match`. Raises ValueError for a camera that the scene does
    not know, or a capture that did not film the scene's instants; where weights for LPIPS are named, but it cannot be
    measured with them. Where masks do not fit what moves, they are not used, and `doubtful_masks` says why, by camera.
    """
    weights = Path(options.lpips_weights) if options.lpips_weights else None
    if weights and (why := lacking(weights)):
        raise ValueError(why)
    with open_scene(scene) as opened:
        header = opened.header
        lenses = _lenses(header)
        fitted = [name for name in lenses if name not in header.held_out]
        names = tuple(dict.fromkeys(cameras or header.held_out)) or spread(fitted, options.fitted_cameras)
        if unknown := [name for name in names if name not in lenses]:
            raise ValueError(f"the scene has no camera {', '.join(unknown)}; it has {', '.join(lenses) or 'none'}")
        matched = capture if isinstance(capture, Matched) else match(header, capture)
        views = filmed_views(header, matched, names)
        silhouettes, doubtful = _silhouettes(matched.capture, views)
        lpips = Lpips(weights) if weights else None
        scores = score(opened, views, progress, lpips=lpips, silhouettes=silhouettes, device=device)
        facts = summary(scores, frames=len(opened), size_bytes=scene.stat().st_size, borders=segment_starts(opened))
        return {**facts, "doubtful_masks": doubtful} if doubtful else facts


def known_cameras(header: SceneHeader) -> tuple[str, ...]:
    """Cameras whose pictures can be compared with a scene."""
    return tuple(_lenses(header))


def match(header: SceneHeader, capture: Path) -> Matched:
    """Match the frames of a capture folder as a scene's header says, and find the scene's by their times. Raises
    ValueError for a capture that did not film them."""
    groups = _groups(capture, header.sync)
    return Matched(capture, groups.cameras, groups.frames[_rows(groups, header.times_ns)])


def filmed_views(header: SceneHeader, matched: Matched, cameras: Sequence[str] | None = None) -> Views:
    """What these cameras filmed at the instants of a scene, frame by frame; None: all that capture and scene have.
    Raises ValueError for a camera that the capture does not have."""
    lenses = _lenses(header)
    cameras = [name for name in lenses if name in matched.cameras] if cameras is None else cameras
    if unknown := [name for name in cameras if name not in matched.cameras]:
        raise ValueError(f"{matched.capture} has no camera {', '.join(unknown)}; it has {', '.join(matched.cameras)}")
    frames = matched.frames[:, [matched.cameras.index(name) for name in cameras]]
    said = header.extra.get("transfer")
    return Views(
        find_capture(matched.capture).videos,
        frames,
        [lenses[name] for name in cameras],
        max_width=_max_width(header.extra),
        transfer=Transfer(said) if said else None,
        light=_light(header).of(tuple(cameras), len(frames)),
    )


def _silhouettes(capture: Path, views: Views) -> tuple[Silhouettes | None, dict[str, str]]:
    """The foreground by the capture's masks, and by camera why masks are left out."""
    masks = {name: path for name, path in find_masks(find_capture(capture)).items() if name in views.names}
    if not masks:
        return None, {}
    columns = [views.names.index(name) for name in masks]
    lenses = [views.lenses[column] for column in columns]
    laid = laid_over(masks, views.frames[:, columns], lenses, max_width=views.max_width)
    with tempfile.TemporaryDirectory() as folder:
        cache = measure_motion(views, Path(folder), MotionOptions(keep_flow=False))
        agreed = {name: asdict(compare_masks(laid, cache, place)) for place, name in enumerate(masks)}
    doubtful = doubts({"cameras": agreed})
    return Silhouettes(laid, but=doubtful), doubtful


def _lenses(header: SceneHeader) -> dict[str, LensCamera]:
    """The scene's cameras as they film, by name. Raises ValueError where a scene does not tell, as imported ones do
    not."""
    if LENSES not in header.extra:
        raise ValueError(
            "what was filmed can be compared with a scene that says how its cameras film (extra.lenses), but this one "
            "does not, as imported ones; leave the capture out"
        )
    return unabridged(header.extra[LENSES], header.cameras, f"extra: {LENSES}")


def _light(header: SceneHeader) -> Light:
    """Light of the scene's frames, and the exposures of its cameras."""
    said = fields(header.extra.get("exposure", {}), "extra: exposure")
    count = len(header.times_ns)
    exposures = {name: unpacked(text, count, f"extra: exposure: {name}") for name, text in said.items()}
    return Light(header.light.astype(np.float32), exposures)


def _max_width(extra: Mapping[str, Any]) -> int | None:
    said = field(extra, "max_width", "the scene's header: extra")
    return None if said is None else whole(said, "extra: max_width", least=1, most=MOST_SIDE_PX)


def _groups(capture: Path, sync: Mapping[str, Any]) -> FrameGroups:
    found = find_capture(capture)
    what = "the scene's header: sync"
    reference, tolerance_ns, clock = (field(sync, name, what) for name in ("reference", "tolerance_ns", "clock"))
    if tolerance_ns is not None:
        tolerance_ns = whole(tolerance_ns, f"{what}: tolerance_ns", most=MOST_NS)
    options = AlignOptions(reference=reference, tolerance_ns=tolerance_ns, clock=ClockMode(clock))
    infos = probe_capture(found, listen=options.clock is not ClockMode.CONTENT)
    timecodes = load_timecodes(found, infos, options.clock)
    if options.clock is ClockMode.CONTENT:  # the starts have what time_offset_s added in them
        starts = fields(field(sync, STARTS_NS, what), f"{what}: {STARTS_NS}")
        names = {name: f"{what}: {STARTS_NS}: {name}" for name in timecodes}
        known = {name: whole(starts.get(name), said, least=-MOST_NS, most=MOST_NS) for name, said in names.items()}
        timecodes = begun(timecodes, known)
    return align(timecodes, options)[0]


def _rows(groups: FrameGroups, times_ns: np.ndarray) -> np.ndarray:
    """Rows of the groups that were filmed at these times, ascending."""
    middles = groups.times_ns[:-1] + np.diff(groups.times_ns) // 2
    rows = np.searchsorted(middles, times_ns)
    if not len(groups) or (np.abs(groups.times_ns[rows] - times_ns) > SAME_NS).any() or (np.diff(rows) < 1).any():
        raise ValueError("the capture did not film the scene's instants; is it the one that the scene was made from?")
    return rows


def frame_scores(scores: Sequence[Score]) -> tuple[FrameScore, ...]:
    """Scores as the report shows them; the ratio and SSIM are those of renders as the cameras would film them."""
    return tuple(
        FrameScore(
            item.camera,
            item.frame,
            _level(item.psnr_calibrated_db),
            item.ssim_calibrated,
            raw_db=_level(item.psnr_db),
            own_db=_level(item.psnr_own_db),
            moving_db=item.psnr_moving_db,
            still_db=item.psnr_still_db,
            never_moving_db=item.psnr_never_moving_db,
            tof_px=item.tof_px,
            flicker=item.flicker,
            lpips=item.lpips,
            foreground_db=item.psnr_foreground_db,
            foreground_ssim=item.ssim_foreground,
            foreground_lpips=item.lpips_foreground,
        )
        for item in scores
    )


def _level(decibel: float | None) -> float:
    """Equal pictures have an infinite ratio."""
    return math.inf if decibel is None else decibel
