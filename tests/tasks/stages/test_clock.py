"""The stage that finds when cameras began: stopped, killed, and of what it is made."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.events import Journal
from sync.capture import find_capture
from sync.content.sound import RATE
from tasks.artefacts.jobs import Jobs
from tasks.artefacts.originals import Originals
from tasks.artefacts.recipe import digest, plain
from tasks.artefacts.stage import Site, Work
from tasks.artefacts.store import Store
from tasks.artefacts.workshop import Workshop
from tasks.stages.clock import FindStarts, find_starts
from tests.support.places import ROOT
from tests.support.sounds import recorded, room, write_video
from tests.tasks.stages.test_content import MOTION_OPTIONS, film, write_calibration

LATE = {0: 6.0, 1: 0.0, 2: 3.4, 3: 11.0, 4: 1.0}
DIES = """
import os, pickle, signal, sys
from pathlib import Path
from tasks.artefacts.stage import Work

stage, site, folder, share = pickle.loads(Path(sys.argv[1]).read_bytes())

def dies(done, total, note=""):
    if not note and done > share * total:
        os.kill(os.getpid(), signal.SIGKILL)

stage.build(Work(site, folder / "first", folder / "scratch", dies))
"""


class Stopped(BaseException):
    """As Ctrl-C is."""


def filmed(folder: Path) -> Site:
    site = Site(folder / "store", folder / "capture", 1)
    film(site.capture, LATE)
    write_calibration(site.capture)
    for name in ("scratch", "whole", "first", "second"):
        (folder / name).mkdir()
    return site


def clock_of(site: Site) -> FindStarts:
    originals = Originals(find_capture(site.capture), site.store / "file_digests.json")
    return find_starts(Workshop(Store(site.store), originals, Jobs(threads=1), Journal()), MOTION_OPTIONS, None)


def test_a_clock_that_was_stopped_goes_on(tmp_path: Path) -> None:
    """And finds what it would have found at one go."""
    site = filmed(tmp_path)
    stage, seen = clock_of(site), list[float]()

    def stop_half_way(done: float, total: float, note: str = "") -> None:
        if not note and done > total / 2:
            raise Stopped

    scratch = tmp_path / "scratch"
    with pytest.raises(Stopped):
        stage.build(Work(site, tmp_path / "first", scratch, stop_half_way))
    assert not list((tmp_path / "first").iterdir())
    stage.build(Work(site, tmp_path / "second", scratch, lambda *told: seen.append(told[0]) if len(told) < 3 else None))
    assert seen[0] > 0, "what was measured is not measured again"
    stage.build(Work(site, tmp_path / "first", tmp_path / "whole", lambda *_: None))
    assert (tmp_path / "first" / "starts.json").read_bytes() == (tmp_path / "second" / "starts.json").read_bytes()


def test_a_clock_that_was_killed_goes_on(tmp_path: Path) -> None:
    site = filmed(tmp_path)
    stage = clock_of(site)
    for share in (0.2, 0.6):
        (tmp_path / "spec").write_bytes(pickle.dumps((stage, site, tmp_path, share)))
        died = subprocess.run([sys.executable, "-c", DIES, str(tmp_path / "spec")], cwd=ROOT, check=False)
        assert died.returncode == -signal.SIGKILL
    assert not list((tmp_path / "first").iterdir())
    stage.build(Work(site, tmp_path / "second", tmp_path / "scratch", lambda *_: None))
    stage.build(Work(site, tmp_path / "first", tmp_path / "whole", lambda *_: None))
    assert (tmp_path / "first" / "starts.json").read_bytes() == (tmp_path / "second" / "starts.json").read_bytes()


def test_a_clock_is_that_of_its_sound_footage_and_settings(tmp_path: Path) -> None:
    """Whatever of them changes, it is found anew."""
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    (site.capture / "videos").mkdir(parents=True)
    for number in range(3):
        write_video(site.capture / "videos" / f"cam{number}.mkv", recorded(room(), number, number)[: 3 * RATE])
    recipes = [digest(plain(clock_of(site)))]
    assert recipes == [digest(plain(clock_of(site)))]
    write_video(site.capture / "videos" / "cam1.mkv", recorded(room(), 1.5, 1)[: 3 * RATE])  # another sound
    recipes.append(digest(plain(clock_of(site))))
    (site.capture / "timecodes").mkdir()
    for number in range(3):
        (site.capture / "timecodes" / f"cam{number}.txt").write_text("".join(f"{k * 100}\n" for k in range(20)))
    recipes.append(digest(plain(clock_of(site))))
    (site.capture / "capture.toml").write_text("fps = 10")
    recipes.append(digest(plain(clock_of(site))))
    (site.capture / "calibration").mkdir()
    (site.capture / "calibration" / "transforms.json").write_text("{}")
    recipes.append(digest(plain(clock_of(site))))
    assert len(set(recipes)) == len(recipes)
