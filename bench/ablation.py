"""What each part of the method is worth: the whole pipeline again and again, each time without one part.

    python -m bench.ablation CAPTURE --out runs/ablation.json --frames 0:30 --hold-out cam03 --preset draft
    python -m bench.ablation CAPTURE --out runs/ablation.json --rows full "w/o LPO" --set fit.iterations=500

The first rows are those of the paper's table of ablations, then come the parts that are ours. Scores are those of the
cameras that are held out. Runs share a store under --work, so that what a row does not change is made once; a row's
CPU seconds are those of the fits that it needs, whichever run made them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from bench import command
from bench.point import Base, add_arguments, base_of, head, measure
from packuv.scene import open_scene
from pipelines.process import Outcome

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


def run_row(name: str, base: Base) -> dict[str, Any]:
    """One run of the pipeline without a part."""
    figures, outcome = measure(base, tuple(ROWS[name]))
    if name == "w/o codec":
        figures["mb_per_30_frames"] = _plain_mb(outcome)
    return {"row": name, **figures}


def _plain_mb(outcome: Outcome) -> float:
    """Size of 30 frames whose codes are stored as they are."""
    assert outcome.scene is not None
    with open_scene(outcome.scene) as scene:
        frames = [scene.codes(frame) for frame in range(len(scene))]
    return 30 * sum(codes.xyz.nbytes + codes.attributes.nbytes for codes in frames) / len(frames) / 1e6


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows in Markdown, with the difference to the first one."""
    lines = ["| | PSNR, dB | | SSIM | MB per 30 frames | fit, CPU s |", "|---|---:|---:|---:|---:|---:|"]
    for row in rows:
        level = row["psnr_calibrated_db"]
        change = "" if row is rows[0] else f"{level - rows[0]['psnr_calibrated_db']:+.2f}"
        lines.append(
            f"| {row['row']} | {level:.2f} | {change} | {row['ssim']:.4f} | {row['mb_per_30_frames']:.2f} | "
            f"{row['fit_cpu_seconds']:.0f} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("ablation", __doc__)
    add_arguments(parser)
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=ROWS, metavar="ROW", help=", ".join(ROWS))
    given = parser.parse_args(arguments)
    base, rows = base_of(given), list[dict[str, Any]]()
    for name in given.rows:
        rows.append(run_row(name, base))
        # After every row, because a row may take hours.
        given.out.write_text(json.dumps({**head(base), "rows": rows}, indent=1) + "\n")
        given.out.with_suffix(".md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
