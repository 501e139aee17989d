"""What each part of the method is worth: the whole pipeline again and again, each time without one part.

    python -m bench.ablation CAPTURE --out runs/ablation.json --frames 0:30 --hold-out cam03 --preset draft
    python -m bench.ablation CAPTURE --out runs/ablation.json --rows full "w/o LPO" --set fit.iterations=500

The first rows are those of the paper's table of ablations, then come the parts that are ours. Scores are those of the
cameras that are held out. Runs share a store under --work, so that what a row does not change is made once; a row's
seconds are those of the fits that it needs, whichever run made them.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import command
from packuv.scene import open_scene
from pipelines.commands.progress import TerminalProgress
from pipelines.events import Journal
from pipelines.process import Outcome, process_directly
from pipelines.request import PRESETS, Preset, RunRequest, parse_range, read_settings

COSTS = "costs.json"
"""Seconds that each artefact took, by its key, so that a later call still knows them"""
_FAR = 1_000_000

ROWS: Mapping[str, Sequence[str]] = {
    "full": (),
    # One segment: every frame is carried on from the one before.
    "w/o keyframes": (f"keyframes.separation={_FAR}", f"keyframes.max_segment={2 * _FAR}", "keyframes.promotion=0"),
    # An ellipse without end meets the motion mask of every camera that the Gaussian stands before.
    "w/o labeling": (
        "fit.labels.sigmas=1e6",
        "fit.labels.radius_limit_px=1e6",
        "fit.labels.least_overlap=0",
        "fit.labels.least_share=0",
    ),
    # A map so fine that hardly two Gaussians share a texel.
    "w/o atlas": ("fit.uv.rows=4096", "fit.uv.columns=4096"),
    "w/o LPO": ("fit.low_precision=false",),
    # The file holds what was fitted to the bit, so only the size differs.
    "w/o codec": (),
    "w/o shell": ("fit.shell.enabled=false",),
    "w/o backdrop": ("fit.background.instants=0",),
    "w/o light": ("light.enabled=false",),
    "w/o random background": ("fit.random_background=false",),
    "w/o lifted motion": ("fit.lift.enabled=false",),
    "w/o depth term": ("fit.depth_weight=0",),
    "labels by OR (paper)": ("fit.labels.least_overlap=0", "fit.labels.least_share=0"),
}
"""Settings, as for `packuv run --set`, by row of the table"""


@dataclass(frozen=True)
class AblationOptions:
    """What is run."""

    capture: Path
    work: Path
    """Folder of the runs and their store"""
    rows: tuple[str, ...] = tuple(ROWS)
    preset: Preset = "draft"
    frames: str = ":"
    """Instants A:B, half-open"""
    hold_out: tuple[str, ...] | None = None
    """None: what capture.toml says"""
    settings: tuple[str, ...] = ()
    """Of every row; a row's own win"""
    seed: int = 0

    def __post_init__(self) -> None:
        parse_range(self.frames)
        if unknown := [name for name in self.rows if name not in ROWS]:
            raise ValueError(f"no row {', '.join(unknown)}; there are {', '.join(ROWS)}")


def run_row(name: str, options: AblationOptions, costs: dict[str, float]) -> dict[str, Any]:
    """One run of the pipeline; PSNR and SSIM of the held-out cameras, MB per 30 frames, seconds of fitting."""
    settings = read_settings(None, [*options.settings, *ROWS[name]])
    request = RunRequest(
        capture=str(options.capture.absolute()),
        out=str(options.work.absolute()),
        preset=options.preset,
        settings=settings,
        frames=options.frames,
        hold_out=options.hold_out,
        seed=options.seed,
    )
    outcome = process_directly(request, Journal(TerminalProgress(sys.stderr)))
    for event in outcome.events:
        if event.key and event.outcome == "made":
            costs[str(event.key)] = event.seconds
    figures = outcome.figures
    return {
        "row": name,
        "settings": list(ROWS[name]),
        "psnr_db": figures["psnr_db"],
        "ssim": figures["ssim"],
        "mb_per_30_frames": _plain_mb(outcome) if name == "w/o codec" else figures["mb_per_30_frames"],
        "fit_seconds": _fit_seconds(outcome, costs),
        "frames": figures["frames"],
        "scored_cameras": figures["scored_cameras"],
        "held_out": figures["held_out"],
    }


def _plain_mb(outcome: Outcome) -> float:
    """Size of 30 frames whose codes are stored as they are."""
    assert outcome.scene is not None
    with open_scene(outcome.scene) as scene:
        frames = [scene.codes(frame) for frame in range(len(scene))]
    return 30 * sum(codes.xyz.nbytes + codes.attributes.nbytes for codes in frames) / len(frames) / 1e6


def _fit_seconds(outcome: Outcome, costs: Mapping[str, float]) -> float | None:
    """What the fits of a run took, whenever they were made; None if that is no longer known."""
    keys = [str(event.key) for event in outcome.events if event.label.startswith("fit") and event.key]
    return round(sum(costs[key] for key in keys), 1) if all(key in costs for key in keys) else None


def run(options: AblationOptions) -> Iterator[dict[str, Any]]:
    """Every row, as soon as it is there."""
    path = options.work / COSTS
    costs: dict[str, float] = json.loads(path.read_text()) if path.exists() else {}
    for name in options.rows:
        row = run_row(name, options, costs)
        path.write_text(json.dumps(costs))
        yield row


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows in Markdown, with the difference to the first one."""
    lines = ["| | PSNR, dB | | SSIM | MB per 30 frames | fit, s |", "|---|---:|---:|---:|---:|---:|"]
    for row in rows:
        change = "" if row is rows[0] else f"{row['psnr_db'] - rows[0]['psnr_db']:+.2f}"
        seconds = "" if row["fit_seconds"] is None else f"{row['fit_seconds']:.0f}"
        lines.append(
            f"| {row['row']} | {row['psnr_db']:.2f} | {change} | {row['ssim']:.4f} | "
            f"{row['mb_per_30_frames']:.2f} | {seconds} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("ablation", __doc__)
    parser.add_argument("capture", type=Path, help="capture folder")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; the table goes beside it as .md")
    parser.add_argument("--work", type=Path, help="folder of the runs (beside --out)")
    parser.add_argument("--rows", nargs="+", default=list(ROWS), metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--preset", choices=PRESETS, default=AblationOptions.preset)
    parser.add_argument("--frames", default=":", metavar="A:B")
    parser.add_argument("--hold-out", nargs="+", metavar="CAMERA")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of every row")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    work = given.work or given.out.with_suffix("")
    work.mkdir(parents=True, exist_ok=True)
    options = AblationOptions(
        given.capture,
        work,
        tuple(given.rows),
        given.preset,
        given.frames,
        given.hold_out and tuple(given.hold_out),
        tuple(given.set),
        given.seed,
    )
    head = {
        "capture": given.capture.name,
        "preset": given.preset,
        "settings": given.set,
        "frames": given.frames,
        "cpus": os.cpu_count(),
        "machine": platform.machine(),
    }
    rows: list[dict[str, Any]] = []
    for row in run(options):
        rows.append(row)
        # After every row, because a row may take hours.
        given.out.write_text(json.dumps({**head, "rows": rows}, indent=1) + "\n")
        given.out.with_suffix(".md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
