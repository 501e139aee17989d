"""Memory, time and open files of every stage against the length of a capture, up to half an hour.

    packuv bench long --folder runs/long --out bench/results/long.json
    packuv bench long --folder runs/long --out runs/long.json --instants 1000,6000

Films a short capture, and repeats its packets to captures of so many instants. Of each, every stage up to keyframes
runs whole. Of the longest, some instants from its middle are fitted by few iterations; their segments, repeated, give a
scene file as long as each capture, which is encoded, verified, scored, reported, described and viewed. What is there is
not made again, so the command goes on where it was stopped.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Any

import av
import numpy as np

from bench import command
from packuv.files import save_json
from packuv.footage import FrameReader
from packuv.gaussians.segment import Segment
from packuv.progress import Progress
from packuv.scene import open_scene
from pipelines.events import Journal
from pipelines.process import Engine, There, prepare
from pipelines.request import RunRequest
from pipelines.results import Run, collect, remains
from pipelines.stages import Sequence as Stages
from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import EPOCH_NS, ClockOptions, tick_times
from sync.probe import probe_video
from tasks.artefacts.jobs import Done, Job, Jobs
from tasks.artefacts.retention import RUN
from tasks.artefacts.store import Building, Key, Store
from tasks.report.write import write_report
from tasks.stages.encode import Verify
from tasks.stages.evaluate import scored_cameras
from tasks.stages.fitting import SEGMENT

LOOP = 200
"""Instants of the capture that is repeated"""
FITTED = 1000
"""Instants from the middle that are fitted"""
CAMERAS, SIZE = 4, "128x72"
SETTINGS: Mapping[str, Any] = {
    "fit": {
        "iterations": 150,
        "key_iterations": 12,
        "frame_iterations": 3,
        "key_births": 150,
        "spare": 50,
        "start": {"count": 1500},
        "shell": {"steps": 12},
        "density": {"cap": 2500},
    }
}
"""A fit of seconds, whose memory and artefacts are those of a long one"""
THREADS = 1
"""Of what is measured after the fit: on cores that are shared, two that wait for each other would count as work"""
LOOK_SECONDS = 0.2
"""Between looks at the processes"""


def film(folder: Path) -> Path:
    """The capture that is repeated, made unless it is there."""
    if not folder.exists():
        clock = ClockOptions(drop_share=0.0, max_late_frames=0)
        options = SimulateOptions(
            cameras=CAMERAS, frames=LOOP, size=SIZE, samples=1, truth=TruthKind.LIGHT, clock=clock, name="long"
        )
        simulate(folder, options)
    return folder


def lengthen(short: Path, folder: Path, instants: int) -> Path:
    """A capture of so many instants, made unless it is there: the packets of a short one, again and again."""
    if folder.exists():
        return folder
    begun = folder.with_name(f"{folder.name}.begun")
    shutil.rmtree(begun, ignore_errors=True)
    shutil.copytree(short, begun, ignore=shutil.ignore_patterns("videos", "timecodes", "truth"))
    for part in ("videos", "timecodes"):
        (begun / part).mkdir()
    ticks = (tick_times(instants, SimulateOptions().fps) - EPOCH_NS) // 1000
    rng = np.random.default_rng(0)
    for video in sorted((short / "videos").iterdir()):
        repeat(video, begun / "videos" / video.name, instants)
        times = EPOCH_NS // 1000 + ticks + rng.integers(-300, 300, instants)
        lines = [f"frame_{time}_{number:012d}" for number, time in enumerate(times.tolist())]
        (begun / "timecodes" / f"{video.stem}.txt").write_text("\n".join(lines) + "\n")
    begun.rename(folder)
    return folder


def repeat(source: Path, target: Path, frames: int) -> None:
    """A video of so many frames, from the packets of a shorter one."""
    with av.open(str(source)) as first, av.open(str(target), "w") as out:
        stream, done, length = out.add_stream_from_template(first.streams.video[0]), 0, first.streams.video[0].frames
        while done < frames:
            with av.open(str(source)) as container:
                video = container.streams.video[0]
                assert video.time_base is not None
                assert video.average_rate is not None
                shift = int(done / video.average_rate / video.time_base)
                for packet in container.demux(video):
                    if packet.dts is None or packet.pts is None:
                        continue
                    packet.pts, packet.dts, packet.stream = packet.pts + shift, packet.dts + shift, stream
                    out.mux(packet)
            done += length


class Watch:
    """A process and all that it starts: the most open files of one of them, and the most memory of the first."""

    def __init__(self, pid: int) -> None:
        self.files = self.memory_bytes = 0
        self._pid, self._ended = pid, Event()
        self._thread = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    def look(self) -> None:
        for pid in _family(self._pid):
            with suppress(OSError):
                self.files = max(self.files, len(os.listdir(f"/proc/{pid}/fd")))
        self.memory_bytes = max(self.memory_bytes, _peak_bytes(self._pid))

    def _watch(self) -> None:
        while not self._ended.wait(LOOK_SECONDS):
            self.look()


def _family(pid: int) -> Iterator[int]:
    yield pid
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError):
                for child in (task / "children").read_text().split():
                    yield from _family(int(child))


def _peak_bytes(pid: int) -> int:
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return 0


def packuv(*words: str) -> tuple[float, Watch]:
    """Run a command of ours to its end; its time, and what was seen of it."""
    start = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", "pipelines.cli", *words], stdout=subprocess.DEVNULL)
    with Watch(process.pid) as watch:
        code = process.wait()
    if code:
        raise RuntimeError(f"packuv {' '.join(words)} ended with code {code}")
    return time.monotonic() - start, watch


@dataclass(frozen=True)
class Case:
    """One length."""

    folder: Path
    instants: int

    @property
    def capture(self) -> Path:
        return self.folder / f"capture{self.instants}"

    @property
    def out(self) -> Path:
        return self.folder / f"out{self.instants}"

    @property
    def sequence(self) -> Path:
        return self.out / "long"

    def request(self, **changes: Any) -> RunRequest:
        return RunRequest(
            str(self.capture.resolve()), str(self.out.resolve()), preset="draft", settings=SETTINGS, jobs=1, **changes
        )

    def fit(self, few: int) -> dict[str, Any]:
        """A whole run of twice so many instants from the middle; what was fitted is on record in fitted.json."""
        middle = self.instants // 2
        measured = self.run("report", f"{middle - few}:{middle + few}")
        names = [item["artefact"] for item in json.loads((self.sequence / RUN).read_text())["artefacts"]]
        kinds = {kind: [name for name in names if name.startswith(f"{kind}/")] for kind in ("key", "segment")}
        save_json(self.folder / "fitted.json", kinds)
        return {"instants": 2 * few, **measured}

    def run(self, stop_after: str, frames: str = ":") -> dict[str, Any]:
        """A run without the workflow engine: memory of the run itself, open files, and artefacts by stage."""
        words = ["run", str(self.capture), "--out", str(self.out), "--direct", "--preset", "draft", "--jobs", "1"]
        settings = [f"{group}.{name}={value}" for group, name, value in _flat(SETTINGS)]
        sets = [word for setting in settings for word in ("--set", setting)]
        seconds, watch = packuv(*words, "--stop-after", stop_after, "--frames", frames, *sets)
        made = json.loads((self.sequence / RUN).read_text())["artefacts"]
        return {
            "seconds": round(seconds, 1),
            "run_peak_bytes": watch.memory_bytes,
            "open_files": watch.files,
            "stages": by_stage(made),
        }


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    for group, values in settings.items():
        for name, value in values.items():
            if isinstance(value, Mapping):
                yield from _flat({f"{group}.{name}": value})
            else:
                yield group, name, value


def by_stage(artefacts: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Sums of time and size, and the largest memory, of the artefacts of each stage."""
    stages: dict[str, dict[str, float]] = {}
    for item in artefacts:
        empty = {"artefacts": 0, "seconds": 0.0, "cpu_seconds": 0.0, "peak_bytes": 0, "bytes": 0}
        stage = stages.setdefault(item["artefact"].partition("/")[0], empty)
        stage["artefacts"] += 1
        stage["seconds"] = round(stage["seconds"] + item["seconds"], 2)
        stage["cpu_seconds"] = round(stage["cpu_seconds"] + (item["cpu_seconds"] or 0), 2)
        stage["bytes"] += item["bytes"]
        stage["peak_bytes"] = max(stage["peak_bytes"], item["peak_memory_bytes"])
    return stages


# What is measured in a process of its own


@dataclass(frozen=True)
class Alone:
    """A job of `tasks.artefacts.jobs`: what a function of this module does with plain arguments."""

    name: str
    words: tuple[Any, ...]

    def __call__(self, progress: Progress) -> dict[str, Any]:
        told: dict[str, Any] = globals()[self.name](*self.words)
        return told


def probe(video: str) -> dict[str, Any]:
    return {"frames": probe_video(Path(video)).frame_count}


def decode(video: str) -> dict[str, Any]:
    """Every picture of a video, and no more."""
    reader = FrameReader({"camera": Path(video)})
    for frame in range(count := reader.frame_count("camera")):
        reader.read("camera", frame)
    return {"frames": count}


def sought(scene: str) -> dict[str, Any]:
    """Seconds until a scene is open, and until a frame from its middle is there."""
    start = time.perf_counter()
    with open_scene(Path(scene)) as opened:
        ready = time.perf_counter()
        opened.gaussians(len(opened) // 2)
        return {"open_seconds": ready - start, "frame_seconds": time.perf_counter() - ready}


def report(case: Case) -> dict[str, Any]:
    """The report of a run of which everything is there."""
    run = assembled(case)[1]
    start = time.perf_counter()
    files = write_report(collect(remains(run)), case.sequence)
    page = files.page.read_text()
    return {
        "report_seconds": time.perf_counter() - start,
        "html_bytes": files.page.stat().st_size,
        "json_bytes": files.json.stat().st_size,
        "rows": page.count("<tr"),
        "most_rows": max(table.count("<tr") for table in page.split("<table")),
        "bars": page.count("<rect"),
        "points": page.count("L"),
    }


def alone(folder: Path, name: str, *words: Any) -> dict[str, Any]:
    """What a function of this module gives in a process of its own, with what it took."""
    folder.mkdir(parents=True, exist_ok=True)
    job: Job = Alone(name, words)
    start = time.monotonic()
    done: Done = Jobs(threads=THREADS).run(job, folder=folder)
    return {
        **done.value,
        "seconds": round(time.monotonic() - start, 2),
        "cpu_seconds": done.cpu_seconds,
        "peak_bytes": done.peak_memory_bytes,
    }


# A scene as long as the capture


def assembled(case: Case, source: Case | None = None) -> tuple[Stages, Run]:
    """A run of the whole capture, whose segments are those of the fit of `source`, repeated. With `source`, they are
    made unless they are there; without it, all of the run is there, and only looked up for its report."""
    journal, jobs = Journal(), Jobs(threads=THREADS)
    engine = Engine(lambda make: lambda stage: There(make(stage)))
    sequence, run = prepare(case.request(), journal, engine, jobs)
    sequence.run("calibrate" if source else "flow")
    for stage, key in repeated(case, run.workshop.store, source):
        journal.started(stage)
        journal.finished(stage, key, 0.0)
        sequence.made.add(key)
    for make in (_encode, _verify, _score):
        make(sequence, run)
    return sequence, run


def _encode(sequence: Stages, run: Run) -> None:
    run.made.add(run.workshop.make(sequence.encoded()))


def _verify(sequence: Stages, run: Run) -> None:
    made = run.made
    run.made.add(run.workshop.make(Verify(scene=made.only("encode"), segments=tuple(made.keys["segment"]))))


def _score(sequence: Stages, run: Run) -> None:
    sequence.score(scored_cameras(run.plan, run.options.evaluate), run.options.pictures)


def repeated(case: Case, store: Store, source: Case | None) -> Iterator[tuple[str, Key]]:
    """Keyframes and segments for all instants, from those that were fitted."""
    plan = case.folder / f"segments{case.instants}.json"
    if source is not None and not plan.exists():
        save_json(plan, {"made": [[label, str(key)] for label, key in _repeat(case, store, source)]})
    for label, name in json.loads(plan.read_text())["made"]:
        stage, digest = name.split("/")
        yield label, Key(stage, digest, reused=True)


def _repeat(case: Case, store: Store, source: Case) -> Iterator[tuple[str, Key]]:
    fitted = json.loads((source.folder / "fitted.json").read_text())
    lender, done, number = Store(source.sequence / "store"), 0, 0
    pairs = list(zip(fitted["key"], fitted["segment"], strict=True))
    while done < case.instants:
        key, segment = (Key(*name.split("/")) for name in pairs[number % len(pairs)])
        number += 1
        if not store.holds(key):
            shutil.copytree(lender.path(key), store.root / str(key))
        whole = Segment.load(lender.path(segment) / SEGMENT)
        count = min(len(whole), case.instants - done)
        moved = replace(whole, first=done, xyz=whole.xyz[: count - 1], attributes=whole.attributes[: count - 1])
        label = f"fit segment {number} (frames {done}-{done + count - 1})"
        yield f"fit keyframe {done}", key
        yield label, store.make("segment", 0, {"first": done, "frames": count}, {"segment": segment}, _saver(moved))
        done += count


def _saver(segment: Segment) -> Callable[[Building], Mapping[str, Any]]:
    def build(building: Building) -> Mapping[str, Any]:
        segment.save(building.out / SEGMENT)
        return {}

    return build


def viewed(scene: Path) -> dict[str, Any]:
    """Seconds until `packuv view` answers, with the page's description and a frame from the middle; its memory."""
    start = time.monotonic()
    words = [sys.executable, "-m", "pipelines.cli", "view", str(scene), "--port", "0"]
    environment = {**os.environ, "BROWSER": "true"}
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        url = next(line for line in process.stdout if line.startswith("http")).strip()
        answers = time.monotonic() - start
        with urllib.request.urlopen(f"{url}scene.json") as answer:
            described = answer.read()
        count = len(json.loads(described)["times_ns"])
        described_after = time.monotonic() - start
        with urllib.request.urlopen(f"{url}frames/{count // 2}.bin") as answer:
            answer.read()
        return {
            "answers_seconds": round(answers, 2),
            "described_seconds": round(described_after, 2),
            "middle_frame_seconds": round(time.monotonic() - start, 2),
            "description_bytes": len(described),
            "peak_bytes": _peak_bytes(process.pid),
        }
    finally:
        process.terminate()
        process.wait()


def scene_of(case: Case, source: Case) -> dict[str, Any]:
    """All that is done with a scene as long as the capture."""
    start = time.monotonic()
    with Watch(os.getpid()) as watch:
        _, run = assembled(case, source)
    made = [_receipt(run.workshop.store, run.made.only(stage)) for stage in ("encode", "verify", "evaluate")]
    scene = run.workshop.path(run.made.only("encode")) / "scene.mkv"
    info, seen = packuv("info", str(scene))
    work = case.folder / "alone"
    return {
        "seconds": round(time.monotonic() - start, 1),
        "open_files": watch.files,
        "segments": len(run.made.keys["segment"]),
        "stages": by_stage(made),
        "scene_bytes": scene.stat().st_size,
        "info": {"seconds": round(info, 2), "peak_bytes": seen.memory_bytes},
        "view": viewed(scene),
        "seek": alone(work, "sought", str(scene)),
        "report": alone(work, "report", case),
    }


def _receipt(store: Store, key: Key) -> dict[str, Any]:
    receipt = store.receipt(key)
    names = ("seconds", "cpu_seconds", "peak_memory_bytes")
    return {"artefact": str(key), "bytes": receipt.size_bytes, **{name: getattr(receipt, name) for name in names}}


def growth(lengths: Mapping[int, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Of each stage that was measured at several lengths: exponents of memory and CPU time against length, and the
    bytes by which each instant raises the peak, from the shortest to the longest."""
    found = {}
    stages = {name for measured in lengths.values() for name in measured}
    for name in sorted(stages):
        known = {count: measured[name] for count, measured in lengths.items() if name in measured}
        if len(known) < 2:
            continue
        first, last = min(known), max(known)
        span = math.log(last / first)
        found[name] = {
            f"{figure}_exponent": round(math.log(known[last][figure] / known[first][figure]) / span, 3)
            for figure in ("peak_bytes", "cpu_seconds")
        }
        rise = known[last]["peak_bytes"] - known[first]["peak_bytes"]
        found[name]["bytes_an_instant"] = round(rise / (last - first))
    return found


def known(folder: Path, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What was measured by an earlier call, or now."""
    path = folder / "measured" / f"{name}.json"
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        save_json(path, make())
    measured: dict[str, Any] = json.loads(path.read_text())
    print(name, json.dumps(measured), flush=True)
    return measured


def measure(folder: Path, instants: Sequence[int]) -> dict[str, Any]:
    """All lengths."""
    folder.mkdir(parents=True, exist_ok=True)
    short, longest = film(folder / "short"), Case(folder, max(instants))
    results: dict[int, dict[str, Any]] = {count: {} for count in instants}
    for count in instants:
        case = Case(folder, count)
        lengthen(short, case.capture, count)
        video = str(sorted((case.capture / "videos").iterdir())[0])
        results[count] = {
            "probe": known(folder, f"probe{count}", partial(alone, folder / "alone", "probe", video)),
            "decode": known(folder, f"decode{count}", partial(alone, folder / "alone", "decode", video)),
            "flow": known(folder, f"flow{count}", partial(case.run, "flow")),
        }
    few = min(FITTED, longest.instants) // 2
    fit = known(folder, "fit", partial(longest.fit, few))
    for count in instants:
        results[count]["scene"] = known(folder, f"scene{count}", partial(scene_of, Case(folder, count), longest))
    lengths = {count: _stages(found) for count, found in results.items()}
    return {
        "cameras": CAMERAS,
        "size": SIZE,
        "settings": SETTINGS,
        "scene_threads": THREADS,
        "lengths": results,
        "fit": fit,
        "growth": growth(lengths),
    }


def _stages(found: Mapping[str, Any]) -> dict[str, Any]:
    """Every figure with a peak of its own, by name."""
    scene = found["scene"]
    named = {name: found[name] for name in ("probe", "decode")}
    stages: dict[str, Any] = named | found["flow"]["stages"] | scene["stages"] | {"report": scene["report"]}
    return stages


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("long", __doc__)
    parser.add_argument("--folder", type=Path, required=True, help="for captures and results, kept for the next call")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--instants", default="1000,6000,54000", help=f"lengths, multiples of {LOOP}")
    given = parser.parse_args(arguments)
    figures = measure(given.folder, [int(word) for word in given.instants.split(",")])
    given.out.write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps(figures["growth"], indent=1))


if __name__ == "__main__":
    main()
