"""The `packuv` command.

Exit code 0: done; 1: the run failed; 2: wrong usage or bad input, with one sentence on stderr; 130: stopped by Ctrl-C;
129, 143: ended by SIGHUP, SIGTERM.
Nothing heavy is imported before a command is chosen, so that `packuv --help` answers at once.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, NoReturn

import packuv
from packuv.gaussians.uvsize import UvOptions
from pipelines import plugins
from pipelines.commands.output import check_written, lasting_output
from pipelines.disk import free_bytes, size_text
from pipelines.ending import Terminated, ending_gently
from pipelines.request import BAD_INPUT, CLOCKS, PRESETS, QUALITIES, STAGES, parse_range
from tasks.artefacts.jobs import ONE_BLAS_THREAD, CancelledError

OK, FAILED, WRONG, INTERRUPTED = 0, 1, 2, 130
SINGLE = {
    "sync": "match the frames of all cameras to instants",
    "calibrate": "import or solve the cameras, triangulate points, balance colours",
    "flow": "find out what moves, and choose keyframes",
    "fit": "fit Gaussians to the keyframes, then to the frames between them",
    "encode": "write the scene file",
}
"""Commands that run the stages up to the one they name"""

SPLAT_FORMATS = ("ply", "compressed-ply", "spz", "spz3", "sog", "splat", "gltf", "usd", "4dgs")
"""What `packuv.interchange` writes, which is too heavy to be asked before a command is chosen"""

READ = ("scene", "inputs", "path", "compare")
"""Arguments that name files which a command reads"""

WRONG_PATH = frozenset({errno.ENAMETOOLONG, errno.ELOOP})
FULL = frozenset({errno.ENOSPC, errno.EDQUOT})


MOST_SAID = 2000
"""Characters of a message"""
MOST_RATE_PART = 2**31 - 1
"""As in `packuv.bounds`, which is too heavy to be asked before a command is chosen"""


class UsageError(ValueError):
    """The command line cannot be understood."""


class _Help(argparse.HelpFormatter):
    """Shows the defaults that say something; a range or size explains its own."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        shown = isinstance(default, (str, int)) and not isinstance(default, bool)
        shown = shown and default not in (argparse.SUPPRESS, ":")  # the whole range
        return f"{action.help} (default: %(default)s)" if shown and action.option_strings else action.help


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one sentence, without the usage text."""

    first_words: tuple[str, ...] = ()
    """Words of which one must come first; where none does, the first of them is meant"""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_Help, **settings)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # -1:3 and -1,2 are wrong values, but no options

    def parse_known_args(  # type: ignore[override]  # argparse declares an overload for each kind of namespace
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        if self.first_words and args and args[0] not in (*self.first_words, "-h", "--help"):
            args = [self.first_words[0], *args]
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help")


class _Version(argparse.Action):
    """Looks for the version when it is asked for: that takes a while, and most calls do not ask."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        print(f"packuv {packuv.__version__}")
        parser.exit(OK)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the `packuv` command with these arguments, by default those of the process; returns the exit code."""
    os.environ |= ONE_BLAS_THREAD  # before NumPy is loaded, and for all that a command starts
    with lasting_output(), ending_gently():
        return _outcome(sys.argv[1:] if argv is None else argv)


def _outcome(words: Sequence[str]) -> int:
    """Exit code of the command that these words are; what went wrong is said."""
    arguments = argparse.Namespace()
    try:
        arguments = _parsed(words)
        _check_output(arguments)
        return _load(arguments.function)(arguments)
    except UsageError as error:
        return _say(WRONG, (words and plugins.missing(words[0])) or error)
    except BAD_INPUT as error:
        return _say(WRONG, _system_message(error, arguments) if isinstance(error, OSError) else error)
    except KeyboardInterrupt:
        return _say(INTERRUPTED, f"stopped; {_afterwards(arguments)}")
    except Terminated as signal:
        return _say(signal.code, f"ended by {signal}; {_afterwards(arguments)}")
    except CancelledError as error:
        return _say(FAILED, error)
    except OSError as error:  # a full disk, a lost network: the system's fault, and its message says all
        return _say(WRONG if error.errno in WRONG_PATH else FAILED, _system_message(error, arguments))
    except Exception as error:
        return _say(FAILED, f"{_first_sentence(error)}; {_log_of(error)}")


def _afterwards(arguments: argparse.Namespace) -> str:
    """What the same command would do after it was stopped."""
    keeps = getattr(arguments, "command", "") in ("run", *SINGLE, "batch")
    return f"the same command {'goes on from here' if keeps else 'begins anew'}"


def _parsed(words: Sequence[str]) -> argparse.Namespace:
    try:
        return parser().parse_args(words)
    except SystemExit:  # after --help and --version, which are an answer, too
        check_written()
        raise


def _check_output(arguments: argparse.Namespace) -> None:
    """Raise ValueError where the file to write is one that the command reads."""
    if (output := getattr(arguments, "output", None)) and output.exists():
        from packuv.files import check_apart

        named = [getattr(arguments, name, None) or () for name in READ]
        check_apart(output, [path for paths in named for path in ([paths] if isinstance(paths, Path) else paths)])


def _load(name: str) -> Callable[[argparse.Namespace], int]:
    module, _, function = name.partition(":")
    found: Callable[[argparse.Namespace], int] = getattr(importlib.import_module(module), function)
    return found


def _say(code: int, problem: object) -> int:
    """One line on stderr, in which names from files do nothing to the terminal, and do not fill it."""
    line = " ".join(str(problem).split())
    line = line if len(line) <= MOST_SAID else f"{line[:MOST_SAID]} ..."
    print(f"packuv: {''.join(c if c.isprintable() else ascii(c)[1:-1] for c in line)}", file=sys.stderr)
    return code


def _system_message(error: OSError, arguments: argparse.Namespace) -> str:
    """Without the number; with the file, or else the folder that the command writes to, and the room there."""
    what = error.strerror or re.sub(r"^\[Errno \d+\] ", "", str(error))
    if error.errno not in FULL or (what != os.strerror(error.errno) and not error.filename):
        return f"{what}: {error.filename}" if error.filename else what
    place = Path(error.filename or getattr(arguments, "out", None) or getattr(arguments, "output", None) or "")
    return f"{os.strerror(error.errno)}: {place.absolute()}: {_room(place)}free some and run the same command again"


def _room(place: Path) -> str:
    with contextlib.suppress(OSError):  # the disk is gone
        return f"{size_text(free_bytes(place))} are free; "
    return ""


def _first_sentence(error: Exception) -> str:
    return str(error).split("; the traceback is in ")[0] or type(error).__name__


def _log_of(error: Exception) -> str:
    """Where the traceback is: in the job's own log where a job failed."""
    log: Path | None = getattr(error, "log", None)
    try:
        return f"the traceback is in {log or _write_log(error)}"
    except OSError as problem:
        return f"no place for the traceback: {problem.strerror or problem}"


def _write_log(error: Exception) -> Path:
    with tempfile.NamedTemporaryFile("w", prefix="packuv-", suffix=".log", delete=False) as file:
        traceback.print_exception(error, file=file)
        return Path(file.name)


def parser(found: Iterable[EntryPoint] | None = None) -> argparse.ArgumentParser:
    """The grammar of the command line, with the commands of these entry points; by default of all installed ones."""
    top = _Parser(prog="packuv", description="From a multi-camera capture to a volumetric video.")
    top.add_argument("--version", action=_Version, nargs=0, help="print the version, and leave")
    commands = top.add_subparsers(metavar="COMMAND", required=True)

    def command(name: str, function: str, text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        added.set_defaults(function=function, command=name)
        return added

    _simulate(
        command("simulate", "pipelines.commands.scenes:simulate", "write a synthetic capture with exact ground truth")
    )
    _run(
        command("run", "pipelines.commands.run:command", "turn a capture folder into a scene file, with report"),
        stop=True,
    )
    for name, text in SINGLE.items():
        _run(command(name, "pipelines.commands.run:command", f"{text} (run --stop-after {name})"), stop=False)
    _adopt(
        command("adopt", "pipelines.commands.adopt:command", "make capture folders of a published data set, by links")
    )
    _join(command("join", "pipelines.commands.join:command", "make one video of the chapters that a camera recorded"))
    _manifest(
        command("manifest", "pipelines.commands.datasets:manifest", "list the captures of a data set in a Parquet file")
    )
    _plan(command("plan", "pipelines.commands.plan:command", "tell what a run or a batch would do, and what it takes"))
    _batch(command("batch", "pipelines.commands.batch:command", "process every sequence of a manifest"))
    _scene(command("info", "pipelines.commands.scenes:info", "show what a scene file holds"), json=True)
    _verify(
        command(
            "verify", "pipelines.commands.scenes:verify", "check a scene file bit by bit, or the artefacts of a run"
        )
    )
    _compress(
        command("compress", "pipelines.commands.compress:command", "write a smaller scene file of a lossless one")
    )
    _export(command("export", "", "write frames, cameras or the atlas of a scene for other programs"))
    _import(command("import", "pipelines.commands.exchange:import_splats", "turn splat files into a scene file"))
    _atlas(command("atlas", "pipelines.commands.exchange:atlas", "write the UV atlas of a frame as a picture"))
    _web(command("web", "pipelines.commands.exchange:web", "write a scene as static files for any web server"))
    _render(command("render", "pipelines.commands.scenes:render", "write pictures of a scene as PNG files"))
    _film(command("film", "pipelines.commands.scenes:film", "write an MP4 of a scene along a camera path"))
    _evaluate(command("eval", "pipelines.commands.scenes:evaluate", "score a scene against a capture"))
    _serve(command("serve", "pipelines.commands.serve:serve", "keep a dashboard, and run by form, script or schedule"))
    _worker(command("worker", "pipelines.commands.worker:worker", "make stages here for runs with --cluster"))
    _status(command("status", "pipelines.commands.watch:status", "tell what runs, what failed and what is done"))
    _cancel(command("cancel", "pipelines.commands.watch:cancel", "end runs within seconds; they can go on later"))
    _report(command("report", "pipelines.commands.report:command", "write the report of a run anew, or compare runs"))
    _view(command("view", "pipelines.commands.scenes:view", "show a scene in the web browser"))
    _clean(command("clean", "pipelines.commands.stores:clean", "remove from stores what no run needs, or hold a quota"))
    command("doctor", "pipelines.commands.doctor:doctor", "tell what this machine has and lacks")
    plugins.plug_in(command, lambda problem: _say(WRONG, problem), found)
    return top


def _simulate(command: argparse.ArgumentParser) -> None:
    command.add_argument("out", type=Path, metavar="OUT", help="folder to write, new or empty")
    command.add_argument("--cameras", type=_positive, default=8, help="number of cameras")
    command.add_argument("--frames", type=_positive, default=24, help="number of instants")
    command.add_argument("--size", type=_size, default=(640, 360), metavar="WxH", help="picture size, pixels (640x360)")
    command.add_argument("--fps", type=str, default="30", help="instants per second, a number or a fraction")
    command.add_argument("--rig", choices=("ring", "dome", "front"), default="ring", help="how the cameras stand")
    _seed(command)
    _set(command, "a setting of the simulation")


def _adopt(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "dataset", type=Path, metavar="DATASET", help="folder of the data set, or of one of its scenes"
    )
    command.add_argument(
        "--out", type=Path, default=None, metavar="DIR", help="captures go to DIR/<scene>/ (DATASET-captures)"
    )
    _json(command)


def _join(command: argparse.ArgumentParser) -> None:
    command.add_argument("capture", type=Path, metavar="CAPTURE", help="folder with videos/ in which chapters lie")
    _json(command)


def _run(command: argparse.ArgumentParser, *, stop: bool) -> None:
    command.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="results go to DIR/<sequence>/")
    command.add_argument("--name", default=None, help="of the sequence (what capture.toml or the folder says)")
    command.add_argument(
        "--hold-out",
        type=_names,
        default=None,
        metavar="CAM,CAM",
        help="cameras to score on, never fitted (capture.toml)",
    )
    command.add_argument("--jobs", type=_positive, default=None, metavar="N", help="segments at once (from the cores)")
    command.add_argument(
        "--cluster", default=None, metavar="tcp://HOST:PORT", help="Dask scheduler whose workers do the work (none)"
    )
    _how(command, stop=stop)
    _direct(command)
    command.add_argument("--preview", action="store_true", help="show what is fitted in the browser while it runs")


def _plan(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "source", type=Path, metavar="CAPTURE|MANIFEST", help="capture folder, manifest, or folder of captures"
    )
    command.add_argument(
        "--out", type=Path, default=Path("runs"), metavar="DIR", help="where the results would go, or are (runs)"
    )
    command.add_argument(
        "--hold-out", type=_names, default=None, metavar="CAM,CAM", help="cameras to score on (capture.toml)"
    )
    _which(command)
    command.add_argument("--jobs", type=_positive, default=None, metavar="N", help="segments at once (from the cores)")
    _how(command, stop=True)


def _batch(command: argparse.ArgumentParser) -> None:
    command.add_argument("manifest", type=Path, metavar="MANIFEST", help="Parquet file of packuv manifest")
    command.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="results go to DIR/<sequence>/ and DIR/index.html"
    )
    _which(command)
    command.add_argument(
        "--pool", default=None, metavar="NAME", help="hand the sequences to the workers of this Prefect work pool"
    )
    command.add_argument("--jobs", type=_positive, default=1, metavar="N", help="segments of a sequence at once")
    command.add_argument("--dry-run", action="store_true", help="only tell what would run, and why")
    command.add_argument(
        "--notify", default=None, metavar="CMD", help="shell command to run at the end if something failed"
    )
    _how(command, stop=True)
    _direct(command)


def _which(command: argparse.ArgumentParser) -> None:
    """Sequences of a manifest."""
    command.add_argument(
        "--names", type=_names, default=(), metavar="GLOB,GLOB", help="only sequences with one of these names (all)"
    )
    command.add_argument(
        "--tags", type=_names, default=(), metavar="TAG,TAG", help="only sequences with all of these tags (all)"
    )
    command.add_argument(
        "--at-once", type=_positive, default=None, metavar="N", help="sequences at a time (from cores and memory)"
    )


def _direct(command: argparse.ArgumentParser) -> None:
    command.add_argument("--direct", action="store_true", help="run the same stages without the workflow engine")


def _how(command: argparse.ArgumentParser, *, stop: bool) -> None:
    """Options of a run, be it of one sequence or of many."""
    command.add_argument(
        "--preset",
        choices=PRESETS,
        default=None,
        help="trades time for quality (standard); with one of the next two, the finest that may be chosen (high)",
    )
    command.add_argument(
        "--max-minutes", type=float, default=None, metavar="M", help="choose the finest settings that take no longer"
    )
    command.add_argument(
        "--target-psnr",
        type=float,
        default=None,
        metavar="DB",
        help="choose the fastest settings that reach this on cameras held out",
    )
    command.add_argument("--quality", choices=QUALITIES, default="lossless", help="how near the file stays to the fit")
    command.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="what fits and renders")
    command.add_argument(
        "--clock",
        choices=CLOCKS,
        default=None,
        help="what times are worth, whatever capture.toml says; content: pictures tell when each camera began",
    )
    command.add_argument(
        "--frames", type=_range_text, default=":", metavar="A:B", help="instants A to B - 1, counted from 0 (all)"
    )
    command.add_argument(
        "--memory-gb", type=float, default=2.0, metavar="GB", help="of each job, for pictures and layers (2)"
    )
    if stop:
        command.add_argument("--stop-after", choices=STAGES, default="report", metavar="STAGE", help=", ".join(STAGES))
    command.add_argument("--config", type=Path, default=None, metavar="FILE", help="TOML file with settings by stage")
    _seed(command)
    _set(command, "a setting of a stage; wins over --config and --preset")
    _json(command)


def _serve(command: argparse.ArgumentParser) -> None:
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="results go to DIR/<sequence>/")
    command.add_argument("--data", type=Path, default=None, metavar="PATH", help="manifest, or folder of captures")
    command.add_argument("--cron", default=None, metavar="EXPR", help="when to process all of it, as '0 2 * * *'")
    command.add_argument("--timezone", default="UTC", help="that --cron means")
    command.add_argument("--preset", choices=PRESETS, default="standard", help="trades time for quality")
    command.add_argument("--at-once", type=_positive, default=1, metavar="N", help="runs at a time")
    command.add_argument("--host", default="127.0.0.1", help="address of the dashboard, which has no password")
    command.add_argument("--port", type=_port, default=4200, help="of the dashboard")


def _worker(command: argparse.ArgumentParser) -> None:
    command.add_argument("scheduler", metavar="tcp://HOST:PORT", help="where `dask scheduler` listens")
    command.add_argument("--cores", type=_positive, default=None, metavar="N", help="that jobs may use (all)")
    command.add_argument("--memory-gb", type=float, default=None, metavar="GB", help="that jobs may use (what is free)")
    command.add_argument("--gpus", type=int, default=0, metavar="N", help="jobs at a time that use a GPU")
    command.add_argument("--host", default=None, metavar="ADDR", help="own address for the others (found out)")
    command.add_argument("--name", default=None, help="in the cluster (its address)")


def _status(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "folder", type=Path, nargs="?", default=Path("runs"), metavar="DIR", help="output folder (runs)"
    )
    _json(command)


def _cancel(command: argparse.ArgumentParser) -> None:
    command.add_argument("folder", type=Path, metavar="DIR", help="output folder, or that of one sequence")
    command.add_argument("sequence", nargs="*", metavar="SEQUENCE", help="only these (all that run)")


def _manifest(command: argparse.ArgumentParser) -> None:
    command.add_argument("dataset", type=Path, metavar="DATASET", help="folder with capture folders in it")
    _output(command, "FILE", "Parquet file to write, or to bring up to date")
    _json(command)


def _scene(command: argparse.ArgumentParser, *, json: bool = False) -> None:
    command.add_argument("scene", type=Path, metavar="SCENE", help="scene file")
    if json:
        _json(command)


def _verify(command: argparse.ArgumentParser) -> None:
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("scene", type=Path, nargs="?", metavar="SCENE", help="scene file: decode and compare every frame")
    what.add_argument(
        "--store", type=Path, metavar="DIR", help="folder of a run: compare every artefact with its receipt"
    )
    _json(command)


def _clean(command: argparse.ArgumentParser) -> None:
    command.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="output folder, sequence or store")
    command.add_argument("--dry-run", action="store_true", help="only tell what would go")
    command.add_argument(
        "--keep-days", type=_days, default=0, metavar="N", help="keep what was used in the last N days (nothing for it)"
    )
    command.add_argument(
        "--quota",
        type=_bytes,
        default=None,
        metavar="SIZE",
        help="then have intermediates of finished sequences go until each DIR holds at most this, as 200GB (no end)",
    )
    _json(command)


def _export(export: argparse.ArgumentParser) -> None:
    export.description = "Write frames, cameras or the atlas of a scene for other programs; SCENE alone means frames."
    assert isinstance(export, _Parser)
    export.first_words = ("frames", "cameras", "atlas")
    targets = export.add_subparsers(metavar="WHAT", required=True)

    def target(name: str, function: str, text: str) -> argparse.ArgumentParser:
        added = targets.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        added.set_defaults(function=f"pipelines.commands.exchange:{function}", command="export")
        return added

    _export_frames(target("frames", "export_frames", "write frames for other splat programs"))
    _export_cameras(target("cameras", "export_cameras", "write the cameras of a scene"))
    _export_atlas(target("atlas", "export_atlas", "write the UV atlas as an ordinary video, one track a triplet"))


def _export_frames(command: argparse.ArgumentParser) -> None:
    _scene(command)
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("--frame", type=int, metavar="N", help="one frame, counted from 0, to a file")
    which.add_argument(
        "--frames", type=_range, metavar="A:B", help="frames A to B - 1, to a folder of files; of usd and 4dgs, a file"
    )
    command.add_argument(
        "--format",
        choices=SPLAT_FORMATS,
        help="standard 3DGS PLY, SuperSplat's compressed PLY, SPZ of version 4 or 3, SOG, .splat, glTF with "
        "KHR_gaussian_splatting, OpenUSD, .4dgs (from the name of the output, or ply)",
    )
    command.add_argument(
        "--part",
        choices=("backdrop", "people", "both"),
        default="both",
        help="what stands still for the whole of its segment, what may move in it, or both",
    )
    command.add_argument(
        "--light",
        choices=("baked", "left"),
        default="baked",
        help="each frame as seen in its own light, which then is in its colours, or in steady light",
    )
    command.add_argument(
        "--keep-rows",
        action="store_true",
        help="row N is the same Gaussian in all frames of a segment, where it is absent with alpha 0",
    )
    _output(command, "OUT", "file, or folder for 000000.ply, ...")


def _export_cameras(command: argparse.ArgumentParser) -> None:
    _scene(command)
    formats = ("colmap", "transforms", "poses-bounds")
    command.add_argument("--to", choices=formats, required=True, help="COLMAP's text model, transforms.json, LLFF's")
    _output(command, "DIR", "folder to write, new or empty")


def _export_atlas(command: argparse.ArgumentParser) -> None:
    _scene(command)
    codecs = ("ffv1", "x264", "x265", "vp9", "av1", "huffyuv")
    command.add_argument("--codec", choices=codecs, default="ffv1", help="how the pictures are coded")
    quality = command.add_mutually_exclusive_group()
    quality.add_argument(
        "--lossless", action="store_const", const=None, dest="crf", help="exact, checked (the default)"
    )
    quality.add_argument(
        "--crf", type=int, default=None, metavar="N", help="lossy, on the codec's own scale; positions stay exact"
    )
    _uv_map(command)
    _output(command, "FILE", "Matroska file to write")
    _json(command)


def _import(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="IN",
        help="PLY, compressed PLY, SPZ, SOG, .splat or .ksplat: one for a still scene, several or a folder for a "
        "sequence; or an atlas video",
    )
    command.add_argument("--fps", type=_rate, default="30", help="frames per second of a sequence, may be a fraction")
    command.add_argument("--sh-degree", type=int, default=None, metavar="N", help="highest SH degree to keep (all)")
    command.add_argument("--segment", type=_positive, default=30, metavar="N", help="longest segment, frames")
    _uv_map(command)
    command.add_argument("--keep-all", action="store_true", help="no UV map: keep every Gaussian that is drawn")
    _output(command, "FILE", "scene file to write")
    _json(command)


def _atlas(command: argparse.ArgumentParser) -> None:
    _scene(command)
    command.add_argument("--frame", type=int, required=True, metavar="N", help="frame, counted from 0")
    command.add_argument(
        "--triplet", default=None, metavar="NAME", help="one triplet as stored, as colour or position_hi (all, shown)"
    )
    _uv_map(command)
    _output(command, "PNG", "picture to write")


def _web(command: argparse.ArgumentParser) -> None:
    _scene(command)
    command.add_argument("--codec", choices=("vp9", "av1"), default="vp9", help="how the video streams are coded")
    _output(command, "DIR", "folder to write, new or empty")
    _json(command)


def _compress(command: argparse.ArgumentParser) -> None:
    _scene(command)
    goal = command.add_mutually_exclusive_group(required=True)
    goal.add_argument("--ratio", type=float, default=None, metavar="N", help="N times smaller than the scene, at least")
    goal.add_argument(
        "--loss-db", type=float, default=None, metavar="DB", help="PSNR against footage that may be lost, about"
    )
    known = command.add_mutually_exclusive_group()
    known.add_argument(
        "--capture",
        type=Path,
        default=None,
        metavar="CAPTURE",
        help="what was filmed: codes move towards it, it says what is lost",
    )
    known.add_argument(
        "--fitted-db", type=float, default=None, metavar="DB", help="PSNR of the scene against footage (taken for 30)"
    )
    command.add_argument(
        "--iterations",
        type=int,
        default=None,
        metavar="N",
        help="by which codes make up for what is left out, a segment (600 in all, but 200 at least); 0: quicker, and "
        "larger files",
    )
    _seed(command)
    _output(command, "FILE", "scene file to write")
    _json(command)


def _render(command: argparse.ArgumentParser) -> None:
    _scene(command)
    command.add_argument("--camera", required=True, metavar="NAME|FILE", help="a camera of the scene, or a JSON file")
    command.add_argument("--frames", type=_range, default=(0, None), metavar="A:B", help="frames A to B - 1 (all)")
    command.add_argument("--size", type=_size, default=None, metavar="WxH", help="picture size, pixels (the camera's)")
    command.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="what renders")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for 000000.png, ...")


def _film(command: argparse.ArgumentParser) -> None:
    _scene(command)
    command.add_argument("path", type=Path, metavar="PATH.json", help="a camera path, as the viewer writes it")
    command.add_argument("--size", type=_size, default=None, metavar="WxH", help="picture size, pixels (first view's)")
    command.add_argument("--fps", type=_rate, default=None, metavar="N", help="pictures per second (the scene's)")
    command.add_argument(
        "--capture", type=Path, metavar="DIR", help="have its sound go along (the scene's, or else the run's)"
    )
    command.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="what renders")
    _output(command, "FILE.mp4", "the film")


def _evaluate(command: argparse.ArgumentParser) -> None:
    _scene(command)
    command.add_argument("capture", type=Path, metavar="CAPTURE", help="the capture folder it was made from")
    command.add_argument(
        "--cameras", type=_names, default=None, metavar="a,b", help="cameras (those held out, or three)"
    )
    command.add_argument(
        "--lpips-weights",
        default=None,
        metavar="FILE",
        help="torchvision's AlexNet or VGG-16 weights, to measure LPIPS",
    )
    command.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="what renders")
    _json(command)


def _report(command: argparse.ArgumentParser) -> None:
    command.add_argument("run", type=Path, nargs="?", metavar="RUN", help="folder of a run")
    command.add_argument(
        "--compare", type=Path, nargs=2, default=None, metavar=("A", "B"), help="what differs between two runs"
    )
    command.add_argument("--dataset", type=Path, default=None, metavar="DIR", help="all runs of an output folder")
    command.add_argument("-o", "--output", type=Path, metavar="PAGE", help="the comparison as a page, too")
    _set(command, "a limit of the report, as report.psnr_db=25")
    _json(command)


def _view(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "scene", type=Path, metavar="SCENE", help="scene file, or the folder of a run, also while it runs"
    )
    command.add_argument("--port", type=int, default=8787, help="TCP port; 0 picks a free one")
    command.add_argument(
        "--capture", type=Path, metavar="DIR", help="lay what its cameras filmed beside (the run's, where it is known)"
    )
    command.add_argument("--host", default="127.0.0.1", help="address to answer at; 0.0.0.0 shows it to everyone")


def _uv_map(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--map", type=_positive, default=UvOptions.rows, metavar="N", help="side of the UV map, texels"
    )
    command.add_argument("--layers", type=_positive, default=UvOptions.layers, metavar="K", help="layers of the UV map")


def _output(command: argparse.ArgumentParser, metavar: str, text: str) -> None:
    command.add_argument("-o", "--output", type=Path, required=True, metavar=metavar, help=text)


def _seed(command: argparse.ArgumentParser) -> None:
    command.add_argument("--seed", type=int, default=0, help="same seed, same bytes")


def _set(command: argparse.ArgumentParser, text: str) -> None:
    command.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)


def _json(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true", help="print JSON on stdout, and nothing else there")


def _positive(text: str) -> int:
    number = int(text) if re.fullmatch(r"\d+", text) else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 on, but is {text!r}")
    return number


def _port(text: str) -> int:
    number = int(text) if re.fullmatch(r"\d{1,5}", text) else 0
    if not 0 < number < 2**16:
        raise argparse.ArgumentTypeError(f"must be a port from 1 to {2**16 - 1}, but is {text!r}")
    return number


def _days(text: str) -> float:
    if not re.fullmatch(r"\d+(?:\.\d+)?", text):
        raise argparse.ArgumentTypeError(f"must be a number of days, but is {text!r}")
    return float(text)


def _bytes(text: str) -> int:
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?(k|M|G|T)?B", text)
    if not match:
        raise argparse.ArgumentTypeError(f"must be a size with its unit, as 200GB or 1.5TB, but is {text!r}")
    return int(Fraction(match[1]) * 1000 ** ("kMGT".index(match[2]) + 1 if match[2] else 0))


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT in pixels, as 640x360, but is {text!r}")
    return int(match[1]), int(match[2])


def _range(text: str) -> tuple[int, int | None]:
    """Half-open; either end may be missing."""
    try:
        return parse_range(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _range_text(text: str) -> str:
    _range(text)
    return text


def _rate(text: str) -> Fraction:
    match = re.fullmatch(r"\d+(?:\.\d+)?|\d+/[1-9]\d*", text)
    rate = Fraction(text) if match else Fraction(0)
    if not rate > 0 or max(rate.numerator, rate.denominator) > MOST_RATE_PART:
        raise argparse.ArgumentTypeError(
            "must be a rate above 0 as 30, 29.97 or 30000/1001, both parts of the fraction up to "
            f"{MOST_RATE_PART}, but is {text!r}"
        )
    return rate


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


if __name__ == "__main__":
    sys.exit(main())
