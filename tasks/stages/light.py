"""Light: how the light of the room changes from instant to instant, and which cameras change their exposure."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import save_json
from packuv.footage import DamageLog, LightOptions, damage_told, measure_light
from tasks.artefacts.stage import Notes, Stage, Work
from tasks.stages.footage import DAMAGED, LIGHT, LIGHT_FACTS, Footage, Take

DAMAGE = "damage.json"
"""File of what was found so far"""


@dataclass(frozen=True, kw_only=True)
class MeasureLight(Stage):
    """Measure light of the instants, and exposures of the cameras that have one of their own: light.npz, light.json.

    All pictures pass here, so it also finds the damaged ones, which count as missing from here on.
    """

    name, version = "light", 2
    take: Take
    """All cameras, as filmed"""
    fitted: tuple[str, ...]
    """Cameras that tell light; the others only have their exposure measured"""
    options: LightOptions

    def build(self, work: Work) -> Notes:
        footage = Footage(self.take, work.site)
        log = DamageLog(work.scratch / DAMAGE)
        light = measure_light(
            footage.open_watching_reader(log),
            footage.load_frames(),
            self.fitted,
            self.options,
            workers=work.site.threads,
            kept=work.scratch,
            progress=work.progress,
        )
        light.save(work.out / LIGHT)
        facts = {**light.facts, "range": _range(light.light), "least": self.options.least_light}
        if log.found:
            facts[DAMAGED] = log.facts()
        save_json(work.out / LIGHT_FACTS, facts)
        return facts

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        for name, facts in notes.get(DAMAGED, {}).items():
            yield "damaged pictures", damage_told(name, facts)
        if notes["steady"]:
            yield "light of the instant", why_steady(notes)
        if notes["unknown"]:
            yield "exposure over time", f"nothing stands still long enough for {', '.join(notes['unknown'])}"


def why_steady(facts: Notes) -> str:
    """For people."""
    spread, left = facts["spread"], facts["left"]
    if spread < facts["least"]:
        return f"it changes by {spread:.2%}, less than {facts['least']:.2%}"
    if left is None:
        return "fewer than two fitted cameras tell it, so none confirms the other"
    return f"light that some cameras see leaves {left:.0%} of the change that others see"


def is_steady(folder: Path) -> bool:
    """Whether an artefact says that nothing changes, neither light nor any exposure, and no picture is damaged."""
    facts = _read(folder)
    return bool(facts["steady"] and not facts["exposures"] and DAMAGED not in facts)


def read_steady(folder: Path) -> str:
    """Why the light is taken for steady; empty where it is not."""
    facts = _read(folder)
    return why_steady(facts) if facts["steady"] else ""


def read_damage(folder: Path) -> dict[str, dict[str, Any]]:
    """By damaged camera what is wrong with its pictures, see `DamageLog.facts`."""
    found: dict[str, dict[str, Any]] = _read(folder).get(DAMAGED, {})
    return found


def _range(light: np.ndarray) -> list[float]:
    """Least and most of any channel, as factors on linear light."""
    return [float(np.exp(light.min(initial=0))), float(np.exp(light.max(initial=0)))]


def _read(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / LIGHT_FACTS).read_text())
    return found
