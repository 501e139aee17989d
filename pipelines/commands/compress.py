"""`packuv compress`: a smaller scene file of a lossless one."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from packuv.files import check_place
from packuv.partial import partial_path
from pipelines.commands.terminal import print_facts, shown
from pipelines.disk import size_text

if TYPE_CHECKING:
    from packuv.compress import Compressed, Goal
    from packuv.footage import Views as Footage
    from tasks.stages.evaluate import Matched

SEARCHES = 4
"""Of which each aims at less than the one before, where footage shows a loss above what was asked for"""
SHORT = 0.97
"""Share of what a proportion would allow at which such a search aims"""


def command(arguments: argparse.Namespace) -> int:
    """Exit code 2 where the goal is out of reach; then nothing is written."""
    from packuv.compress import Goal

    check_place(arguments.output)
    matched = _matched(arguments.scene, arguments.capture) if arguments.capture else None
    filmed = _scores(arguments, arguments.scene, matched) if matched else None
    fitted = {"fitted_db": filmed["psnr_db"]} if filmed else {}
    if arguments.fitted_db is not None:
        fitted = {"fitted_db": arguments.fitted_db}
    goal = Goal(arguments.ratio, arguments.loss_db, **fitted)
    found, scores = _search(arguments, goal, matched, filmed)
    facts: dict[str, Any] = {
        "file": str(arguments.output),
        "bytes": found.bytes,
        "source_bytes": found.source_bytes,
        "ratio": found.ratio,
        "psnr_db": found.psnr_db,
        "psnr_held_out_db": found.psnr_held_out_db,
        "loss_db": found.loss_db,
        "fitted_db": goal.fitted_db,
        "fitted_db_from": "given" if arguments.fitted_db is not None else "capture" if filmed else "assumed",
        "position_steps": (found.steps.position * found.steps.multiple).tolist(),
        "attribute_steps": found.steps.attribute.tolist(),
        "rows": found.rows,
        "moved": found.moved,
        "imagined": found.imagined,
        "unfollowed": dict(found.unfollowed),
    }
    if filmed:
        facts["filmed"] = {"lossless": filmed, "compressed": scores}
    print_facts(facts, arguments.json, _text)
    return 0


def _search(
    arguments: argparse.Namespace, goal: Goal, matched: Matched | None, filmed: Mapping[str, float] | None
) -> tuple[Compressed, dict[str, float] | None]:
    """Compress; with footage, so that the loss which it shows is what was asked for at most. Also scores of the result.

    Raises ValueError where no search reaches that; then nothing is written.
    """
    from packuv.compress import compress

    footage = _footage(arguments.scene, matched) if matched else None
    asked, lost, place = goal.loss_db, 0.0, partial_path(arguments.output, ".mkv")
    try:
        for number in range(SEARCHES):
            try:
                with shown(arguments, "compress") as progress:
                    found = compress(arguments.scene, place, goal, footage=footage, iterations=arguments.iterations,
                                     seed=arguments.seed, progress=progress)  # fmt: skip
            except ValueError:
                if number:  # no steps are so fine
                    break
                raise
            scores = _scores(arguments, place, matched) if matched else None
            lost = filmed["psnr_db"] - scores["psnr_db"] if filmed and scores else 0.0
            if asked is None or goal.loss_db is None or lost <= asked:
                place.replace(arguments.output)
                return found, scores
            goal = replace(goal, loss_db=SHORT * goal.loss_db * asked / lost)
    finally:
        place.unlink(missing_ok=True)
    raise ValueError(
        f"the loss must be at most {asked:g} dB, but footage shows {lost:.3f} dB with the finest steps tried; "
        "ask for more decibels, or for a --ratio"
    )


def _matched(path: Path, capture: Path) -> Matched:
    """Which pictures of the capture are the scene's. Raises ValueError for a scene that no camera filmed."""
    from packuv.scene import open_scene
    from tasks.stages.evaluate import match

    with open_scene(path) as scene:
        if not scene.header.filmed:
            raise ValueError(
                f"a capture scores scenes that its cameras filmed, but no camera filmed {path}; leave out --capture"
            )
        return match(scene.header, capture)


def _footage(scene: Path, matched: Matched) -> Footage:
    """What the scene's cameras filmed, frame by frame."""
    from packuv.scene import open_scene
    from tasks.stages.evaluate import filmed_views

    with open_scene(scene) as opened:
        return filmed_views(opened.header, matched)


def _scores(arguments: argparse.Namespace, scene: Path, matched: Matched) -> dict[str, float]:
    """PSNR and SSIM against what was filmed, renders being as the cameras would film them."""
    from tasks.stages.evaluate import EvaluateOptions, evaluate_scene

    with shown(arguments, "evaluate") as progress:
        mean = evaluate_scene(scene, matched, None, EvaluateOptions(), progress)["mean"]
    return {"psnr_db": mean["psnr_calibrated_db"], "ssim": mean["ssim_calibrated"]}


def _text(facts: Mapping[str, Any]) -> str:
    unseen = facts["psnr_held_out_db"]
    held_out = "" if unseen is None else f", {unseen:.2f} dB of cameras that no step was learned from"
    views = ", from views that were imagined, for no camera filmed it" if facts["imagined"] else ""
    assumed = "assumed; there is none" if facts["imagined"] else "assumed; --capture measures it"
    source = {"capture": "measured", "given": "given", "assumed": assumed}
    larger = ", the larger of held-out and of fitted cameras" if "filmed" in facts and unseen is not None else ""
    stayed = "" if facts["moved"] else "; their codes stay where they were"
    lines = [
        f"{facts['file']}: {size_text(facts['bytes'])}, {facts['ratio']:.2f} times smaller than the lossless "
        f"{size_text(facts['source_bytes'])}",
        f"gaussians  {facts['rows']:.1%} are still there; the others were hardly seen{stayed}",
        f"pictures   {facts['psnr_db']:.2f} dB to those of the lossless scene{held_out}{views}",
        f"loss       {facts['loss_db']:.3f} dB of {facts['fitted_db']:.2f} dB against footage "
        f"({source[facts['fitted_db_from']]}), by these pictures{larger}",
    ]
    if "filmed" in facts:
        before, after = facts["filmed"]["lossless"], facts["filmed"]["compressed"]
        lines.append(
            f"footage    {after['psnr_db']:.3f} dB, SSIM {after['ssim']:.4f}; lossless {before['psnr_db']:.3f} dB, "
            f"{before['ssim']:.4f}; scored on cameras as packuv eval does"
        )
    lines += [f"camera     {name}: no codes moved towards it: {why}" for name, why in facts["unfollowed"].items()]
    return "\n".join(lines)
