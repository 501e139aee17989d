"""How sure the check of times against pictures is: each camera's timecodes shifted in turn, misses and false alarms.

    packuv flow CAPTURE --out runs
    packuv bench content runs/basketball runs/dome --out bench/results/content.json

A run needs `motion` of all its instants; cameras that are held out are left out. For each camera in turn its times are
moved by 1, 2 and 5 frames, forward and back by turns, all frames are matched anew, and what moves is compared as the
stage `content` does. A miss is a camera that is not named with the right number of frames, a false alarm any other that
is named.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench import command
from bench.forecast import request_of
from calibration.rig import Rig
from packuv.footage.lens import undistorted_camera
from packuv.motion import MotionCache
from pipelines.process import find_sequence, options_of
from sync.align import FrameGroups, align
from sync.capture import load_timecodes, probe_capture
from sync.content import Activity, Content, ContentOptions, Window, find_offsets
from tasks.artefacts.retention import RUN
from tasks.stages.content import activity_of, choose_windows, expected_offsets
from tasks.stages.footage import RIG, lens_camera
from tasks.stages.track import MOTION

SHIFTS = (1, 2, 5)


@dataclass(frozen=True)
class Filmed:
    """What was measured of a capture, by the frames of its videos."""

    groups: FrameGroups
    seen: Mapping[str, Activity]
    """Of all instants of the groups"""
    moving: np.ndarray
    """float [T]: mean share of the pictures that moves"""

    def as_paired(self, groups: FrameGroups, window: range) -> dict[str, Activity]:
        """The same if frames were paired otherwise: rows of the steps that two neighbouring instants still make."""
        return {name: self._paired(name, groups, window) for name in self.seen}

    def _paired(self, name: str, groups: FrameGroups, window: range) -> Activity:
        own, new = (found.frames[:, found.cameras.index(name)] for found in (self.groups, groups))
        seen, rows = self.seen[name], slice(window.start, window.stop)
        steps = {(int(own[row - 1]), int(own[row])): row for row in np.flatnonzero(seen.there)}
        wanted = [steps.get((int(new[row - 1]), int(new[row])), -1) if row else -1 for row in range(len(new))[rows]]
        return seen.at(np.array(wanted))


def gather(folder: Path) -> Iterator[dict[str, Any]]:
    """A row for each camera and shift of the run in `folder`, <out>/<sequence>."""
    run = json.loads((folder / RUN).read_text())
    paths = {item["artefact"].partition("/")[0]: folder / "store" / item["artefact"] for item in run["artefacts"]}
    request = request_of(run)
    capture = find_sequence(request)
    options = options_of(request, capture, request.preset)
    timecodes = load_timecodes(capture, probe_capture(capture))
    filmed = _filmed(paths, align(timecodes, options.sync)[0])
    for index, camera in enumerate(filmed.seen):
        period = int(np.median(np.diff(np.sort(timecodes[camera].times_ns))))
        for shift in (size * (-1) ** index for size in SHIFTS):
            moved = replace(timecodes[camera], times_ns=timecodes[camera].times_ns + shift * period)
            groups, _ = align({**timecodes, camera: moved}, options.sync)
            yield {"camera": camera, "shift": shift, **judged(filmed, groups, options.content, camera, -shift)}


def _filmed(paths: Mapping[str, Path], groups: FrameGroups) -> Filmed:
    cache, rig = MotionCache.load(paths["motion"] / MOTION), Rig.load(paths["rig"] / RIG)
    if len(cache) != len(groups):
        raise ValueError(
            f"motion must be measured of all {len(groups)} instants, but is of {len(cache)}; leave out --frames"
        )
    whole, seen = range(len(cache)), {}
    for column, name in enumerate(cache.names):
        camera = undistorted_camera(lens_camera(rig[name])).scaled(*cache.sizes[column])
        seen[name] = activity_of(cache, column, camera, whole)
    return Filmed(groups, seen, np.nan_to_num(cache.steps["share"]).mean(axis=1))


def judged(filmed: Filmed, groups: FrameGroups, options: ContentOptions, camera: str, truth: int) -> dict[str, Any]:
    """What the check says of one camera that is off by `truth` instants, and of the others."""
    started, windows = time.process_time(), []
    for window in choose_windows(filmed.moving[: len(groups)], options):
        offsets = find_offsets(filmed.as_paired(groups, window), options.reach, expected_offsets(groups, window))
        windows.append(Window(window.start, window.stop - 1, offsets))
    content = Content(tuple(filmed.seen), tuple(windows))
    told = {name: found[1] for name in content.cameras if (found := content.worst(name))}
    lies = {name: own.away for name, own in told.items() if own.lies}
    return {
        "away": round(told[camera].away, 3) if camera in told else None,
        "error": round(told[camera].error, 3) if camera in told else None,
        "found": camera in lies and round(lies[camera]) == truth,
        "false": sorted(lies.keys() - {camera}),
        "unsure": len(content.undecided),
        "cpu_seconds": round(time.process_time() - started, 2),
    }


def table(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """In Markdown: a line for each capture and number of frames."""
    lines = [
        "| capture | cameras | off by | trials | missed | false alarms | unsure | off by, measured: error |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for capture, rows in found.items():
        cameras = len({row["camera"] for row in rows})
        for size in sorted({abs(row["shift"]) for row in rows}):
            own = [row for row in rows if abs(row["shift"]) == size]
            missed, false = sum(not row["found"] for row in own), sum(len(row["false"]) for row in own)
            unsure = sum(row["away"] is None for row in own)
            errors = [row["away"] + row["shift"] for row in own if row["away"] is not None]
            spread = f"{np.sqrt(np.mean(np.square(errors))):.2f}" if errors else "-"
            lines.append(f"| {capture} | {cameras} | {size} | {len(own)} | {missed} | {false} | {unsure} | {spread} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("content", __doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="folders <out>/<sequence> of runs that came to motion")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; the table goes beside it as .md")
    args = parser.parse_args(arguments)
    found = {}
    for folder in args.runs:
        found[folder.name] = list(gather(folder))
        print(f"{folder.name}: {len(found[folder.name])} trials")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    args.out.with_suffix(".md").write_text(table(found) + "\n")
    print(table(found))


if __name__ == "__main__":
    main()
