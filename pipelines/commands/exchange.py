"""Scenes to other programs and back: `packuv export`, `import`, `atlas` and `web`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.commands.frames import check_frame, frames_of
from pipelines.commands.terminal import print_facts, shown
from pipelines.disk import size_text
from pipelines.words import counted

if TYPE_CHECKING:
    from calibration.rig import Rig
    from packuv.gaussians.uvsize import UvOptions
    from packuv.interchange import SplatFormat
    from packuv.interchange.clip import Clip
    from packuv.scene import Scene


# Frames


def export_frames(arguments: argparse.Namespace) -> int:
    """`packuv export SCENE`: one frame as a file, several as a folder of files or one, of another program.

    Such files know no light: each frame goes out as it is seen in its own, or in steady light where asked.
    """
    from packuv.interchange.clip import Clip, ClipOptions, Part
    from packuv.scene import open_scene

    kind = _splat_format(arguments.format, arguments.output, whole=arguments.frame is None)
    options = ClipOptions(Part(arguments.part), arguments.light == "baked", arguments.keep_rows)
    with open_scene(arguments.scene) as scene:
        if arguments.frame is not None:
            check_frame(len(scene), arguments.frame)
            frames = range(arguments.frame, arguments.frame + 1)
        else:
            frames = frames_of(len(scene), arguments.frames)
        with shown(arguments, "export") as progress:
            clip = Clip(scene, frames, options, progress=progress)
            count, what = _write_clip(clip, arguments, kind)
        print(f"{arguments.output}: {what}")
        for line in _told(clip, kind, count):
            print(line)
    return 0


def _write_clip(clip: Clip, arguments: argparse.Namespace, kind: SplatFormat) -> tuple[int, str]:
    """How many drawn Gaussians went out, and what was written."""
    from packuv.files import save_json, whole_folder
    from packuv.interchange import write_gaussians

    frames, output = clip.frames, arguments.output
    span = f"frame {frames[0]}" if len(frames) == 1 else f"frames {frames.start} to {frames.stop - 1}"
    if kind.door.write_clip is not None:
        count = kind.door.write_clip(output, clip)
        return count, f"{count:,} Gaussians of {span}"
    write = partial(write_gaussians, kind=kind, antialiased=clip.antialiased, keep_rows=clip.options.keep_rows)
    if arguments.frame is not None:
        count = write(output, clip.frame(arguments.frame))
        return count, f"{count:,} Gaussians of {span}"
    count = 0
    with whole_folder(output) as folder:
        for frame, gaussians in zip(frames, clip, strict=True):
            count += write(folder / f"{frame:06d}{kind.suffix}", gaussians)
        if not clip.options.bake_light:
            save_json(folder / "light.json", {"frames": list(frames), "gains": clip.gains.tolist()})
    return count, f"{counted(len(frames), 'file')}, {span}"


def _told(clip: Clip, kind: SplatFormat, count: int) -> Iterator[str]:
    """What went otherwise than in the scene: what the format loses, is left out, or was made of light and rows."""
    yield f"format     {kind.door.lacks}"
    if clip.heard and len(clip) > 1:
        yield f"sound      of {clip.heard} " + ("goes along, as FLAC" if kind.door.sounds else "is left out")
    if left := clip.drawn - count:  # by SPZ's fixed point
        yield f"left out   {left:,} of {clip.drawn:,} Gaussians, so far away that others would have coarse positions"
    if clip.options.keep_rows:
        starts = [clip.frames[k] for k, (a, b) in enumerate(pairwise([-1, *clip.segments])) if a != b]
        yield f"rows       are the same Gaussians until they begin anew at frames {', '.join(map(str, starts))}"
    if (clip.gains == 1).all():
        return
    if clip.options.bake_light:
        rms, largest = (255 * value for value in (clip.baking.rms, clip.baking.largest))
        yield (
            f"light      is baked into colours, {rms:.2f} of 255 off in the worst frame, {largest:.1f} at most: "
            "gains are of linear light, SH of sRGB"
        )
    else:
        low, high = clip.gains.min(), clip.gains.max()
        yield f"light      is left out: of {low:.1%} to {high:.1%} of steady light, in which frames are written"


def _splat_format(name: str | None, output: Path, *, whole: bool) -> SplatFormat:
    """As asked for, or else by the file's name; a folder of frames, as a `whole` sequence may be, gets standard PLY.

    Raises ValueError where the name tells of something else than what is written to it.
    """
    from packuv.interchange import WRITTEN, SplatFormat, format_of

    told = format_of(output)
    found = SplatFormat(name) if name else told
    if found is None and not output.suffix:
        return SplatFormat.PLY
    if found not in WRITTEN:
        why = f"{found} is read, but not written" if found else f"{output.name} does not tell its format"
        raise ValueError(f"{why}; choose one with --format: {', '.join(WRITTEN)}")
    one_file = found.door.write_clip is not None
    if whole and told and not one_file:
        raise ValueError(
            f"several frames of {found} are a folder of files, but {output.name} names a file; name a folder and give "
            f"--format {found}, or choose a frame with --frame"
        )
    if (told or one_file) and not output.name.lower().endswith(found.door.endings):
        raise ValueError(f"{found} is one file, named {' or '.join(found.door.endings)}, but not {output.name}")
    return found


def import_splats(arguments: argparse.Namespace) -> int:
    """`packuv import`: splat files, or an atlas video, become a scene file; the loss is told."""
    if len(arguments.inputs) == 1 and arguments.inputs[0].suffix.lower() == ".mkv":
        return _import_atlas(arguments)
    return _import_frames(arguments)


def _import_atlas(arguments: argparse.Namespace) -> int:
    from packuv.atlas import import_atlas

    with shown(arguments, "import") as progress:
        report = import_atlas(arguments.inputs[0], arguments.output, progress=progress)
    print_facts({"file": str(arguments.output), **vars(report)}, arguments.json, _import_atlas_text)
    return 0


def _import_atlas_text(facts: Mapping[str, Any]) -> str:
    changed, frames = facts["changed"], facts["frames"]
    check = f"{changed} of {counted(frames, 'frame')} are not" if changed else f"all {frames} frames are"
    return (
        f"{facts['file']}: {counted(frames, 'frame')}, {facts['gaussians']:,} Gaussians, {size_text(facts['bytes'])}\n"
        f"check      {check} the integers that the atlas was made from"
    )


def _import_frames(arguments: argparse.Namespace) -> int:
    from packuv.interchange.adopt import AdoptOptions, adopt, find_frames

    options = AdoptOptions(
        uv=None if arguments.keep_all else _uv(arguments),
        rate=arguments.fps,
        segment_frames=arguments.segment,
        sh_degree=arguments.sh_degree,
    )
    frames = find_frames(arguments.inputs)
    with shown(arguments, "import") as progress:
        report = adopt(frames, arguments.output, options=options, progress=progress)
    facts = {"file": str(arguments.output), **report.to_json()}
    print_facts(facts, arguments.json, _import_text)
    return 0


def _import_text(facts: Mapping[str, Any]) -> str:
    dropped = f"{facts['broken']:,} of {facts['gaussians']:,} are broken, {facts['faint']:,} too faint to be drawn"
    lines = [
        f"{facts['file']}: {counted(facts['frames'], 'frame')} in {counted(facts['segments'], 'segment')}, "
        f"{size_text(facts['bytes'])}",
        f"gaussians  {dropped}; the UV map has no texel for {facts['pruned']:,}",
        f"kept       {_share(facts['kept_share'])} of what is to be drawn, "
        f"{_share(facts['kept_alpha_share'])} of its alpha",
    ]
    if facts["empty"]:
        lines.append(f"empty      {facts['empty']} of {counted(facts['frames'], 'frame')}")
    if facts["antialiased"]:
        lines.append(
            "opacities  are those of Mip-Splatting, and drawn as others are: what is thin looks thicker from afar"
        )
    if facts["psnr_db"]:
        pruned, whole = (_decibels(facts[key]) for key in ("psnr_pruned_db", "psnr_db"))
        lines.append(f"pictures   {whole} against the original; {pruned} by the UV map alone")
    return "\n".join(lines)


def _share(value: float) -> str:
    """All is all: what rounds to it is less."""
    return f"{value if value == 1 else min(value, 0.999):.1%}"


def _decibels(values: list[float | None]) -> str:
    """Mean and worst; equal pictures have no PSNR."""
    finite = [value for value in values if value is not None]
    if not finite:
        return "exact"
    return f"{sum(finite) / len(finite):.1f} dB (worst view {min(finite):.1f})"


# Cameras


def export_cameras(arguments: argparse.Namespace) -> int:
    """`packuv export cameras`: the scene's cameras for another program."""
    from calibration.exporters import write_colmap, write_poses_bounds, write_transforms
    from calibration.importers.names import natural_key
    from packuv.files import whole_folder
    from packuv.scene import open_scene

    with open_scene(arguments.scene) as scene:
        rig = _rig(scene, str(arguments.scene))
        with whole_folder(arguments.output) as folder:
            if arguments.to == "colmap":
                write_colmap(rig, folder)
            elif arguments.to == "transforms":
                write_transforms(rig, folder / "transforms.json")
            else:
                rig = rig.select(sorted(rig.names, key=natural_key))
                write_poses_bounds(rig, folder / "poses_bounds.npy", _depths(scene, rig))
            names = ", ".join(sorted(path.name for path in folder.iterdir()))
    print(f"{arguments.output}: {len(rig.cameras)} cameras in {names}")
    return 0


def _rig(scene: Scene, source: str) -> Rig:
    """The cameras of a scene, which have no lens, as a rig."""
    from calibration.rig import Camera, Rig

    if not scene.header.cameras:
        raise ValueError(f"{source} holds no cameras")
    cameras = [
        Camera(c.name, c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.camera_from_world) for c in scene.header.cameras
    ]
    return Rig(tuple(cameras), source)


def _depths(scene: Scene, rig: Rig) -> Any:
    """Near and far of what each camera sees of the first frame, float64 [C, 2]; 0.1 % at either end left out."""
    import numpy as np

    from packuv.gaussians.floats import drawn

    means = drawn(scene.gaussians(0)).means.astype(np.float64)
    rows = []
    for camera in rig.cameras:
        depth = camera.project(means)[1][camera.sees(means)]
        if not len(depth):
            raise ValueError(f"camera {camera.name!r} sees nothing of the first frame, so that its depths are unknown")
        rows.append(np.quantile(depth, [0.001, 0.999]))
    return np.stack(rows)


# Atlas


def atlas(arguments: argparse.Namespace) -> int:
    """`packuv atlas`: the UV atlas of one frame as a picture for people."""
    from packuv.atlas import sheet, write_png
    from packuv.scene import open_scene

    with open_scene(arguments.scene) as scene:
        check_frame(len(scene), arguments.frame)
        picture = sheet(scene, arguments.frame, options=_uv(arguments), triplet=arguments.triplet)
    write_png(arguments.output, picture)
    what = arguments.triplet or "all triplets"
    print(f"{arguments.output}: {what} of frame {arguments.frame}, {picture.shape[1]}x{picture.shape[0]}")
    return 0


def export_atlas(arguments: argparse.Namespace) -> int:
    """`packuv export atlas`: the atlas as an ordinary video."""
    from packuv.atlas import AtlasCodec, AtlasVideoOptions
    from packuv.atlas import export_atlas as write
    from packuv.scene import open_scene

    options = AtlasVideoOptions(AtlasCodec(arguments.codec), arguments.crf, _uv(arguments))
    with shown(arguments, "export") as progress:
        summary = write(arguments.scene, arguments.output, options=options, progress=progress)
    with open_scene(arguments.scene) as scene:
        heard = scene.index.heard
    facts = {"file": str(arguments.output), "codec": arguments.codec, "crf": arguments.crf, "exact": summary.exact}
    print_facts({**facts, **vars(summary), "sound_left_out": heard}, arguments.json, _atlas_text)
    return 0


def _atlas_text(facts: Mapping[str, Any]) -> str:
    tracks = ", ".join(f"{name} {size_text(count)}" for name, count in facts["track_bytes"].items())
    errors = ", ".join(f"{name} {value:.2f}" for name, value in facts["rms"].items())
    share = facts["seated"] / max(1, facts["gaussians"])
    sounds = [f"sound      of {facts['sound_left_out']} is left out"] if facts["sound_left_out"] else []
    return "\n".join(
        [
            f"{facts['file']}: {counted(facts['frames'], 'frame')} of {facts['width']}x{facts['height']}, "
            f"{size_text(facts['bytes'])}, {size_text(facts['bytes'] / facts['frames'])} a frame",
            f"tracks     {tracks}",
            f"gaussians  {share:.2%} of those drawn have a texel",
            "check      decodes to exactly what was drawn" if facts["exact"] else f"error      rms in steps: {errors}",
            *sounds,
        ]
    )


def _uv(arguments: argparse.Namespace) -> UvOptions:
    from packuv.gaussians.uvsize import UvOptions

    return UvOptions(rows=arguments.map, columns=arguments.map, layers=arguments.layers)


# Web


def web(arguments: argparse.Namespace) -> int:
    """`packuv web`: the scene as static files for any web server."""
    from packuv.viewer import WebCodec, WebOptions, write_web

    with shown(arguments, "web") as progress:
        summary = write_web(
            arguments.scene, arguments.output, options=WebOptions(WebCodec(arguments.codec)), progress=progress
        )
    print_facts({"folder": str(arguments.output), **vars(summary)}, arguments.json, _web_text)
    return 0


def _web_text(facts: Mapping[str, Any]) -> str:
    delta, video = (size_text(facts[key] / facts["frames"]) for key in ("delta_bytes", "video_bytes"))
    return "\n".join(
        [
            f"{facts['folder']}: {counted(facts['frames'], 'frame')}, {size_text(facts['bytes'])}; "
            "put it on any web server",
            f"page       fetches {size_text(facts['delta_bytes'])} to play everything once, {delta} a frame",
            f"video      {size_text(facts['video_bytes'])}, {video} a frame",
            "check      both decode to exactly what the scene holds",
        ]
    )
