"""One measured point: a run of the whole pipeline with some settings, its error, what it cost, and its size.

What several points share is made once, in one store; a point costs what its artefacts cost, whichever run made them.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from packuv.kernels.simd import cpu_description
from pipelines.batch.plan import program_digest
from pipelines.commands.progress import TerminalProgress
from pipelines.events import Journal
from pipelines.options import compose
from pipelines.process import Engine, Outcome, find_sequence, jobs_at_once, jobs_of, prepare, process
from pipelines.request import PRESETS, Preset, RunRequest, parse_range, read_settings
from sync.capture import CaptureSettings
from tasks.artefacts.recipe import digest, plain
from tasks.artefacts.store import WORK, Receipt, Store
from tasks.stages.evaluate import METRICS

FITS = ("backdrop", "key", "segment")
SCORING = "evaluate"


@dataclass(frozen=True)
class Base:
    """What all points of a benchmark have in common."""

    capture: Path
    work: Path
    """Folder of the runs and their store"""
    preset: Preset = "draft"
    frames: str = ":"
    """Instants A:B, half-open"""
    hold_out: tuple[str, ...] | None = None
    """None: what capture.toml says"""
    settings: tuple[str, ...] = ()
    """As for `packuv run --set`; a point's own win"""
    seed: int = 0

    def __post_init__(self) -> None:
        parse_range(self.frames)

    def request(self, settings: tuple[str, ...] = (), unseen: tuple[str, ...] = ()) -> RunRequest:
        """The run of a point up to its scene file; `unseen` are cameras that are not fitted beside those held out."""
        asked = RunRequest(
            capture=str(self.capture.absolute()),
            out=str(self.work.absolute()),
            preset=self.preset,
            settings=read_settings(None, [*self.settings, *settings]),
            frames=self.frames,
            hold_out=self.hold_out,
            stop_after="verify",
            seed=self.seed,
        )
        return replace(asked, hold_out=(*self.scored(), *unseen)) if unseen else asked

    def scored(self) -> tuple[str, ...]:
        """Cameras that every point is scored on; raises ValueError where none is held out."""
        held = find_sequence(self.request()).settings.held_out if self.hold_out is None else self.hold_out
        if not held:
            raise ValueError("scores need cameras that are never fitted: name some with --hold-out, or in capture.toml")
        return tuple(held)


def add_arguments(parser: argparse.ArgumentParser, *, capture: bool = True) -> None:
    """The arguments of a benchmark that measures points; without `capture` it makes its captures itself."""
    if capture:
        parser.add_argument("capture", type=Path, help="capture folder")
    else:
        parser.set_defaults(capture=Path("simulated"))
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; the table goes beside it as .md")
    parser.add_argument("--work", type=Path, help="folder of the runs (beside --out)")
    parser.add_argument("--preset", choices=PRESETS, default=Base.preset)
    parser.add_argument("--frames", default=":", metavar="A:B")
    parser.add_argument("--hold-out", type=lambda text: text.split(","), metavar="CAM,CAM")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of every point")
    parser.add_argument("--seed", type=int, default=0)


def base_of(given: argparse.Namespace) -> Base:
    """What the arguments say; the folder of the runs is there then."""
    work = given.work or given.out.with_suffix("")
    work.mkdir(parents=True, exist_ok=True)
    held = given.hold_out and tuple(given.hold_out)
    return Base(given.capture, work, given.preset, given.frames, held, tuple(given.set), given.seed)


def head(base: Base) -> dict[str, Any]:
    """What was measured, and on which machine."""
    return {
        "capture": base.capture.name,
        "preset": base.preset,
        "settings": list(base.settings),
        "frames": base.frames,
        "seed": base.seed,
        "cpus": len(os.sched_getaffinity(0)),
        "machine": platform.machine(),
        "cpu": cpu_description(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "load": round(os.getloadavg()[0], 2),
    }


def measure(base: Base, settings: tuple[str, ...] = (), unseen: tuple[str, ...] = ()) -> tuple[dict[str, Any], Outcome]:
    """Run a point, or find it there.

    All points are scored on the same cameras and against pictures of the base's size, whatever they were fitted to.
    CPU seconds count all threads and children; those of scoring stand apart, for a scene can be had without.
    """
    asked = base.request(settings, unseen)
    scored = base.scored()
    _forget_begun(Store(base.work / find_sequence(asked).name / "store"))
    with ThreadPoolExecutor(max_workers=jobs_at_once(asked)) as pool:
        engine, jobs = Engine(lambda make: lambda stage: pool.submit(make, stage)), jobs_of(asked)
        journal = Journal(TerminalProgress(sys.stderr))
        outcome = process(asked, journal, engine, jobs)
        sequence, run = prepare(asked, journal, engine, jobs)
        pictures = prepare(base.request(), Journal(), engine, jobs)[0].options.pictures
        sequence.run("verify")  # all is there
        scores = sequence.score(scored, pictures)
    store = run.workshop.store
    facts = json.loads((store.path(scores) / METRICS).read_text())
    keys = {event.key for event in journal.events if event.key}
    receipts = {str(key): store.receipt(key) for key in keys if store.holds(key)}  # not what another take lends
    return {"settings": list(settings), **_error(facts), **_cost(receipts)}, outcome


def _forget_begun(store: Store) -> None:
    """What a killed run had begun is begun anew, so that the costs of an artefact are those of all its work."""
    for folder in (store.root / WORK).glob("*-*/"):
        if gone := store.withdraw(folder):
            shutil.rmtree(gone, ignore_errors=True)


def _error(facts: Mapping[str, Any]) -> dict[str, Any]:
    mean = facts["mean"]
    return {
        "psnr_calibrated_db": mean["psnr_calibrated_db"],
        "psnr_own_db": mean["psnr_own_db"],
        "psnr_raw_db": mean["psnr_db"],
        "ssim": mean["ssim_calibrated"],
        "psnr_moving_db": mean["psnr_moving_db"],
        "psnr_still_db": mean["psnr_still_db"],
        "moving_share": mean["moving_share"],
        "mb_per_30_frames": facts["bytes"] * 30 / facts["frames"] / 1e6,
        "frames": facts["frames"],
        "scored_cameras": list(facts["cameras"]),
    }


def _cost(receipts: Mapping[str, Receipt]) -> dict[str, Any]:
    by_stage: dict[str, dict[str, float]] = {}
    if old := [name for name, receipt in receipts.items() if receipt.cpu_seconds is None]:
        raise ValueError(f"costs need CPU seconds, but {old[0]} was made before they were noted; take a new --work")
    for name, receipt in receipts.items():
        stage = by_stage.setdefault(name.partition("/")[0], {"seconds": 0.0, "cpu_seconds": 0.0})
        stage["seconds"] = round(stage["seconds"] + receipt.seconds, 2)
        stage["cpu_seconds"] = round(stage["cpu_seconds"] + (receipt.cpu_seconds or 0), 2)
    made = [stage for stage in by_stage if stage != SCORING]

    def together(stages: list[str], what: str) -> float:
        return round(sum(by_stage[stage][what] for stage in stages), 2)

    fits = [stage for stage in made if stage in FITS]
    return {
        "fit_cpu_seconds": together(fits, "cpu_seconds"),
        "fit_seconds": together(fits, "seconds"),
        "cpu_seconds": together(made, "cpu_seconds"),
        "seconds": together(made, "seconds"),
        "scoring_cpu_seconds": by_stage[SCORING]["cpu_seconds"],
        "peak_memory_bytes": max(receipt.peak_memory_bytes for receipt in receipts.values()),
        "stages": by_stage,
    }


def request_of(base: Base, settings: tuple[str, ...], unseen: tuple[str, ...] = ()) -> dict[str, Any]:
    """What tells a point from others, whichever folder it runs in, and the program and what presets mean."""
    request = base.request(settings, unseen)
    asked: dict[str, Any] = plain(request)
    options = compose(request.preset, CaptureSettings(), request.settings, seed=request.seed, quality=request.quality)
    return {
        "capture": base.capture.name,
        "scored": list(base.scored()),
        "common": list(base.settings),
        "options": digest(plain(options))[:16],
        "program": program_digest(),
        **{name: value for name, value in asked.items() if name not in ("out", "capture")},
    }
