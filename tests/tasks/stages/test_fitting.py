"""What fits take of a GPU, from what they will read."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from packuv.fit.gpu_memory import FitLoad, fit_memory
from packuv.fit.keyframe import KeyState, choose_quantizer
from packuv.fit.options import FirstOptions, FrameOptions, NextOptions
from packuv.fit.start.bounds import Bounds
from packuv.motion import MotionOptions
from pipelines.forecast import Guess, Machine, Size, forecast
from pipelines.options import compose
from sync.align import AlignOptions
from sync.capture import CaptureSettings
from tasks.artefacts.stage import Files, Site, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.fitting import FitBackdrop, FitFirst, FitNext, FitSegment, PatchBackdrop
from tasks.stages.footage import RIG, PictureOptions, Take
from tasks.stages.synchronize import Synchronize
from tests.support.artefacts import build_here, put
from tests.support.calibration_scene import ring
from tests.support.planes import write_planes
from tests.support.splats import random_gaussians

CAMERAS = ("cam00", "cam01", "cam02")
SET = {"fit": {"density": {"cap": 1000}, "backdrop_share": 0.8, "spare": 50, "sh_degree": 1, "start": {"count": 500}}}
FIT = compose("draft", CaptureSettings(), SET).fit
BOUNDS = Bounds(np.zeros(3), 1.0, 0.1)


@pytest.fixture
def work(tmp_path: Path) -> Work:
    """Of a capture of three pictures of 96x64."""
    (tmp_path / "capture" / "videos").mkdir(parents=True)
    for name in CAMERAS:
        grey = [np.full(shape, 512, np.uint16) for shape in ((64, 96),) * 3]
        write_planes(tmp_path / "capture" / "videos" / f"{name}.mkv", "yuv444p10le", [grey] * 3, (1, 1, 1, 1))
    site = Site(tmp_path / "store", tmp_path / "capture", 1, memory_bytes=1_000_000)
    return Work(site, tmp_path / "out", tmp_path / "scratch", lambda *told: None)


@pytest.fixture
def take(work: Work, tmp_path: Path) -> Take:
    """Of which pictures are halved."""
    stage = Synchronize(videos=Files(dict.fromkeys(CAMERAS, "film")), timecodes=Files({}), fps=None,
                        timecode_column=None, options=AlignOptions())  # fmt: skip
    _, folder = build_here(stage, work.site, tmp_path / "sync")
    groups = put(work.site, "sync", lambda out: shutil.copytree(folder, out, dirs_exist_ok=True))
    rig = put(work.site, "points", lambda out: ring(3, size=(96, 64)).save(out / RIG))
    return Take(groups=groups, rig=rig, cameras=CAMERAS, pictures=PictureOptions(max_width=48))


@pytest.fixture
def state(work: Work) -> Key:
    """A keyframe of 800 Gaussians of a backdrop, and 90 before it."""
    gaussians = random_gaussians(890, 1)
    found = KeyState(0, gaussians, 800, choose_quantizer(gaussians, BOUNDS, 1), BOUNDS, {})
    return put(work.site, "key", found.save)


def test_fits_foresee_what_they_read(work: Work, take: Take, state: Key) -> None:
    part, first = FIT.part, {"depths": 768 * 384}
    following = {"take": take, "previous": state, "options": part(NextOptions)}
    asked: dict[Stage, FitLoad] = {
        FitBackdrop(take=take, background=state, options=part(FirstOptions)): FitLoad([], 800, 0, 1, **first),
        FitFirst(take=take, instant=0, options=part(FirstOptions)): FitLoad([], 1000, 0, 1, **first),
        FitNext(**following, background=None, end=None, instant=1, motion=MotionOptions()): FitLoad([], 200, 800, 1),
        FitSegment(take=take, motion=state, key=state, span=(0, 2), options=part(FrameOptions), number=1):
            FitLoad([], 90 + 50, 800, 1, instants=2),
        PatchBackdrop(**following, before=state, after=state, epoch=1): FitLoad([], 1000, 800, 1),
    }  # fmt: skip
    for stage, load in asked.items():
        there = replace(load, sides=[(48, 32)] * 3)
        assert stage.gpu_memory(work) == fit_memory(there, budget_bytes=1_000_000), stage.label


def test_a_plan_foresees_no_less_than_its_fits(work: Work, take: Take) -> None:
    """Of those that start from a backdrop of the share that is set, or from nothing."""
    options = compose("draft", CaptureSettings(), {**SET, "pictures": {"max_width": 48}})
    planned = forecast(Size(3, ((96, 64),) * 3), options, Machine(Guess(), memory_bytes=1_000_000)).gpu_bytes
    stage = FitBackdrop(take=take, background=take.groups, options=FIT.part(FirstOptions))
    assert stage.gpu_memory(work).all_bytes <= planned <= 1.1 * stage.gpu_memory(work).all_bytes
