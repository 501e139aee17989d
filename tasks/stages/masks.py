"""Masks: foreground masks that come with a capture are read, and compared with what moves."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from packuv.files import save_json
from packuv.motion import MotionCache
from packuv.motion.foreground import compare_masks
from sync.capture import find_capture, find_masks
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
class CheckMasks(Stage):
    """Read the foreground masks of the fitted cameras and compare them with what moves: masks.json."""

    name, version = "masks", 1
    take: Take
    motion: Key
    masks: Files
    """By camera"""

    def build(self, work: Work) -> Notes:
        found = find_masks(find_capture(work.site.capture))
        masks = {name: path for name, path in found.items() if name in self.masks.sha256}
        facts = self._compare(work, masks)
        save_json(work.out / AGREEMENT, facts)
        return {"cameras": facts, "without": [name for name in self.take.cameras if name not in masks]}

    def _compare(self, work: Work, masks: dict[str, Path]) -> dict[str, Any]:
        views, cache = (
            Footage(self.take, work.site).open_masks(masks),
            MotionCache.load(work.path(self.motion) / MOTION),
        )
        facts = dict[str, Any]()
        with ThreadPoolExecutor(work.site.threads) as pool:
            for found in pool.map(lambda camera: compare_masks(views, cache, camera), range(len(masks))):
                facts[views.names[len(facts)]] = asdict(found)
                work.progress(len(facts), len(masks))
        return facts

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        if notes["without"]:
            yield "masks", f"no masks of {', '.join(notes['without'])}"


def doubts(notes: Notes) -> dict[str, str]:
    """By camera, why its masks are not to be believed; of the notes of CheckMasks."""
    found = {name: _doubt(facts) for name, facts in notes["cameras"].items()}
    return {name: why for name, why in found.items() if why}


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
