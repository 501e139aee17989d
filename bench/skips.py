"""What is skipped where a scene does not need it: time saved and error added, one skip at a time.

    packuv bench skips --out runs/skips.json
    packuv bench skips --out runs/skips.json --scenes still 15 --skips "still frames" settle

Each scene is a simulated capture of which so much moves: nothing, and about 2 %, 15 % and 60 % of the pictures. It is
run as it is and once more without each skip. Saved are the CPU seconds, without scoring, that the skip spares; added is
the error that it costs on the camera that is not fitted. A row that the file has with the same request is not run
again, and a run that was stopped goes on.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from bench import command
from bench.point import Base, add_arguments, base_of, head, measure, request_of
from packuv.files import whole_file
from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from studio.film_set import MOVING
from studio.rig import PlacementOptions, RigKind

SCENES: Mapping[str, Mapping[str, Any]] = {
    "still": {"movers": ()},
    "2": {"movers": ("crate",)},
    "15": {"movers": MOVING},
    "60": {"movers": MOVING, "crowd": 18},
}
"""What moves, as options of the studio, by share of the pictures, %: the truth says 0, 3.5, 17 and 65 %, on average"""
NOTHING = "(all skips)"


class Skip(NamedTuple):
    """A skip, as settings with it and without."""

    on: tuple[str, ...]
    """Beside the defaults"""
    off: tuple[str, ...]


SKIPS: Mapping[str, Skip] = {
    # Every change counts as motion, however small.
    "still frames": Skip(
        (), ("motion.low_sigmas=0.01", "motion.high_sigmas=0.02", "motion.noise_floor=0.001", "motion.least_area_px=0")
    ),
    # An ellipse without end meets every mask, so all that is before the backdrop is fitted, in all tiles.
    "tiles and labels": Skip(
        (),
        (
            "fit.labels.sigmas=1e6",
            "fit.labels.radius_limit_px=1e6",
            "fit.labels.least_overlap=0",
            "fit.labels.least_share=0",
        ),
    ),
    "frozen backdrop": Skip((), ("fit.background.instants=0",)),
    "settle": Skip((), ("fit.settle=0",)),
    "SH bands": Skip(("fit.sh_degree=1",), ("fit.sh_degree=1", "fit.sh_gain=-1")),
    "steady light": Skip((), ("light.least_light=0", "light.most_left=1", "light.least_exposure=0")),
}
"""By name; SH bands are dropped from a fit that begins with degree 1"""
SETTINGS = (
    "fit.iterations=500",
    "fit.key_iterations=120",
    "fit.density.cap=12000",
    "fit.start.count=6000",
)
"""Of every row: enough for pictures of 320x180"""

BRIEF = ("fit.iterations=20", "fit.key_iterations=10", "fit.density.cap=3000", "fit.start.count=3000")
"""Of a first run that compiles kernels and counts nowhere"""


def film(folder: Path, scene: str, frames: int, size: str, cameras: int) -> Path:
    """The capture of a scene, unless it is there."""
    target = folder / f"{scene}_{cameras}x{frames}_{size}"
    if not target.exists():
        simulate(
            target,
            SimulateOptions(
                cameras, frames, size, seed=7, clock=ClockOptions(drop_share=0, max_late_frames=0),
                rig=PlacementOptions(RigKind.FRONT), truth=TruthKind.LIGHT, name=f"motion_{scene}", **SCENES[scene],
            ),
        )  # fmt: skip
    return target


def run(base: Base, names: Sequence[str], known: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """The scene as it is, then each skip off, as rows with what the skip saves and adds."""
    rows = {json.dumps(row["request"], sort_keys=True): row for row in known}

    def figures(settings: tuple[str, ...]) -> dict[str, Any]:
        request = request_of(base, settings)
        name = json.dumps(request, sort_keys=True)
        if name not in rows:
            rows[name] = {**measure(base, settings)[0], "request": request}
        return dict(rows[name])

    yield {**figures(()), "skip": NOTHING}
    for name in names:
        with_it, without = figures(SKIPS[name].on), figures(SKIPS[name].off)
        yield {
            **without,
            "skip": name,
            "saved_cpu_seconds": without["cpu_seconds"] - with_it["cpu_seconds"],
            "saved_share": 1 - with_it["cpu_seconds"] / without["cpu_seconds"],
            "added_db": without["psnr_calibrated_db"] - with_it["psnr_calibrated_db"],
        }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [
        "| scene, % moving | skip | CPU s without it | saved | | PSNR without it, dB | error added, dB |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        saved, share, added = ("", "", "")
        if row["skip"] != NOTHING:
            saved, share = f"{row['saved_cpu_seconds']:.0f}", f"{row['saved_share']:.0%}"
            added = f"{row['added_db']:+.2f}"
        lines.append(
            f"| {row['scene']} | {row['skip']} | {row['cpu_seconds']:.0f} | {saved} | {share} | "
            f"{row['psnr_calibrated_db']:.2f} | {added} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("skips", __doc__)
    add_arguments(parser, capture=False)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES, metavar="SCENE")
    parser.add_argument("--skips", nargs="+", default=list(SKIPS), choices=SKIPS, metavar="SKIP")
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--instants", type=int, default=16, help="of each capture")
    parser.add_argument("--size", default="320x180", metavar="WxH")
    given = parser.parse_args(arguments)
    common = base_of(given)
    capture = film(common.work / "captures", "2", given.instants, given.size, given.cameras)
    measure(replace(common, capture=capture, work=common.work / "compiles", settings=BRIEF))
    known = json.loads(given.out.read_text())["rows"] if given.out.exists() else []
    rows: list[dict[str, Any]] = []
    for scene in given.scenes:
        capture = film(common.work / "captures", scene, given.instants, given.size, given.cameras)
        base = replace(common, capture=capture, work=common.work / scene, settings=(*SETTINGS, *common.settings))
        for row in run(base, given.skips, known):
            rows.append({"scene": scene, **row})
            named = {(one["scene"], one["skip"]) for one in rows}
            there = [*rows, *(one for one in known if (one["scene"], one["skip"]) not in named)]
            with whole_file(given.out) as part:
                part.write_text(json.dumps({**head(common), "rows": there}, indent=1) + "\n")
            given.out.with_suffix(".md").write_text(table(there) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
