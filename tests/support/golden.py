"""What each stage makes of a tiny input, by digest: a stage whose results change must change its version.

    python -m tests.support.golden            what the stages make now, as JSON
    python -m tests.support.golden --write    and into golden.json, if every stage that changed has another version

The capture in tests/golden/capture was made by `packuv simulate`; it is kept, so that it stays what it is.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.places import ROOT

FOLDER = ROOT / "tests/golden"
RECORD = FOLDER / "golden.json"
SETTINGS: dict[str, Any] = {
    "keyframes": {"separation": 2, "max_segment": 3},
    "points": {"more_instants": [3]},
    "fit": {
        "iterations": 20,
        "key_iterations": 8,
        "frame_iterations": 4,
        "spare": 40,
        "key_births": 40,
        "opacity_weight": 0.01,
        "scale_weight": 0.01,
        "start": {"count": 300},
        "shell": {"columns": 128, "steps": 24},
        "density": {"cap": 400},
    },
}
LATE_VECTORS = "X86_V4 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
"""Of NumPy, by the names of its versions 2.4 and before"""
ENVIRONMENT = {
    # Digests hold for one set of instructions: that of Intel's Haswell, which every x86-64 machine since has.
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+64bit,+avx,+avx2,+bmi,+bmi2,+cmov,+cx16,+f16c,+fma,+lzcnt,+movbe,+popcnt,+sse,+sse2,+sse3,"
    "+sse4.1,+sse4.2,+ssse3",
    "NPY_DISABLE_CPU_FEATURES": LATE_VECTORS,
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX512-CNL,AVX512-CLX,AVX512-ICL,AVX512-COMMON",
    "OPENCV_IPP": "disabled",
}
Found = dict[str, dict[str, Any]]
"""By stage: version, and digests of what it read and of what it made"""


def measure() -> Found:
    """What the stages make now, in a process that has the instructions of ENVIRONMENT only."""
    environment = {**os.environ, **ENVIRONMENT, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "tests.support.golden", "--here"]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the stages failed on the tiny input:\n{done.stderr}")
    found: Found = json.loads(done.stdout)
    return found


def problems(before: Found, now: Found) -> dict[str, str]:
    """What is wrong, by stage; empty where the record tells the truth."""
    found = {}
    for stage in before.keys() | now.keys():
        if stage not in now or stage not in before:
            found[stage] = f"is {'no stage any more' if stage in before else 'new'}: write the record anew"
        elif before[stage] != now[stage]:
            same_version = before[stage]["version"] == now[stage]["version"]
            same_inputs = before[stage]["inputs"] == now[stage]["inputs"]
            if same_version and same_inputs:
                found[stage] = f"makes something else of the same input, but still has version {now[stage]['version']}"
            else:
                found[stage] = "has another version or another input: write the record anew"
    return found


def write() -> None:
    """Replace the record; raises ValueError for a stage that changed without a new version."""
    before = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    now = measure()
    lies = [f"{stage} {text}" for stage, text in problems(before, now).items() if "still has version" in text]
    if lies:
        raise ValueError(f"raise these versions first: {'; '.join(lies)}")
    RECORD.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n")


def _measure_here() -> Found:
    from packuv.fit.options import FirstOptions, NextOptions
    from packuv.motion.patches import Patch, Patches
    from packuv.progress import no_progress
    from pipelines.options import compose
    from pipelines.stages import Made, Sequence
    from sync.capture import find_capture
    from tasks.artefacts.jobs import Jobs
    from tasks.artefacts.originals import Originals
    from tasks.artefacts.stage import Site, Stage, Work
    from tasks.artefacts.store import Key, Store
    from tasks.artefacts.workshop import Workshop
    from tasks.stages.calibrate import borrow_rig
    from tasks.stages.fitting import CutSegment, FitFirst, FitNext, PatchBackdrop, PatchBackground, background_of
    from tasks.stages.footage import Take
    from tasks.stages.plan import Plan
    from tasks.stages.track import PATCHES, ChooseDatedKeyframes

    capture, found = find_capture(FOLDER / "capture"), Found()
    made: dict[str, str] = {}

    class Quiet:
        def __getattr__(self, name: str) -> Any:
            return lambda *values: None

    class Done:
        def __init__(self, key: Key) -> None:
            self.key = key

        def result(self) -> Key:
            return self.key

    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / capture.name / "store")
        site = Site(store.root, capture.folder, 1)

        def plant(building: Any) -> Mapping[str, Any]:
            """Most of each picture changes for good at instant 3, as nothing does in the tiny capture."""
            mask = np.zeros((12, 16), bool)
            mask[2:10, 2:14] = True
            Patches((Patch(3, dict.fromkeys(range(4), mask)),)).save(building.out / PATCHES)
            return {}

        def make(stage: Stage, site: Site = site) -> Key:
            def build(building: Any) -> Mapping[str, Any]:
                return stage.build(Work(site, building.out, building.scratch, no_progress))

            key = store.make(stage.name, stage.version, stage.settings, stage.sources, build)
            made[str(key)] = _content(store.path(key))
            entry = {"version": stage.version, "inputs": _inputs(stage, made), "outputs": made[str(key)]}
            found.setdefault(type(stage).__name__, entry)
            return key

        plan = Plan(capture.folder, capture.videos, ("cam03",), 0, None, "cpu", True)
        options = compose("draft", capture.settings, SETTINGS)
        options = replace(options, keyframes=replace(options.keyframes, seam=100.0))
        memory = Path(folder) / "file_digests.json"
        originals = Originals(capture, memory)
        workshop = Workshop(store, originals, Jobs(threads=1), Quiet())
        steps: list[Stage] = []

        def submit(stage: Stage) -> Done:
            steps.append(stage)
            return Done(make(stage))

        sequence = Sequence(workshop, plan, options, submit, Made(), watched=True)
        sequence.run("report")
        only, rig = sequence.made.only, options.rig
        make(borrow_rig(workshop, plan, only("sync"), options.pictures, workshop, only("rig"), rig))
        empty = _copied(capture.folder, Path(folder) / "take02", clean_plate=capture.folder)
        take = Take(groups=only("sync"), rig=only("points"), cameras=plan.fitted, stop=3)
        elsewhere = replace(workshop, originals=Originals(find_capture(empty), memory))
        make(background_of(elsewhere, take, options.fit.background), replace(site, capture=empty))
        key, segment = sequence.made.keys["key"][0], sequence.made.keys["segment"][0]
        planted = store.make("patches", 1, {"planted": 3}, {}, plant)
        made[str(planted)] = _content(store.path(planted))
        make(ChooseDatedKeyframes(motion=only("motion"), options=options.keyframes, patches=planted))
        background, backdrop = only("background"), only("backdrop")
        own = make(PatchBackground(take=take, background=background, patches=planted, epoch=0,
                                   options=options.fit.background))  # fmt: skip
        make(PatchBackdrop(take=take, previous=backdrop, before=background, after=own,
                           options=options.fit.part(NextOptions), epoch=0))  # fmt: skip
        make(CutSegment(segment=segment, frames=2))
        make(FitFirst(take=take, instant=0, options=options.fit.part(FirstOptions)))  # this capture has a backdrop
        following = next(stage for stage in steps if isinstance(stage, FitNext))
        going_on = replace(following, previous=key, end=segment, instant=3)
        found["FitNext, from a segment's end"] = {
            "version": going_on.version,
            "inputs": _inputs(going_on, made),
            "outputs": _content(store.path(make(going_on))),
        }
    return found


def _copied(capture: Path, target: Path, **keys: Path) -> Path:
    """A copy of a capture whose capture.toml says more."""
    shutil.copytree(capture, target)
    lines = [f'{name} = "{value}"' for name, value in keys.items()]
    (target / "capture.toml").write_text("\n".join([(capture / "capture.toml").read_text(), *lines]))
    return target


def _inputs(stage: Any, made: Mapping[str, str]) -> str:
    """Digest of a stage's settings and of the contents that it reads."""
    from tasks.artefacts.recipe import digest
    from tasks.artefacts.store import named

    text = json.dumps(named(stage.sources), sort_keys=True, default=lambda value: vars(value))
    for name, content in made.items():
        text = text.replace(name, content)
    return digest({"settings": stage.settings, "sources": text})[:16]


def _content(folder: Path) -> str:
    """Digest of what an artefact holds, without the times that it took."""
    sha256 = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "receipt.json"):
        sha256.update(str(path.relative_to(folder)).encode())
        match path.suffix:
            case ".json":
                sha256.update(json.dumps(_timeless(json.loads(path.read_text())), sort_keys=True).encode())
            case ".npz":
                with np.load(path) as arrays:
                    for name in sorted(arrays.files):
                        sha256.update(name.encode() + arrays[name].tobytes())
            case _:
                sha256.update(path.read_bytes())
    return sha256.hexdigest()[:16]


def _timeless(value: Any) -> Any:
    match value:
        case dict():
            return {name: _timeless(item) for name, item in value.items() if name != "seconds"}
        case list():
            return [_timeless(item) for item in value]
    return value


if __name__ == "__main__":
    if "--here" in sys.argv:
        print(json.dumps(_measure_here()))
    elif "--write" in sys.argv:
        write()
    else:
        print(json.dumps(measure(), indent=1, sort_keys=True))
