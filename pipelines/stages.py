"""The stages of one sequence, in order.

Written once for both ways to run them: `submit` starts a stage and returns something with a `result()`, be it a
Prefect future or one of Python's. A stage is submitted when its inputs are there: a stage that waits inside a worker
would keep that worker from working.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pipelines.chain import Chain, Submit
from pipelines.options import SequenceOptions
from pipelines.request import STAGES
from pipelines.space import check_space
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.calibrate import find_points, find_rig
from tasks.stages.encode import encode, verify
from tasks.stages.evaluate import evaluate
from tasks.stages.fitting import find_background
from tasks.stages.plan import Plan
from tasks.stages.synchronize import synchronize
from tasks.stages.track import choose_keyframes, find_motion, read_spans


@dataclass
class Made:
    """Artefacts of a run by stage, in the order of the run; keyframes and segments have several each."""

    keys: dict[str, list[Key]] = field(default_factory=dict)

    def add(self, *keys: Key) -> Key:
        """Note artefacts of one stage; returns the last one."""
        for key in keys:
            self.keys.setdefault(key.stage, []).append(key)
        return keys[-1]

    def only(self, stage: str) -> Key:
        """The artefact of a stage that has one; raises KeyError for a stage that did not run."""
        (key,) = self.keys[stage]
        return key

    def get(self, stage: str) -> Key | None:
        """The first artefact of a stage, or None."""
        return self.keys[stage][0] if stage in self.keys else None


def run_stages(
    workshop: Workshop, plan: Plan, options: SequenceOptions, stop_after: str, submit: Submit, made: Made
) -> None:
    """Have every artefact of the sequence up to the stage `stop_after`, noting each in `made`.

    Raises what the first failing stage raises, and OSError when the disk cannot hold the results.
    """
    for stage in STAGES[: STAGES.index(stop_after) + 1]:
        match stage:
            case "sync":
                made.add(submit(synchronize, workshop, plan, options.sync).result())
                check_space(workshop, plan, options, made.only("sync"))
            case "calibrate":
                _calibrate(workshop, plan, options, submit, made)
            case "flow":
                _track(workshop, plan, options, submit, made)
            case "fit":
                _fit(workshop, plan, options, submit, made)
            case "encode":
                parts = (made.keys["key"][0], made.keys["segment"], options.pictures, options.encode)
                made.add(submit(encode, workshop, plan, made.only("sync"), made.only("points"), *parts).result())
            case "verify":
                made.add(submit(verify, workshop, made.only("encode"), made.keys["segment"]).result())
            case "evaluate":
                sources = (made.only("sync"), made.only("points"), made.only("encode"))
                made.add(submit(evaluate, workshop, plan, *sources, options.pictures, options.evaluate).result())


def _calibrate(workshop: Workshop, plan: Plan, options: SequenceOptions, submit: Submit, made: Made) -> None:
    groups = made.only("sync")
    rig = made.add(submit(find_rig, workshop, plan, groups, options.rig).result())
    made.add(submit(find_points, workshop, plan, groups, rig, options.points).result())


def _track(workshop: Workshop, plan: Plan, options: SequenceOptions, submit: Submit, made: Made) -> None:
    groups, rig = made.only("sync"), made.only("rig")
    motion = made.add(submit(find_motion, workshop, plan, groups, rig, options.pictures, options.motion).result())
    made.add(submit(choose_keyframes, workshop, motion, options.keyframes).result())


def _fit(workshop: Workshop, plan: Plan, options: SequenceOptions, submit: Submit, made: Made) -> None:
    groups, points, motion = (made.only(stage) for stage in ("sync", "points", "motion"))
    settings = (options.pictures, options.fit.background)
    background = submit(find_background, workshop, plan, groups, points, *settings).result()
    if background:
        made.add(background)
    spans = read_spans(workshop, made.only("keyframes"))
    for pair in Chain(workshop, plan, options, submit, groups, points, background, motion).fit(spans):
        made.add(*pair)
