"""How sure the judgement of a calibration is: faults planted in right calibrations, misses and false alarms.

    packuv bench doubts --out bench/results/doubts.json

Rooms are simulated, their right rigs judged by three instants as an import is, and then again with one fault: of one
camera after another a focal length that is 10 % too long, a principal point that is off by 5 % of the width, a turn by
2 degrees, a shift by 3 % of the rig's radius, and the pose of the next camera exchanged with it. Such a fault is named,
or the calibration refused, or the camera is said not to be confirmed, since the pictures say too little of it; else it
is silent. A false alarm is any other camera that is said to be wrong. Others that are not confirmed are counted apart.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench import command
from calibration.accept import MatchesReport, PairMatches, Verdict, matches_report
from calibration.doubt import accused, doubts
from calibration.features import Features
from calibration.judge import seen_at
from calibration.rig import Camera, Rig
from packuv.footage import FrameReader
from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from studio.rig import PlacementOptions, RigKind
from studio.truth import read_truth
from sync.capture import find_capture
from tasks.stages.calibrate import RigOptions

INSTANTS = 3
JUDGE = RigOptions().judge
RIGHT = "(none)"


@dataclass(frozen=True)
class Room:
    """What is filmed."""

    kind: RigKind
    cameras: int
    seed: int
    size: str = "320x180"
    crowd: int = 0

    @property
    def name(self) -> str:
        return f"{self.kind}{self.cameras}_{self.seed}" + (f"_crowd_{self.size}" if self.crowd else "")

    def filmed(self, work: Path) -> Path:
        """The capture, made if it is not there yet."""
        folder = work / self.name
        if not folder.exists():
            options = SimulateOptions(self.cameras, INSTANTS, self.size, seed=self.seed, crowd=self.crowd)
            clock = ClockOptions(drop_share=0, max_late_frames=0)
            rig = PlacementOptions(self.kind)
            simulate(folder, replace(options, fps=Fraction(2), clock=clock, rig=rig, truth=TruthKind.LIGHT))
        return folder


ROOMS = (
    *(Room(kind, cameras, seed) for kind in RigKind for cameras in (6, 12, 30) for seed in (1, 2)),
    *(Room(kind, 27, seed, "240x136", crowd=27) for kind, seed in ((RigKind.DOME, 7), (RigKind.RING, 8))),
    Room(RigKind.FRONT, 8, 7, "240x136", crowd=27),
)


def turned(camera: Camera, rng: np.random.Generator, radius: float) -> Camera:
    """By two degrees about any axis."""
    axis = rng.normal(size=3)
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians(2.0) * axis / np.linalg.norm(axis))[0]
    return replace(camera, camera_from_world=turn @ camera.camera_from_world)


def moved(camera: Camera, rng: np.random.Generator, radius: float) -> Camera:
    """By 3 % of the radius in any direction."""
    way, pose = rng.normal(size=3), camera.camera_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ (0.03 * radius * way / np.linalg.norm(way))
    return replace(camera, camera_from_world=pose)


def longer(camera: Camera, rng: np.random.Generator, radius: float) -> Camera:
    return replace(camera, fx=1.1 * camera.fx, fy=1.1 * camera.fy)


def aside(camera: Camera, rng: np.random.Generator, radius: float) -> Camera:
    return replace(camera, cx=camera.cx + 0.05 * camera.width)


FAULTS: Mapping[str, Callable[[Camera, np.random.Generator, float], Camera]] = {
    "focal length + 10 %": longer,
    "principal point + 5 %": aside,
    "turned by 2 degrees": turned,
    "moved by 3 %": moved,
}
SWAPPED = "two exchanged"


def wrong_rigs(rig: Rig, seed: int, most: int) -> Iterator[tuple[str, frozenset[str], Rig]]:
    """Each fault, whom it befalls and the rig that has it; of more than `most` cameras so many, evenly chosen."""
    rng = np.random.default_rng([seed, 5])
    radius = float(np.median(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1)))
    count = len(rig.cameras)
    chosen = sorted({int(index) for index in np.linspace(0, count - 1, min(most, count)).round()})
    for index in chosen:
        camera, other = rig.cameras[index], rig.cameras[(index + 1) % count]
        for fault, change in FAULTS.items():
            yield fault, frozenset([camera.name]), _with(rig, [change(camera, rng, radius)])
        exchanged = [
            replace(camera, camera_from_world=other.camera_from_world),
            replace(other, camera_from_world=camera.camera_from_world),
        ]
        yield SWAPPED, frozenset([camera.name, other.name]), _with(rig, exchanged)


def _with(rig: Rig, cameras: Sequence[Camera]) -> Rig:
    by_name = {camera.name: camera for camera in cameras}
    return replace(rig, cameras=tuple(by_name.get(camera.name, camera) for camera in rig.cameras))


def gather(room: Room, work: Path, most: int) -> Iterator[dict[str, Any]]:
    """A row for the right rig, and one for each fault."""
    folder = room.filmed(work)
    reader, rig = FrameReader(find_capture(folder).videos), right_rig(folder)
    instants = ({name: reader.read(name, index) for name in rig.names} for index in range(INSTANTS))
    seen = list(seen_at(rig, instants, options=JUDGE))
    for fault, whom, wrong in [(RIGHT, frozenset[str](), rig), *wrong_rigs(rig, room.seed, most)]:
        yield {"room": room.name, "cameras": room.cameras, "fault": fault, **judged(wrong, seen, whom)}


def right_rig(folder: Path) -> Rig:
    """Of a simulated capture."""
    cameras = (view.camera for view in read_truth(folder).cameras.values())
    return Rig(
        tuple(Camera(c.name, c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.camera_from_world) for c in cameras), "truth"
    )


Seen = tuple[Mapping[str, Features], Sequence[PairMatches]]
"""Features and matches of an instant"""


def judged(rig: Rig, seen: Sequence[Seen], whom: frozenset[str]) -> dict[str, Any]:
    """As an import is judged: by one instant, and by more while there is a doubt."""
    evidence, said, report = list[PairMatches](), dict[str, str](), None
    for count, (_, found) in enumerate(seen, start=1):
        evidence += found
        report = matches_report(rig, evidence, options=JUDGE.judge)
        said = doubts(rig, evidence, report, judge=JUDGE, features=[features for features, _ in seen[:count]])
        if not said:
            break
    wrong = accused(said)
    return {
        "whom": sorted(whom),
        "refused": _refused(report),
        "named": sorted(whom & wrong),
        "false": sorted((wrong & set(rig.names)) - whom),
        "unconfirmed": sorted(said.keys() - wrong),
        "whole": sorted(wrong - set(rig.names)),
    }


def _refused(report: MatchesReport | None) -> bool:
    return report is not None and report.verdict is Verdict.REJECTED


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """In Markdown: a line for each number of cameras and each fault."""
    lines = [
        "| cameras | fault | trials | named | not confirmed | silent | others accused | others not confirmed |",
        "|---:|---|---:|---:|---:|---:|---:|---:|",
    ]
    for cameras in sorted({row["cameras"] for row in rows}):
        for fault in (RIGHT, *FAULTS, SWAPPED):
            own = [row for row in rows if (row["cameras"], row["fault"]) == (cameras, fault)]
            wrong = [row for row in own if row["whom"]]
            named = sum(named_by(row) for row in wrong)
            silent = sum(not named_by(row) and not set(row["whom"]) & set(row["unconfirmed"]) for row in wrong)
            false = sum(len(row["false"]) for row in own) + sum(row["refused"] and not row["whom"] for row in own)
            unsure = sum(len(set(row["unconfirmed"]) - set(row["whom"])) for row in own)
            counts = (len(own), named, len(wrong) - named - silent, silent, false, unsure)
            lines.append(f"| {cameras} | {fault} | {' | '.join(map(str, counts))} |")
    return "\n".join(lines)


def named_by(row: Mapping[str, Any]) -> bool:
    """Whether a fault is refused, or named, by camera or as one of the whole calibration."""
    return bool(row["refused"] or row["whole"] or row["named"])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("doubts", __doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; the table goes beside it as .md")
    parser.add_argument("--work", type=Path, help="folder of the captures (beside --out)")
    parser.add_argument("--most", type=int, default=4, help="cameras of each rig that a fault befalls in turn")
    parser.add_argument("--rooms", nargs="+", help="names of some rooms only, as ring6_1")
    args = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    args.out.parent.mkdir(parents=True, exist_ok=True)
    for room in ROOMS:
        if args.rooms and room.name not in args.rooms:
            continue
        rows += gather(room, args.work or args.out.with_suffix(""), args.most)
        args.out.write_text(json.dumps(rows, indent=1) + "\n")
        args.out.with_suffix(".md").write_text(table(rows) + "\n")
        print(f"{room.name}: {len(rows)} trials so far", flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
