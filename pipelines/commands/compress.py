"""`packuv compress`: a smaller scene file of a lossless one."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.commands.terminal import print_facts, shown
from pipelines.disk import size_text


def command(arguments: argparse.Namespace) -> int:
    """Exit code 2 where the goal is out of reach; then nothing is written."""
    from packuv.compress import Goal, compress

    filmed = _scores(arguments, arguments.scene) if arguments.capture else None
    fitted = {"fitted_db": filmed["psnr_db"]} if filmed else {}
    if arguments.fitted_db is not None:
        fitted = {"fitted_db": arguments.fitted_db}
    goal = Goal(arguments.ratio, arguments.loss_db, **fitted)
    with shown(arguments, "compress") as progress:
        found = compress(arguments.scene, arguments.output, goal, seed=arguments.seed, progress=progress)
    facts: dict[str, Any] = {
        "file": str(arguments.output),
        "bytes": found.bytes,
        "source_bytes": found.source_bytes,
        "ratio": found.ratio,
        "psnr_db": found.psnr_db,
        "psnr_held_out_db": found.psnr_held_out_db,
        "loss_db": found.loss_db,
        "fitted_db": goal.fitted_db,
        "fitted_db_from": "capture" if filmed else "given" if fitted else "assumed",
        "position_steps": (found.steps.position * found.steps.multiple).tolist(),
        "attribute_steps": found.steps.attribute.tolist(),
    }
    if filmed:
        facts["filmed"] = {"lossless": filmed, "compressed": _scores(arguments, arguments.output)}
    print_facts(facts, arguments.json, _text)
    return 0


def _scores(arguments: argparse.Namespace, scene: Path) -> dict[str, float]:
    """PSNR and SSIM against what was filmed, renders being as the cameras would film them."""
    from tasks.stages.evaluate import EvaluateOptions, evaluate_scene

    with shown(arguments, "evaluate") as progress:
        mean = evaluate_scene(scene, arguments.capture, None, EvaluateOptions(), progress)["mean"]
    return {"psnr_db": mean["psnr_calibrated_db"], "ssim": mean["ssim_calibrated"]}


def _text(facts: Mapping[str, Any]) -> str:
    unseen = facts["psnr_held_out_db"]
    held_out = "" if unseen is None else f", {unseen:.2f} dB of cameras that no step was learned from"
    source = {"capture": "measured", "given": "given", "assumed": "assumed; --capture measures it"}
    lines = [
        f"{facts['file']}: {size_text(facts['bytes'])}, {facts['ratio']:.2f} times smaller than the lossless "
        f"{size_text(facts['source_bytes'])}",
        f"pictures   {facts['psnr_db']:.2f} dB to those of the lossless scene{held_out}",
        f"loss       {facts['loss_db']:.3f} dB of {facts['fitted_db']:.2f} dB against footage "
        f"({source[facts['fitted_db_from']]}), by these pictures",
    ]
    if "filmed" in facts:
        before, after = facts["filmed"]["lossless"], facts["filmed"]["compressed"]
        lines.append(
            f"footage    {after['psnr_db']:.3f} dB, SSIM {after['ssim']:.4f}; lossless {before['psnr_db']:.3f} dB, "
            f"{before['ssim']:.4f}; scored on cameras as packuv eval does"
        )
    return "\n".join(lines)
