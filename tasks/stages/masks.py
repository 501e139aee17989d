"""Masks: foreground masks that come with a capture are read, and compared with what moves, before they are used."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from packuv.files import save_json
from packuv.footage import MaskReader
from packuv.motion import MotionBackend, MotionCache, MotionOptions, measure_motion
from packuv.motion.foreground import compare_masks
from sync.capture import find_capture
from sync.masks import check_masks, find_masks
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.footage import Footage, Take
from tasks.stages.track import MOTION

AGREEMENT = "masks.json"
MOST_OUTSIDE = 0.5
"""Share of what moves that may lie outside the masks: shadows and things that nobody masked move, too"""
SHIFT_GAIN = 0.05
"""Share of what moves by which masks may fit better where they are shifted: shadows are at one side of things"""
EMPTY, FULL = 1e-4, 0.98
"""Shares of a picture below and above which masks tell nothing"""


@dataclass(frozen=True, kw_only=True)
class MatchMasks(Stage):
    """See whether masks are whole, with the count, numbers and shape of their cameras' pictures; raises ValueError if
    not. It needs nothing, and nothing is made of it: what does not fit shall be known before anything else is done."""

    name, version = "mask_files", 2
    videos: Files
    """Of the cameras with masks"""
    masks: Files
    """By camera, held-out ones, too"""

    @property
    def label(self) -> str:
        return "mask files"

    def build(self, work: Work) -> Notes:
        capture, cameras = find_capture(work.site.capture), list(self.masks.sha256)

        def check(camera: str) -> None:
            size = check_masks(capture, camera)
            MaskReader({camera: find_masks(capture)[camera]}, {camera: size}).check(camera)

        with ThreadPoolExecutor(work.site.threads) as pool:
            for done, _ in enumerate(pool.map(check, cameras)):
                work.progress(done + 1, len(cameras))
        return {"cameras": cameras}


@dataclass(frozen=True, kw_only=True)
class CheckMasks(Stage):
    """Read the foreground masks of the fitted cameras and compare them with what moves: masks.json."""

    name, version = "masks", 1
    take: Take
    motion: Key
    masks: Files
    """By camera"""

    def build(self, work: Work) -> Notes:
        return _compare(work, self.take, self.masks, MotionCache.load(work.path(self.motion) / MOTION))

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        yield from _told(notes)


@dataclass(frozen=True, kw_only=True)
class CheckUnseenMasks(Stage):
    """The same of cameras whose motion no other stage measures: masks.json."""

    name, version = "masks", 1
    take: Take
    masks: Files
    """By camera"""
    motion_options: MotionOptions

    @property
    def label(self) -> str:
        return "masks of unseen cameras"

    def build(self, work: Work) -> Notes:
        options = replace(self.motion_options, keep_flow=False, backend=MotionBackend.DIS)  # only masks are wanted
        take = replace(self.take, cameras=tuple(name for name in self.take.cameras if name in self.masks.sha256))
        views = Footage(take, work.site).open_views()
        cache = measure_motion(views, work.scratch / MOTION, options, workers=work.site.threads)
        return _compare(work, self.take, self.masks, cache)

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        yield from _told(notes)


def _compare(work: Work, take: Take, masks: Files, cache: MotionCache) -> Notes:
    views = Footage(take, work.site).open_masks(masks)
    facts = dict[str, Any]()
    with ThreadPoolExecutor(work.site.threads) as pool:
        for found in pool.map(lambda camera: compare_masks(views, cache, camera), range(len(views.names))):
            facts[views.names[len(facts)]] = asdict(found)
            work.progress(len(facts), len(views.names))
    save_json(work.out / AGREEMENT, facts)
    return {"cameras": facts, "without": [name for name in take.cameras if name not in facts]}


def _told(notes: Notes) -> Iterator[tuple[str, str]]:
    if notes["without"]:
        yield "masks", f"no masks of {', '.join(notes['without'])}"
    for name, why in doubts(notes).items():
        yield f"masks of {name}", why


def doubts(notes: Notes) -> dict[str, str]:
    """By camera, why its masks are not used; of the notes of CheckMasks."""
    found = {name: _doubt(facts) for name, facts in notes["cameras"].items()}
    return {name: why for name, why in found.items() if why}


def believed(notes: Notes) -> list[str]:
    """Cameras whose masks are used; of the notes of CheckMasks."""
    doubtful = doubts(notes)
    return [name for name in notes["cameras"] if name not in doubtful]


def _doubt(facts: dict[str, Any]) -> str | None:
    share, outside, fit = facts["foreground_share"], facts["outside_share"], facts["fit"]
    if share < EMPTY or share > FULL:
        return f"{share:.2%} of its pictures is foreground, which tells nothing; is white the foreground?"
    if outside is not None and outside > MOST_OUTSIDE:
        return f"{outside:.0%} of what moves lies outside; are they of this camera and numbered like its pictures?"
    if fit is not None and fit["shifted_share"] - fit["inside_share"] > SHIFT_GAIN:
        (x, y), inside, shifted = fit["shift_px"], fit["inside_share"], fit["shifted_share"]
        return f"{inside:.0%} of what moves lies inside, but {shifted:.0%} if they are moved by {x:+d}, {y:+d} pixels"
    return None
