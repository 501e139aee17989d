"""The commands beside `packuv run`: make a synthetic capture, look at scene files, check, draw and score them.

What turns scenes into other programs' files, or those into scenes, is in `pipelines.commands.exchange`.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.commands.frames import frames_of
from pipelines.commands.terminal import print_facts, shown
from pipelines.disk import size_text
from pipelines.request import read_settings
from pipelines.words import counted
from tasks.artefacts.recipe import override
from tasks.artefacts.store import find_stores

if TYPE_CHECKING:
    import numpy as np

    from packuv.camera import PinholeCamera
    from packuv.film import CameraPath
    from packuv.scene import Scene, SceneHeader
    from packuv.scene.verify import VerifyReport
    from pipelines.filmed import Filmed

MOST_STARTS = 16
"""First frames of segments that `packuv info` names"""


def simulate(arguments: argparse.Namespace) -> int:
    """`packuv simulate`: a capture folder whose truth is known."""
    from studio.capture import SimulateOptions
    from studio.capture import simulate as film

    width, height = arguments.size
    plain = {name: getattr(arguments, name) for name in ("cameras", "frames", "fps", "seed")}
    named = {**plain, "size": f"{width}x{height}", "rig": {"kind": arguments.rig}}
    options = override(override(SimulateOptions(), named), read_settings(None, arguments.set))
    with shown(arguments, "simulate") as progress:
        film(arguments.out, options, progress)
    print(f"{arguments.out}: {options.cameras} cameras, {options.frames} instants, {options.size}; truth in truth/")
    return 0


def info(arguments: argparse.Namespace) -> int:
    """`packuv info`: what the header of a scene says."""
    from packuv.scene import open_scene

    with open_scene(arguments.scene) as scene:
        index = scene.index
        header = index.header
        size = arguments.scene.stat().st_size
        facts: dict[str, Any] = {
            "file": str(arguments.scene),
            "bytes": size,
            "frames": len(scene),
            "rate": str(header.rate),
            "seconds": header.seconds,
            "bytes_per_frame": size / len(scene),
            "sh_degree": header.quantizer.sh_degree,
            "light": _light_range(header.light),
            "sound": index.sound and {**vars(index.sound), "seconds": index.sound.seconds},
            "lossless": scene.lossless,
            "compression": _compression(header.extra, size),
            "tolerance": vars(index.tolerance),
            "cameras": [camera.name for camera in header.cameras],
            "held_out": list(header.held_out),
            "segments": [
                {"first": s.first, "frames": s.frames, "gaussians": s.rows, "dynamic": s.dynamic}
                for s in index.segments
            ],
            "sync": dict(header.sync),
            "extra": dict(header.extra),
            "tools": dict(index.tools),
        }
    print_facts(facts, arguments.json, _info_text)
    return 0


def _compression(extra: Mapping[str, Any], size: int) -> dict[str, Any] | None:
    """What a compressed scene says of itself; None for one that is as it was fitted."""
    from packuv.bounds import field, fields, finite
    from packuv.scene.header import COMPRESSION

    if COMPRESSION not in extra:
        return None
    what = f"the scene's header: extra: {COMPRESSION}"
    said = fields(extra[COMPRESSION], what)
    names = ("source_bytes", "psnr_db", "loss_db", "fitted_db")
    known = {name: finite(field(said, name, what), f"{what}: {name}") for name in names}
    return {**known, "ratio": known["source_bytes"] / size, "imagined": "imagined" in said}


def _light_range(light: np.ndarray) -> list[float] | None:
    """Least and most of any channel, as factors on linear light; None where it is steady."""
    return [math.exp(light.min()), math.exp(light.max())] if light.any() else None


def _info_text(facts: Mapping[str, Any]) -> str:
    counts = [segment["gaussians"] for segment in facts["segments"]]
    moving = [segment["dynamic"] for segment in facts["segments"]]
    held_out = f" (held out: {', '.join(facts['held_out'])})" if facts["held_out"] else ""
    within = "within {position} steps of a position and {attribute} of any other code, of what was fitted"
    lights = ["light      {:.1%} to {:.1%} of steady light".format(*facts["light"])] if facts["light"] else []
    sounds = ["sound      {codec}, {seconds:.2f} s, of {camera}".format(**facts["sound"])] if facts["sound"] else []
    exact = "exactly as fitted" if facts["lossless"] else within.format(**facts["tolerance"])
    if made := facts["compression"]:
        views = " from imagined views" if made["imagined"] else ""
        exact = (
            "lossy, {ratio:.2f} times smaller than the lossless scene; pictures {psnr_db:.2f} dB to its{views}, a loss "
            "of {loss_db:.3f} dB where it has {fitted_db:.2f} dB against footage"
        ).format(**made, views=views)
    return "\n".join(
        [
            f"{facts['file']}: {size_text(facts['bytes'])}, {size_text(facts['bytes_per_frame'])} a frame",
            f"frames     {facts['frames']} at {facts['rate']} per second, {facts['seconds']:.2f} s",
            f"segments   {len(counts)}, from frame {_starts(facts['segments'])}",
            f"gaussians  {min(counts):,} to {max(counts):,}, of which {min(moving):,} to {max(moving):,} move; "
            f"SH degree {facts['sh_degree']}",
            f"codes      {exact}",
            *lights,
            *sounds,
            f"cameras    {len(facts['cameras'])}{held_out}",
            f"tools      {', '.join(f'{name} {version}' for name, version in facts['tools'].items())}",
        ]
    )


def _starts(segments: Sequence[Mapping[str, Any]]) -> str:
    """First frames; of many segments the first few, and how long they are."""
    firsts = [str(segment["first"]) for segment in segments[:MOST_STARTS]]
    if len(segments) <= MOST_STARTS:
        return ", ".join(firsts)
    lengths = [segment["frames"] for segment in segments]
    return f"{', '.join(firsts)} and so on, {min(lengths)} to {max(lengths)} frames each (--json lists all)"


def verify(arguments: argparse.Namespace) -> int:
    """`packuv verify`: exit code 1 if anything differs from what was written."""
    return _verify_store(arguments) if arguments.store else _verify_scene(arguments)


def _verify_scene(arguments: argparse.Namespace) -> int:
    from packuv.scene import verify_scene

    with shown(arguments, "verify") as progress:
        report = verify_scene(arguments.scene, progress=progress)
    facts = {**vars(report), "ok": report.ok}
    print_facts(facts, arguments.json, lambda _: "\n".join(_verify_lines(arguments.scene, report)))
    return 0 if report.ok else 1


def _verify_lines(scene: Path, report: VerifyReport) -> Iterator[str]:
    if report.header:
        yield f"damaged    {report.header}"
    if report.bad:
        yield f"{scene}: {len(report.bad)} of {counted(report.frames, 'frame')} are damaged: {report.problem}"
    else:
        yield f"{scene}: all {report.frames} frames decode to exactly what was written"


def _verify_store(arguments: argparse.Namespace) -> int:
    stores = find_stores(arguments.store)
    count = sum(len(list(store.keys())) for store in stores)
    damage = [(store, found) for store in stores for found in store.verify()]
    absent = sum(len(store.absent()) for store in stores)
    facts = {
        "artefacts": count,
        "absent": absent,
        "damage": [{"artefact": str(d.key), "path": d.path, "reason": d.reason} for _, d in damage],
        "ok": not damage,
    }
    lines = [f"{found}; delete {store.root / str(found.key)} and run again" for store, found in damage]
    if absent:
        lines.append(f"{absent} artefacts that others were made from are gone; a run makes again what it needs")
    lines.append(f"{count} artefacts in {len(stores)} stores, {len(damage) or 'no'} damaged files")
    print_facts(facts, arguments.json, lambda _: "\n".join(lines))
    return 1 if damage else 0


def render(arguments: argparse.Namespace) -> int:
    """`packuv render`: <frame>.png for each frame in its light, numbered as in the scene."""
    from packuv.colour import lit
    from packuv.files import whole_file
    from packuv.fit.device import choose_device
    from packuv.scene import open_scene
    from packuv.score import Artist, write_picture

    device = choose_device(arguments.device)
    with open_scene(arguments.scene) as scene, shown(arguments, "render") as progress:
        camera = _camera(arguments.camera, scene.header.cameras)
        if arguments.size:
            camera = camera.scaled(*arguments.size)
        frames = frames_of(len(scene), arguments.frames)
        arguments.output.mkdir(parents=True, exist_ok=True)
        artist = Artist(scene, device)
        for done, frame in enumerate(frames, start=1):
            picture = lit(artist.draw(scene.gaussians(frame), camera), scene.light(frame))
            with whole_file(arguments.output / f"{frame:06d}.png") as part:
                write_picture(part, picture)
            progress(done, len(frames))
    size = f"{camera.width}x{camera.height}"
    print(f"{arguments.output}: {len(frames)} pictures of camera {camera.name}, {size}")
    return 0


def film(arguments: argparse.Namespace) -> int:
    """`packuv film`: one MP4 along a camera path."""
    from packuv.film import CameraPath
    from packuv.film import film as shoot
    from packuv.fit.device import choose_device
    from packuv.scene import open_scene

    if arguments.output.suffix.lower() != ".mp4":
        raise ValueError(f"the film becomes an MP4, so its name must end with .mp4, but is {arguments.output.name}")
    path, device = CameraPath.load(arguments.path), choose_device(arguments.device)
    with open_scene(arguments.scene) as scene, shown(arguments, "film") as progress:
        camera, sound = _sound_of(scene, arguments, path)
        count = shoot(
            scene, path, arguments.output, progress, rate=arguments.fps, size=arguments.size, device=device, sound=sound
        )
    heard = f", sound of {camera}" if camera else ""
    print(f"{arguments.output}: {count} pictures, {path.seconds:g} s, {len(path.views)} views{heard}")
    return 0


def _sound_of(scene: Scene, arguments: argparse.Namespace, path: CameraPath) -> tuple[str, np.ndarray | None]:
    """The camera that heard what a film shows, and its sound: of the capture that is named, or else of the scene, or
    of the run's own capture, with a note where that has changed."""
    from packuv.film import SOUND_RATE

    if arguments.capture:
        return _heard(scene.header, arguments.capture, path)
    if sound := scene.sound():
        start, count = (round(seconds * SOUND_RATE) for seconds in _span(scene.header, path))
        return sound.camera, sound.samples(start, count)
    capture = _capture_of(arguments.scene.parent)
    try:
        return _heard(scene.header, capture, path) if capture else ("", None)
    except (OSError, ValueError) as error:
        print(f"packuv: the film has no sound: {error}", file=sys.stderr)
        return "", None


def _heard(header: SceneHeader, capture: Path, path: CameraPath) -> tuple[str, np.ndarray | None]:
    """What the reference camera, or else another one of the capture, heard from the earliest frame on that a path
    shows, and its name; no name where none heard anything."""
    from packuv.film import SOUND_RATE
    from sync.capture import find_capture
    from sync.content.sound import listen_to_one
    from tasks.stages.encode import in_turn
    from tasks.stages.evaluate import filmed_views, known_cameras, match

    names = known_cameras(header)
    frames = filmed_views(header, match(header, capture), names).frames  # [T, C], -1 where a camera has none
    first = min(min(view.frame for view in path.views), len(frames) - 1)
    asked = in_turn(dict(zip(names, map(int, frames[first]), strict=True)), header)
    return listen_to_one(find_capture(capture).videos, asked, _span(header, path)[1], SOUND_RATE) or ("", None)


def _span(header: SceneHeader, path: CameraPath) -> tuple[float, float]:
    """Seconds of the scene from its first frame to the earliest that a path shows, and from that to the end of the
    last."""
    shown = [min(view.frame, len(header.times_ns) - 1) for view in path.views]
    earliest, latest = (header.seconds_to(frame) for frame in (min(shown), max(shown)))
    return earliest, latest - earliest + float(1 / header.rate)


def _camera(name: str, known: Sequence[PinholeCamera]) -> PinholeCamera:
    """A camera of the scene by name, or one from a JSON file in the scene's own form."""
    from packuv.bounds import fields
    from packuv.camera import PinholeCamera
    from packuv.files import load_json

    for camera in known:
        if camera.name == name:
            return camera
    if not Path(name).is_file():
        names = ", ".join(camera.name for camera in known)
        raise ValueError(f"{name!r} is neither a camera of the scene nor a file; the scene has {names}")
    try:
        said = fields(load_json(Path(name)), "a camera")
        return PinholeCamera.from_json({"name": Path(name).stem, **said})
    except ValueError as error:
        raise ValueError(f"{name} is no camera in JSON: {error}") from None


def evaluate(arguments: argparse.Namespace) -> int:
    """`packuv eval`: every frame against what cameras filmed, by the definitions of docs/scores.md."""
    from packuv.fit.device import choose_device
    from tasks.stages.evaluate import EvaluateOptions, evaluate_scene

    device = choose_device(arguments.device)
    options = EvaluateOptions(lpips_weights=arguments.lpips_weights)
    with shown(arguments, "evaluate") as progress:
        facts = evaluate_scene(
            arguments.scene, arguments.capture, arguments.cameras, options, progress=progress, device=device
        )
    print_facts(facts, arguments.json, _scores_text)
    return 0


def _scores_text(facts: Mapping[str, Any]) -> str:
    rows = {**facts["by_camera"], "mean": facts["mean"]}
    kinds = {"_calibrated": "calibrated", "": "raw", "_own": "own gain"}
    lines = [f"{'camera':<12}" + "".join(f"{text:>22}" for text in kinds.values())]
    for name, means in rows.items():
        lines.append(f"{name:<12}" + "".join(f"{_score_text(means, kind):>22}" for kind in kinds))
    lines += _figures_text("calibrated", rows, _APART)
    if "psnr_foreground_db" in facts["mean"]:
        lines += _figures_text("foreground", rows, _FOREGROUND)
    for name, why in facts.get("doubtful_masks", {}).items():
        lines.append(f"masks of {name} are not used: {why}")
    what = "held out, never fitted" if facts["held_out"] else "not all held out"
    lines.append(f"{counted(facts['frames'], 'frame')}, {size_text(facts['bytes_per_frame'])} a frame; cameras {what}")
    return "\n".join(lines)


_APART = {
    "moving dB": ("psnr_moving_db", ".2f"),
    "still dB": ("psnr_still_db", ".2f"),
    "never moving dB": ("psnr_never_moving_db", ".2f"),
    "still, trend": ("still_trend_db", "+.2f"),
    "tOF px": ("tof_px", ".3f"),
    "flicker": ("flicker", ".4f"),
    "LPIPS": ("lpips", ".4f"),
}
"""Heads of columns: the figure, and its form"""
_FOREGROUND = {
    "PSNR dB": ("psnr_foreground_db", ".2f"),
    "SSIM": ("ssim_foreground", ".4f"),
    "LPIPS": ("lpips_foreground", ".4f"),
    "share": ("foreground_share", ".3f"),
}


def _figures_text(
    head: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, tuple[str, str]]
) -> list[str]:
    """A table, after a line of nothing."""
    lines = ["", f"{head:<12}" + "".join(f"{text:>16}" for text in columns)]
    for name, means in rows.items():
        lines.append(f"{name:<12}" + "".join(f"{_figure(means[key], how):>16}" for key, how in columns.values()))
    return lines


def _figure(value: float | None, how: str) -> str:
    return "-" if value is None else format(value, how)


def _score_text(means: Mapping[str, float | None], kind: str) -> str:
    decibel = means[f"psnr{kind}_db"]
    level = "exact" if decibel is None else f"{decibel:.2f} dB"
    return f"{level}, {means[f'ssim{kind}']:.4f}"


def view(arguments: argparse.Namespace) -> int:
    """`packuv view`: until Ctrl-C."""
    from packuv.viewer.server import LOOPBACK
    from pipelines.commands.preview import view_run
    from pipelines.register import goes_on
    from tasks.stages.encode import SCENE

    if (capture := arguments.capture) and not capture.is_dir():
        raise FileNotFoundError(f"no capture folder {capture}; name the one that the scene was made from, or none")
    if arguments.host not in LOOPBACK:
        told = f"packuv: everyone who can reach {arguments.host} sees this scene, without a password; end with Ctrl-C"
        print(told, file=sys.stderr)
    if not arguments.scene.is_dir():
        _view_scene(arguments.scene, arguments)
        return 0
    folder = _sequence_in(arguments.scene)
    if (folder / SCENE).exists() and not goes_on(folder):
        _view_scene(folder / SCENE, arguments)
    else:
        view_run(folder, arguments.capture or _capture_of(folder), arguments.host, arguments.port)
    return 0


def _view_scene(path: Path, arguments: argparse.Namespace) -> None:
    from packuv.scene import open_scene
    from packuv.viewer import serve

    worst, capture = _worst_frame(path.parent), arguments.capture or _capture_of(path.parent)
    with open_scene(path) as scene:
        truth = filmed(scene.header, capture) if capture else None
    serve(path, host=arguments.host, port=arguments.port, open_browser=True, worst=worst, truth=truth)


def _sequence_in(folder: Path) -> Path:
    """The folder of the one sequence that a run's --out holds, or this is; raises ValueError for several."""
    from pipelines.commands.watch import sequence_folders

    found = sequence_folders(folder)
    if len(found) > 1:
        raise ValueError(f"{folder} holds {len(found)} sequences, {', '.join(path.name for path in found)}; name one")
    return found[0]


def filmed(header: SceneHeader, capture: Path) -> Filmed:
    """What a capture's cameras filmed at the frames of a scene."""
    import numpy as np

    from pipelines.filmed import Filmed
    from tasks.stages.evaluate import filmed_views, known_cameras, match

    cameras = known_cameras(header)
    instants = np.arange(len(header.times_ns))
    return Filmed(cameras, lambda: filmed_views(header, match(header, capture), cameras), instants, header.light)


def _capture_of(folder: Path) -> Path | None:
    """Of the run that a folder is of, be it under way or the last one, where it is still there."""
    from pipelines.register import find_runs

    runs = find_runs(folder)
    try:
        told = json.loads((folder / "run.json").read_text()) if not runs else {}
        capture = Path(runs[-1].record.capture if runs else told["request"]["capture"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return capture if capture.is_dir() else None


def _worst_frame(folder: Path) -> int | None:
    """That the report in a folder tells; None where there is none."""
    from tasks.report.facts import FrameScore, mean_by_frame

    try:
        scores = json.loads((folder / "report.json").read_text())["scores"]
        means = mean_by_frame([FrameScore(one["camera"], one["frame"], one["psnr_db"], one["ssim"]) for one in scores])
    except (OSError, ValueError, KeyError, TypeError):  # a viewer shows scenes without reports, too
        return None
    return min(means, key=lambda frame: means[frame]) if means else None
