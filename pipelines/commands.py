"""The commands beside `packuv run`: look at scene files, score them, take pictures and single frames out of them."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.progress import TerminalProgress
from pipelines.request import read_settings
from tasks.recipe import override
from tasks.store import Store

if TYPE_CHECKING:
    from packuv.camera import PinholeCamera


def simulate(arguments: argparse.Namespace) -> int:
    """`packuv simulate`: a capture folder whose truth is known."""
    from studio.capture import SimulateOptions
    from studio.capture import simulate as film

    width, height = arguments.size
    plain = {name: getattr(arguments, name) for name in ("cameras", "frames", "fps", "seed")}
    named = {**plain, "size": f"{width}x{height}", "rig": {"kind": arguments.rig}}
    options = override(override(SimulateOptions(), named), read_settings(None, arguments.set))
    with _shown(arguments, "simulate") as progress:
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
            "seconds": float((header.times_ns[-1] - header.times_ns[0]) / 1e9 + 1 / header.rate),
            "bytes_per_frame": size / len(scene),
            "sh_degree": header.quantizer.sh_degree,
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
    _print(facts, arguments.json, _info_text)
    return 0


def _info_text(facts: Mapping[str, Any]) -> str:
    counts = [segment["gaussians"] for segment in facts["segments"]]
    moving = [segment["dynamic"] for segment in facts["segments"]]
    held_out = f" (held out: {', '.join(facts['held_out'])})" if facts["held_out"] else ""
    return "\n".join(
        [
            f"{facts['file']}: {_size(facts['bytes'])}, {_size(facts['bytes_per_frame'])} a frame",
            f"frames     {facts['frames']} at {facts['rate']} per second, {facts['seconds']:.2f} s",
            f"segments   {len(counts)}, from frame {', '.join(str(s['first']) for s in facts['segments'])}",
            f"gaussians  {min(counts):,} to {max(counts):,}, of which {min(moving):,} to {max(moving):,} move; "
            f"SH degree {facts['sh_degree']}",
            f"cameras    {len(facts['cameras'])}{held_out}",
            f"tools      {', '.join(f'{name} {version}' for name, version in facts['tools'].items())}",
        ]
    )


def verify(arguments: argparse.Namespace) -> int:
    """`packuv verify`: exit code 1 if anything differs from what was written."""
    return _verify_store(arguments) if arguments.store else _verify_scene(arguments)


def _verify_scene(arguments: argparse.Namespace) -> int:
    from packuv.scene import verify_scene

    with _shown(arguments, "verify") as progress:
        report = verify_scene(arguments.scene, progress=progress)
    facts = {"frames": report.frames, "bad": list(report.bad), "problem": report.problem, "ok": report.ok}
    good = f"{arguments.scene}: all {report.frames} frames decode to exactly what was fitted"
    bad = f"{arguments.scene}: {len(report.bad)} of {report.frames} frames are damaged: {report.problem}"
    _print(facts, arguments.json, lambda _: good if report.ok else bad)
    return 0 if report.ok else 1


def _verify_store(arguments: argparse.Namespace) -> int:
    stores = [Store(path) for path in _stores(arguments.store)]
    count = sum(len(list(store.keys())) for store in stores)
    damage = [(store, found) for store in stores for found in store.verify()]
    facts = {
        "artefacts": count,
        "damage": [{"artefact": str(d.key), "path": d.path, "reason": d.reason} for _, d in damage],
        "ok": not damage,
    }
    lines = [f"{found}; delete {store.root / str(found.key)} and run again" for store, found in damage]
    lines.append(f"{count} artefacts in {len(stores)} stores, {len(damage) or 'no'} damaged files")
    _print(facts, arguments.json, lambda _: "\n".join(lines))
    return 1 if damage else 0


def _stores(folder: Path) -> list[Path]:
    """The store itself, the store of a sequence, or the stores of all sequences of an output folder."""
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}")
    for found in ([folder] if folder.name == "store" else [], [folder / "store"], sorted(folder.glob("*/store"))):
        if present := [path for path in found if path.is_dir()]:
            return present
    raise FileNotFoundError(f"{folder} holds no artefact store; name the folder that `packuv run --out` wrote")


def export(arguments: argparse.Namespace) -> int:
    """`packuv export`: one frame as a file of another program."""
    from packuv.interchange import write_ply
    from packuv.scene import open_scene

    with open_scene(arguments.scene) as scene:
        _check_frame(arguments.frame, len(scene))
        count = write_ply(arguments.output, scene.gaussians(arguments.frame))
    print(f"{arguments.output}: {count:,} Gaussians of frame {arguments.frame}")
    return 0


def _check_frame(frame: int, count: int) -> None:
    if not 0 <= frame < count:
        raise ValueError(f"the scene has frames 0 to {count - 1}, but frame {frame} is asked for")


def render(arguments: argparse.Namespace) -> int:
    """`packuv render`: <frame>.png for each frame, numbered as in the scene."""
    from packuv.scene import open_scene
    from tasks.evaluate import Artist, frames_of, write_picture

    _check_device(arguments.device)
    with open_scene(arguments.scene) as scene, _shown(arguments, "render") as progress:
        camera = _camera(arguments.camera, scene.header.cameras)
        if arguments.size:
            camera = camera.scaled(*arguments.size)
        frames = frames_of(scene, *arguments.frames)
        arguments.output.mkdir(parents=True, exist_ok=True)
        artist = Artist(scene)
        for done, frame in enumerate(frames, start=1):
            write_picture(arguments.output / f"{frame:06d}.png", artist.draw(scene.gaussians(frame), camera))
            progress(done, len(frames))
    size = f"{camera.width}x{camera.height}"
    print(f"{arguments.output}: {len(frames)} pictures of camera {camera.name}, {size}")
    return 0


def _camera(name: str, known: Sequence[PinholeCamera]) -> PinholeCamera:
    """A camera of the scene by name, or one from a JSON file in the scene's own form."""
    from packuv.camera import PinholeCamera

    for camera in known:
        if camera.name == name:
            return camera
    if not Path(name).is_file():
        names = ", ".join(camera.name for camera in known)
        raise ValueError(f"{name!r} is neither a camera of the scene nor a file; the scene has {names}")
    try:
        return PinholeCamera.from_json({"name": Path(name).stem, **json.loads(Path(name).read_text())})
    except (json.JSONDecodeError, TypeError) as error:
        raise ValueError(f"{name} is no camera in JSON: {error}") from None


def _check_device(device: str) -> None:
    if device == "cuda":
        raise ValueError("this version renders on the CPU only; use --device auto or cpu")


def evaluate(arguments: argparse.Namespace) -> int:
    """`packuv eval`: PSNR and SSIM of every frame against what cameras filmed."""
    from tasks.evaluate import EvaluateOptions, evaluate_scene

    _check_device(arguments.device)
    with _shown(arguments, "evaluate") as progress:
        facts = evaluate_scene(
            arguments.scene, arguments.capture, arguments.cameras, EvaluateOptions(), progress=progress
        )
    _print(facts, arguments.json, _scores_text)
    return 0


def _scores_text(facts: Mapping[str, Any]) -> str:
    kinds = {"_rig": "common colour", "": "as filmed", "_own": "own gain"}
    lines = [f"{'camera':<12}" + "".join(f"{text:>22}" for text in kinds.values())]
    for name, means in {**facts["by_camera"], "mean": facts["mean"]}.items():
        lines.append(f"{name:<12}" + "".join(f"{_score_text(means, kind):>22}" for kind in kinds))
    what = "held out, never fitted" if facts["held_out"] else "not all held out"
    lines.append(f"{facts['frames']} frames, {_size(facts['bytes_per_frame'])} a frame; cameras {what}")
    return "\n".join(lines)


def _score_text(means: Mapping[str, float | None], kind: str) -> str:
    decibel = means[f"psnr{kind}_db"]
    level = "exact" if decibel is None else f"{decibel:.2f} dB"
    return f"{level}, {means[f'ssim{kind}']:.4f}"


def view(arguments: argparse.Namespace) -> int:
    """`packuv view`: until Ctrl-C."""
    from packuv.viewer import serve

    serve(arguments.scene, port=arguments.port, open_browser=True)
    return 0


def doctor(arguments: argparse.Namespace) -> int:
    """`packuv doctor`: exit code 1 if something is missing that every run needs."""
    found = list(_examine())
    for name, state, needed in found:
        print(f"{'ok' if state[0] else 'MISSING' if needed else 'absent':<8} {name:<12} {state[1]}")
    return 0 if all(state[0] or not needed for _, state, needed in found) else 1


def _examine() -> Iterator[tuple[str, tuple[bool, str], bool]]:
    """What, whether and in which version it is there, and whether runs need it."""
    yield "python", (sys.version_info >= (3, 11), platform.python_version()), True
    yield "cores", (True, f"{len(os.sched_getaffinity(0))}"), True
    yield "memory", _memory(), True
    disk = shutil.disk_usage(Path.cwd())
    yield "disk", (disk.free > 2**30, f"{_size(disk.free)} free here"), True
    yield "ffmpeg", _ffmpeg(), True
    for name in ("numpy", "numba", "torch", "torchcodec", "cv2", "av", "pyarrow", "prefect"):
        yield name, _module(name), True
    yield "pycolmap", _module("pycolmap"), False
    yield "gpu", _gpu(), False
    yield "gsplat", _module("gsplat"), False


def _memory() -> tuple[bool, str]:
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return total > 3 * 2**30, _size(total)


def _ffmpeg() -> tuple[bool, str]:
    path = shutil.which("ffmpeg")
    return path is not None, path or "not on the PATH; torchcodec loads its libraries: apt-get install ffmpeg"


def _module(name: str) -> tuple[bool, str]:
    try:
        module = importlib.import_module(name)
    except Exception as error:
        return False, f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error) else ''}"
    return True, str(getattr(module, "__version__", "there"))


def _gpu() -> tuple[bool, str]:
    if (query := shutil.which("nvidia-smi")) is None:
        return False, "no NVIDIA driver; the CPU does everything"
    command = [query, "--query-gpu=name,memory.total", "--format=csv,noheader"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    names = "; ".join(answer.stdout.splitlines())
    return bool(names), names or "a driver, but no GPU"


@contextmanager
def _shown(arguments: argparse.Namespace, label: str) -> Iterator[Callable[..., None]]:
    """A callback (done, total, note) that shows progress on the terminal while the block runs."""
    progress = TerminalProgress(sys.stderr if getattr(arguments, "json", False) else sys.stdout)
    progress.started(label)
    try:
        yield lambda done, total, note="": progress.moved(label, done, total, note)
    finally:
        progress.close()


def _print(facts: Mapping[str, Any], as_json: bool, text: Callable[[Mapping[str, Any]], str]) -> None:
    print(json.dumps(facts, indent=1) if as_json else text(facts))


def _size(count: float) -> str:
    """Bytes for people, decimal units."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}" if unit != "B" else f"{count:.0f} B"
        count /= 1000
    return f"{count:,.1f} GB"
