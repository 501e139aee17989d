"""What foreground masks gain: a simulated capture is processed without masks and with exact ones.

    packuv simulate runs/front --cameras 8 --frames 15 --size 240x136 --seed 5 --rig front --set held_out=2 \\
      --set clock.drop_share=0 --set entrance_share=0 --set movers=walker,visitor,ball,inflatable
    packuv bench masks runs/front --folder runs/masks --out bench/results/masks.json

Masks cover, to the pixel, what moves. `recall` is the share of points on what moves, as cameras see it that nobody
fits, that lie in the hull from which keyframes start; `precision` the share of points in the hull that these cameras
have before them. Both by what a fitted camera's foreground is taken from. Then what whole runs score on these cameras.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench import command
from bench.forecast import request_of
from packuv.files import load_json
from packuv.fit.keyframe import KeyState, unlike_background
from packuv.fit.options import NextOptions
from packuv.fit.start.hull import hull_points, in_hull
from packuv.fit.start.points import pixels_of
from packuv.footage import Silhouettes, Views
from packuv.motion import load_stills
from packuv.progress import no_progress
from pipelines.cli import main as packuv
from pipelines.process import find_sequence, options_of
from studio.truth import Truth, read_truth
from tasks.artefacts.retention import RUN
from tasks.artefacts.stage import Files, Site
from tasks.artefacts.store import Key
from tasks.stages.evaluate import EvaluateOptions, evaluate_scene
from tasks.stages.fitting import STILLS
from tasks.stages.footage import Footage, MaskedTake

POINTS = 4000
FITS = ("background", "backdrop", "key", "segment")
"""Artefacts that masks change"""
SCORES = ("psnr_calibrated_db", "ssim_calibrated", "psnr_moving_db", "psnr_foreground_db", "ssim_foreground")
Pick = Callable[[np.ndarray, np.ndarray], np.ndarray]
HULLS: Mapping[str, Pick] = {
    "background": lambda standing, mask: standing,
    "mask": lambda standing, mask: mask,
    "both": lambda standing, mask: standing & mask,
    "either": lambda standing, mask: standing | mask,
}
"""What counts as foreground, of what the background lacks and the mask: bool [H, W] each"""


@dataclass(frozen=True)
class Movers:
    """What moves in a simulated capture, to the pixel."""

    truth: Truth
    numbers: Sequence[int]
    """Of the things that were set to move"""

    @classmethod
    def of(cls, capture: Path) -> Movers:
        truth, told = read_truth(capture), load_json(capture / "truth" / "truth.json")
        return cls(truth, [truth.objects.index(name) for name in told["options"]["movers"]])

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """Where a frame of a camera shows them, bool [H, W]."""
        return np.isin(self.truth.cameras[camera].frame(frame).object, self.numbers)

    def depth(self, camera: str, frame: int) -> np.ndarray:
        """float32 [H, W], metres."""
        return self.truth.cameras[camera].frame(frame).depth


def prepare(capture: Path, folder: Path) -> dict[str, Path]:
    """Captures without masks and with those of what moves, by links, in `folder`."""
    movers = Movers.of(capture)
    made = {name: folder / name for name in ("plain", "masked")}
    for place in made.values():
        place.mkdir(parents=True, exist_ok=True)
        for part in ("videos", "timecodes", "calibration", "capture.toml"):
            if not (place / part).exists():
                (place / part).symlink_to((capture / part).resolve())
    for name, camera in movers.truth.cameras.items():
        own = made["masked"] / "masks" / name
        own.mkdir(parents=True, exist_ok=True)
        for frame in range(len(camera)):
            cv2.imwrite(str(own / f"{frame:06d}.png"), 255 * movers.mask(name, frame).astype(np.uint8))
    return made


def process(capture: Path, out: Path, settings: Sequence[str]) -> Path:
    """Run it; the folder of its results."""
    sets = [word for setting in settings for word in ("--set", setting)]
    if code := packuv(["run", str(capture), "--out", str(out), "--preset", "draft", "--direct", *sets]):
        raise RuntimeError(f"packuv run {capture} ended with exit code {code}; see above")
    (folder,) = (path.parent for path in out.glob(f"*/{RUN}"))
    return folder


def scored(folder: Path, masked: Path) -> dict[str, float]:
    """CPU-seconds of the fits, size of the scene and scores of the unseen cameras, whose masks are in `masked`."""
    made = json.loads((folder / RUN).read_text())["artefacts"]
    facts = evaluate_scene(folder / "scene.mkv", masked, None, EvaluateOptions(), progress=no_progress)
    spent = sum(item["cpu_seconds"] for item in made if item["artefact"].partition("/")[0] in FITS)
    return {"cpu_seconds": spent, "bytes": facts["bytes"], **{name: facts["mean"][name] for name in SCORES}}


class Hulls:
    """Hulls of one instant of the run in a folder, beside the truth."""

    def __init__(self, folder: Path, masked: Path, movers: Movers) -> None:
        told = json.loads((folder / RUN).read_text())
        keys = dict[str, Key]()
        for item in told["artefacts"]:
            stage, _, digest = item["artefact"].partition("/")
            keys.setdefault(stage, Key(stage, digest))
        self.site, self.movers = Site(folder / "store", masked.resolve(), 2), movers
        request = request_of(told)
        options = options_of(request, find_sequence(request), request.preset)
        self.motion, self.options = options.motion, options.fit.part(NextOptions)
        self._keys = keys
        self.stills = load_stills(self.site.path(keys["background"]) / STILLS)
        self.bounds = KeyState.load(self.site.path(keys["backdrop"])).bounds
        self.fitted, self.unseen = (self._footage(told["cameras"][name]) for name in ("fitted", "held_out"))

    def _footage(self, names: Sequence[str]) -> tuple[Views, Silhouettes, np.ndarray]:
        """Pictures, foreground and frames int [T, C]."""
        masks = Files(dict.fromkeys(self.movers.truth.cameras, ""))
        take = MaskedTake(groups=self._keys["sync"], rig=self._keys["points"], cameras=tuple(names), masks=masks)
        footage = Footage(take, self.site)
        silhouettes = footage.open_silhouettes()
        assert silhouettes is not None
        frames = footage.load_frames()
        return footage.open_views(), silhouettes, np.stack([frames[name] for name in names], axis=1)

    def __len__(self) -> int:
        return len(self.fitted[0])

    def measure(self, instant: int, pick: Pick) -> dict[str, float]:
        """Recall and precision of the hull of one kind of foreground."""
        views, silhouettes, _ = self.fitted
        standing = unlike_background(views, instant, self.stills, self.motion)
        cameras, masks, pictures = [], [], []
        for index, camera in enumerate(views.cameras):
            own, mask = standing[index], silhouettes.of(camera.name, instant)
            picture = views.picture(index, instant)
            if own is not None and mask is not None and picture is not None:
                cameras.append(camera)
                masks.append(pick(own, mask))
                pictures.append(picture)
        rng, start = np.random.default_rng(instant), self.options.start
        true = self._surface(instant, rng)
        recall = in_hull(true, cameras, masks, bounds=self.bounds, options=start).mean()
        points = hull_points(cameras, pictures, masks, bounds=self.bounds, options=start, count=POINTS, rng=rng)
        return {"recall": float(recall), "precision": float(self._before(points.xyz, instant).mean())}

    def _surface(self, instant: int, rng: np.random.Generator) -> np.ndarray:
        """Points on what can move as unseen cameras see it, float64 [n, 3], world."""
        views, _, frames = self.unseen
        found = []
        for index, camera in enumerate(views.cameras):
            if (frame := int(frames[instant, index])) < 0:
                continue
            rows, columns = np.nonzero(self.movers.mask(camera.name, frame))
            depth = self.movers.depth(camera.name, frame)[rows, columns]
            x, y = columns + 0.5 - camera.cx, rows + 0.5 - camera.cy
            local = np.stack([x / camera.fx * depth, y / camera.fy * depth, depth], axis=1)
            found.append((local - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3])
        return rng.permutation(np.concatenate(found))[:POINTS]

    def _before(self, xyz: np.ndarray, instant: int) -> np.ndarray:
        """Which points lie in the foreground of all unseen cameras that see them, bool [those that one sees]."""
        views, silhouettes, _ = self.unseen
        seen, inside = np.zeros(len(xyz), bool), np.ones(len(xyz), bool)
        for camera in views.cameras:
            if (mask := silhouettes.of(camera.name, instant)) is not None:
                there, rows, columns = pixels_of(camera, xyz, self.bounds.near)
                seen |= there
                inside[there] &= mask[rows, columns]
        return inside[seen]


def hulls(folder: Path, masked: Path, movers: Movers) -> dict[str, dict[str, float]]:
    """Mean recall and precision over three instants, by kind of foreground."""
    found = Hulls(folder, masked, movers)
    instants = np.linspace(0, len(found) - 1, 5).round().astype(int)[1:4]
    rows = {kind: [found.measure(int(instant), pick) for instant in instants] for kind, pick in HULLS.items()}
    return {kind: {name: float(np.mean([row[name] for row in own])) for name in own[0]} for kind, own in rows.items()}


def table(found: Mapping[str, Any]) -> str:
    """As Markdown."""
    lines = ["| foreground by | recall | precision |", "|---|---|---|"]
    lines += [f"| {kind} | {row['recall']:.3f} | {row['precision']:.3f} |" for kind, row in found["hulls"].items()]
    heads = "run", "CPU s", "MB", "PSNR", "SSIM", "PSNR where it moves", "PSNR of the foreground", "SSIM of it"
    lines += ["", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, row in found["runs"].items():
        scores = " | ".join(f"{row[score]:.2f}" if score.endswith("db") else f"{row[score]:.3f}" for score in SCORES)
        lines.append(f"| {name} | {row['cpu_seconds']:.0f} | {row['bytes'] / 1e6:.2f} | {scores} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("masks", __doc__)
    parser.add_argument("capture", type=Path, help="simulated, with full truth and held-out cameras")
    parser.add_argument("--folder", type=Path, required=True, help="for captures by links, and their runs")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; the tables go beside it as .md")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="settings of both runs")
    args = parser.parse_args(arguments)
    made = prepare(args.capture, args.folder)
    runs = {name: process(path, args.folder / f"runs_{name}", args.set) for name, path in made.items()}
    found = {
        "hulls": hulls(runs["plain"], made["masked"], Movers.of(args.capture)),
        "runs": {name: scored(folder, made["masked"]) for name, folder in runs.items()},
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    args.out.with_suffix(".md").write_text(table(found) + "\n")
    print(table(found))


if __name__ == "__main__":
    main()
