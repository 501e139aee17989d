"""Whole runs of captures that something befalls, beside the same capture that nothing does.

    packuv bench mishaps --out bench/results/mishaps.json
    packuv bench mishaps --out runs/mishaps.json --mishaps "scene cut" "a camera dies"

A simulated room is filmed, what shall go wrong is done to the capture as a user would find it, and `packuv run` takes
it: exit code, findings that undisturbed capture does not have, and the picture on the camera that is not fitted. A row
that the file has of the same program is not run again.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from bench import command
from bench.skips import SETTINGS
from packuv.files import whole_file
from packuv.kernels.simd import cpu_description
from pipelines.batch.plan import program_digest
from pipelines.cli import main as packuv
from studio.capture import ColourOptions, SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from studio.film_set import MOVING
from studio.light import LightOptions
from studio.rig import PlacementOptions, RigKind
from studio.truth import read_truth
from studio.video import VideoWriter

CAMERA = "cam02"
"""Whom it befalls, where that is one camera: never the one that is scored"""
FPS = Fraction(30)
UNDISTURBED = "(nothing)"


def film(folder: Path, frames: int, size: str, **options: Any) -> Path:
    """Eight cameras in a row; all rooms are seen by the same rig, whatever their seed."""
    steady = {
        "seed": 7,
        "clock": ClockOptions(drop_share=0, max_late_frames=0),
        "rig": PlacementOptions(RigKind.FRONT, jitter_m=0),
        "colour": ColourOptions(exposure_spread=0, white_balance_spread=0),
        "truth": TruthKind.LIGHT,
        "name": "mishap",
    }
    simulate(folder, SimulateOptions(8, frames, size, **{**steady, **options}))
    return folder


def films(**options: Any) -> Callable[[Path, int, str], object]:
    """What the studio can do by itself."""
    return lambda folder, frames, size: film(folder, frames, size, **options)


def refilm(folder: Path, camera: str, pictures: Sequence[np.ndarray], lines: Sequence[str]) -> None:
    """Another video and other timecodes of a camera: uint8 [H, W, 3] each, and a line for each."""
    height, width = pictures[0].shape[:2]
    with VideoWriter(folder / "videos" / f"{camera}.mp4", width, height, FPS) as video:
        for picture in pictures:
            video.write(np.ascontiguousarray(picture))
    (folder / "timecodes" / f"{camera}.txt").write_text("".join(f"{line}\n" for line in lines))


def filmed(folder: Path, camera: str) -> tuple[list[np.ndarray], list[str]]:
    """All pictures of a camera, uint8 [H, W, 3], and its lines of timecode."""
    with av.open(str(folder / "videos" / f"{camera}.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return pictures, (folder / "timecodes" / f"{camera}.txt").read_text().splitlines()


def scene_cut(folder: Path, frames: int, size: str) -> None:
    """From the middle on another room, people elsewhere."""
    other = film(folder.with_name("other"), frames, size, seed=8)
    film(folder, frames, size)
    for video in sorted((folder / "videos").glob("*.mp4")):
        pictures, lines = filmed(folder, video.stem)
        refilm(folder, video.stem, [*pictures[: frames // 2], *filmed(other, video.stem)[0][frames // 2 :]], lines)
    shutil.rmtree(other)


def camera_dies(folder: Path, frames: int, size: str) -> None:
    """A camera whose recording ends in the middle."""
    pictures, lines = filmed(film(folder, frames, size), CAMERA)
    refilm(folder, CAMERA, pictures[: frames // 2], lines[: frames // 2])


def half_the_size(folder: Path, frames: int, size: str) -> None:
    """A camera that was set to half the size."""
    pictures, lines = filmed(film(folder, frames, size), CAMERA)
    height, width = (side // 4 * 2 for side in pictures[0].shape[:2])
    small = [np.asarray(cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA)) for one in pictures]
    refilm(folder, CAMERA, small, lines)


def half_the_rate(folder: Path, frames: int, size: str) -> None:
    """A camera that was set to half the rate; its video still says the rate of the others."""
    pictures, lines = filmed(film(folder, frames, size), CAMERA)
    refilm(folder, CAMERA, pictures[::2], lines[::2])


def dark_instants(folder: Path, frames: int, size: str) -> None:
    """Two instants at which the lamps are off."""
    film(folder, frames, size)
    for video in sorted((folder / "videos").glob("*.mp4")):
        pictures, lines = filmed(folder, video.stem)
        dark = [one // 64 if frames // 2 <= k < frames // 2 + 2 else one for k, one in enumerate(pictures)]
        refilm(folder, video.stem, dark, lines)


def empty_background(folder: Path, frames: int, size: str) -> None:
    """Nothing but people and things that move, before black."""
    film(folder, frames, size, truth=TruthKind.FULL)
    truth = read_truth(folder)
    for name, camera in truth.cameras.items():
        pictures, lines = filmed(folder, name)
        moving = [truth.objects.index(mover) for mover in truth.movers]
        shown = [
            np.where(np.isin(camera.frame(k).object, moving)[..., None], one, 0).astype(np.uint8)
            for k, one in enumerate(pictures)
        ]
        refilm(folder, name, shown, lines)
    shutil.rmtree(folder / "truth")


MISHAPS: Mapping[str, Callable[[Path, int, str], object]] = {
    UNDISTURBED: films(),
    "lamps fade and flicker": films(light=LightOptions(fade=0.3, flicker=0.1)),
    "an exposure jumps": films(light=LightOptions(exposure_jump=1.5)),
    "dark instants": dark_instants,
    "scene cut": scene_cut,
    "a camera dies": camera_dies,
    "half the size": half_the_size,
    "half the rate": half_the_rate,
    "empty background": empty_background,
    "nothing moves": films(movers=()),
    "everything moves": films(movers=MOVING, crowd=27),
}
"""By name, how its capture is made"""


def measure(capture: Path, out: Path) -> dict[str, Any]:
    """A whole run: what it ends with, what it says and how its pictures are."""
    said, wanted = io.StringIO(), ["run", str(capture), "--out", str(out), "--preset", "draft", "--direct"]
    for setting in SETTINGS:
        wanted += ["--set", setting]
    with contextlib.redirect_stderr(said):
        code = packuv(wanted)
    told = sorted(out.glob("*/report.json"))
    report: dict[str, Any] = json.loads(told[0].read_text()) if told else {}
    summary = report.get("summary", {})
    frames = [score["psnr_db"] for score in report.get("scores", [])]
    return {
        "exit_code": code,
        "last_line": (said.getvalue().strip().splitlines() or [""])[-1][-300:],
        "psnr_db": summary.get("psnr_db"),
        "worst_frame_db": min(frames, default=None),
        "ssim": summary.get("ssim"),
        "cuts": (report.get("motion") or {}).get("cuts"),
        "findings": [finding["text"] for finding in report.get("findings", [])],
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows in Markdown."""

    def figure(row: Mapping[str, Any], name: str, digits: int) -> str:
        return "" if row[name] is None else f"{row[name]:.{digits}f}"

    lines = ["| | code | PSNR, dB | worst frame | SSIM | what it says |", "|---|---:|---:|---:|---:|---|"]
    usual = {text for row in rows if row["mishap"] == UNDISTURBED for text in row["findings"]}
    for row in rows:
        own = [text for text in row["findings"] if text not in usual] if row["mishap"] != UNDISTURBED else []
        said = " ".join(own) or (row["last_line"] if row["exit_code"] else "")
        lines.append(
            f"| {row['mishap']} | {row['exit_code']} | {figure(row, 'psnr_db', 2)} | "
            f"{figure(row, 'worst_frame_db', 2)} | {figure(row, 'ssim', 3)} | {said} |"
        )
    return "\n".join(lines)


def run(work: Path, names: Sequence[str], frames: int, size: str, known: Sequence[Any]) -> Iterator[dict[str, Any]]:
    """Each mishap, as a row; `known` are rows of before."""
    for name in names:
        request = {"mishap": name, "frames": frames, "size": size, "program": program_digest()}
        row = next((one for one in known if one["request"] == request), None)
        if row is None:
            folder = work / name.strip("()").replace(" ", "_")
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            MISHAPS[name](folder / "capture", frames, size)
            row = {"mishap": name, **measure(folder / "capture", folder / "runs"), "request": request}
        yield dict(row)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("mishaps", __doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; the table goes beside it as .md")
    parser.add_argument("--work", type=Path, help="folder of the captures and runs (beside --out)")
    parser.add_argument("--mishaps", nargs="+", default=list(MISHAPS), choices=MISHAPS, metavar="MISHAP")
    parser.add_argument("--frames", type=int, default=16, help="of each capture")
    parser.add_argument("--size", default="320x180", metavar="WxH")
    given = parser.parse_args(arguments)
    known = json.loads(given.out.read_text())["rows"] if given.out.exists() else []
    given.out.parent.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for row in run(given.work or given.out.with_suffix(""), given.mishaps, given.frames, given.size, known):
        rows.append(row)
        there = [*rows, *(one for one in known if one["mishap"] not in {done["mishap"] for done in rows})]
        with whole_file(given.out) as part:
            part.write_text(json.dumps({"cpu": cpu_description(), "rows": there}, indent=1) + "\n")
        given.out.with_suffix(".md").write_text(table(there) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
