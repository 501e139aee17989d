"""Raw files that change while a run goes on: whatever happens when, no artefact says that it read what it did not."""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sync.capture import find_capture
from tasks.artefacts import digests
from tasks.artefacts.digests import file_digest, signature
from tasks.artefacts.originals import Originals
from tasks.artefacts.store import Key, Store
from tasks.artefacts.workshop import Workshop

WORK = """
from __future__ import annotations
import sys, time
from dataclasses import dataclass
from pathlib import Path
from sync.capture import find_capture
from tasks.artefacts.jobs import Jobs
from tasks.artefacts.originals import Originals
from tasks.artefacts.stage import Files, Stage
from tasks.artefacts.store import Store
from tasks.artefacts.workshop import Workshop

class Quiet:
    def __getattr__(self, name):
        return lambda *values: None

@dataclass(frozen=True, kw_only=True)
class ReadSlowly(Stage):
    '''Reads a video into a checkpoint, says so, and waits until it may go on.'''
    name, version = "read", 1
    videos: Files

    def build(self, work):
        signals, checkpoint = work.site.store.parent / "signals", work.scratch / "checkpoint"
        if not checkpoint.exists():
            checkpoint.write_bytes(find_capture(work.site.capture).videos["cam01"].read_bytes())
        number = len(list(signals.glob("reading*")))
        (signals / f"reading{number}").touch()
        while not (signals / f"go{number}").exists():
            time.sleep(0.01)
        (work.out / "read").write_bytes(checkpoint.read_bytes())

def workshop_of(folder: Path) -> Workshop:
    originals = Originals(find_capture(folder / "capture"), folder / "file_digests.json")
    return Workshop(Store(folder / "store"), originals, Jobs(threads=1), Quiet())

def stage_of(workshop) -> ReadSlowly:
    return ReadSlowly(videos=workshop.files(workshop.capture.videos, "reading videos"))

if __name__ == "__main__":
    workshop = workshop_of(Path(sys.argv[1]))
    import packuv_test_reading
    workshop.make(packuv_test_reading.stage_of(workshop))
"""
RIGHT, WRONG = b"what was filmed", b"what was broken"


@dataclass
class Lab:
    """A capture, and a stage that reads it as slowly as a test wants."""

    folder: Path
    work: ModuleType

    @property
    def video(self) -> Path:
        return self.folder / "capture/videos/cam01.mp4"

    def replace_video(self, content: bytes) -> None:
        """As rsync does."""
        part = self.folder / "part"
        part.write_bytes(content)
        os.replace(part, self.video)

    def edit(self, text: str) -> None:
        (self.folder / "capture/capture.toml").write_text(text)

    def let_go(self, *attempts: int) -> None:
        for attempt in attempts:
            (self.folder / f"signals/go{attempt}").touch()

    def wait_for(self, attempt: int) -> None:
        deadline = time.monotonic() + 60
        while not (self.folder / f"signals/reading{attempt}").exists():
            assert time.monotonic() < deadline, "the job does not read"
            time.sleep(0.01)

    @property
    def attempts(self) -> int:
        return len(list((self.folder / "signals").glob("reading*")))

    def begin(self) -> tuple[Workshop, Any]:
        """A run that has taken the digests of the videos, and its stage."""
        workshop = self.work.workshop_of(self.folder)
        return workshop, self.work.stage_of(workshop)

    def made(self, key: Key) -> bytes:
        return (Store(self.folder / "store").path(key) / "read").read_bytes()


@pytest.fixture
def lab(tmp_path, monkeypatch) -> Lab:
    (tmp_path / "packuv_test_reading.py").write_text(WORK)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "packuv_test_reading", raising=False)
    for name in ("capture/videos", "signals"):
        (tmp_path / name).mkdir(parents=True)
    for camera in ("cam01", "cam02"):
        (tmp_path / f"capture/videos/{camera}.mp4").write_bytes(RIGHT)
    found = Lab(tmp_path, importlib.import_module("packuv_test_reading"))
    found.edit('name = "lab"')
    return found


def touch(lab: Lab) -> None:
    os.utime(lab.video)


def replace_and_restore(lab: Lab) -> None:
    lab.replace_video(WRONG)
    lab.replace_video(RIGHT)


def overwrite_and_hide(lab: Lab) -> None:
    """The same inode, size and time of modification."""
    before = lab.video.stat()
    lab.video.write_bytes(WRONG)
    os.utime(lab.video, ns=(before.st_atime_ns, before.st_mtime_ns))


def add_masks(lab: Lab, camera: str) -> None:
    """A folder that is there at once, with a mask in it."""
    made = lab.folder / "made" / camera
    made.mkdir(parents=True)
    (made / "000000.png").write_bytes(b"a mask")
    made.parent.rename(lab.folder / "capture" / "masks")


CHANGES = [
    (lambda lab: lab.replace_video(WRONG), r"cam01\.mp4 has another content than when this run began; put back"),
    (overwrite_and_hide, r"cam01\.mp4 has another content than when this run began"),
    (lambda lab: lab.video.unlink(), r"cam01\.mp4 has gone since this run began"),
    (lambda lab: (lab.video.parent / "cam03.mp4").touch(), r"cam03\.mp4 was added since this run began"),
    (lambda lab: add_masks(lab, "cam01"), r"masks/cam01 was added since this run began"),
    (lambda lab: lab.edit("fps = 25"), r"capture\.toml .* than when this run began; put back what was there, or run"),
]
IDS = ["replaced", "overwritten", "removed", "added", "masks", "settings"]


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=IDS)
def test_a_change_before_a_stage_is_refused_and_its_job_does_not_start(lab, change, message):
    workshop, stage = lab.begin()
    change(lab)
    with pytest.raises(ValueError, match=message):
        workshop.make(stage)
    assert (lab.attempts, list(workshop.store.keys())) == (0, [])


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=IDS)
def test_a_change_during_a_stage_is_refused_and_nothing_is_published(lab, change, message):
    workshop, stage = lab.begin()
    with ThreadPoolExecutor(max_workers=1) as pool:
        making = pool.submit(workshop.make, stage)
        lab.wait_for(0)
        change(lab)
        lab.let_go(0)
        with pytest.raises(ValueError, match=message):
            making.result()
    assert (lab.attempts, list(workshop.store.keys())) == (1, [])


@pytest.mark.parametrize("move", [touch, replace_and_restore])
def test_what_moved_during_a_stage_and_is_the_same_costs_a_second_reading(lab, move):
    workshop, stage = lab.begin()
    with ThreadPoolExecutor(max_workers=1) as pool:
        making = pool.submit(workshop.make, stage)
        lab.wait_for(0)
        move(lab)
        lab.let_go(0, 1)
        key = making.result()
    assert (lab.attempts, lab.made(key)) == (2, RIGHT)
    assert workshop.make(stage).reused


def test_what_moves_time_and_again_is_refused(lab):
    workshop, stage = lab.begin()
    with ThreadPoolExecutor(max_workers=1) as pool:
        making = pool.submit(workshop.make, stage)
        for attempt in range(2):
            lab.wait_for(attempt)
            touch(lab)
            lab.let_go(attempt)
        with pytest.raises(
            ValueError, match=r"^videos/cam01\.mp4 moved twice while 'read' read the capture \(.*\); let"
        ):
            making.result()
    assert list(workshop.store.keys()) == []


def test_a_video_that_was_another_one_between_stages_is_no_harm(lab):
    workshop, stage = lab.begin()
    replace_and_restore(lab)
    lab.let_go(0)
    assert lab.made(workshop.make(stage)) == RIGHT
    assert lab.attempts == 1


@pytest.mark.parametrize("moved", [True, False])
def test_after_a_kill_a_checkpoint_counts_only_if_the_video_did_not_move(lab, moved):
    workshop, stage = lab.begin()
    command = [sys.executable, str(lab.folder / "packuv_test_reading.py"), str(lab.folder)]
    with subprocess.Popen(command) as killed:
        lab.wait_for(0)
        if moved:
            lab.replace_video(WRONG)  # a later frame would come from here ...
        (checkpoint,) = (lab.folder / "store/.work").glob("*/*/scratch/checkpoint")
        checkpoint.write_bytes(b"as far as the kill")
        killed.send_signal(signal.SIGKILL)
    if moved:
        lab.replace_video(RIGHT)  # ... and nobody sees it, for the run goes on with the right video
    lab.let_go(0, 1)
    assert lab.made(workshop.make(stage)) == (RIGHT if moved else b"as far as the kill")


def test_work_that_was_done_before_a_kill_counts_only_if_no_raw_file_moved_since(tmp_path, monkeypatch):
    store, state, calls = Store(tmp_path), {"cam01.mp4": [1]}, []

    def make() -> Key:
        return store.make("read", 1, None, {}, lambda building: calls.append(1), originals=lambda: dict(state))

    def dies(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Store, "_publish", dies)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                make()
        assert len(calls) == 1
        state["cam01.mp4"] = [2]
        with pytest.raises(KeyboardInterrupt):
            make()
        assert len(calls) == 2
    make()
    assert len(calls) == 2


def test_a_failure_while_a_wrong_file_was_in_place_is_not_believed(tmp_path):
    store, state, calls = Store(tmp_path), {"cam01.mp4": [1]}, []

    def build(building: Any) -> None:
        calls.append(1)
        if len(calls) == 1:
            state["cam01.mp4"] = [2]
            raise RuntimeError("no frame 7")
        assert not list(building.scratch.iterdir())

    store.make("read", 1, None, {}, build, originals=lambda: dict(state))
    assert len(calls) == 2


def test_contents_are_read_again_only_where_something_moved(lab, monkeypatch):
    read: list[str] = []
    digest: Callable[[Path], str] = digests.file_digest

    def counted(path: Path) -> str:
        read.append(path.name)
        return digest(path)

    monkeypatch.setattr(digests, "file_digest", counted)
    monkeypatch.setattr(digests, "SETTLED_SECONDS", 0)
    originals = Originals(find_capture(lab.folder / "capture"), lab.folder / "file_digests.json")
    originals.digests(originals.capture.videos)
    first = originals.look()
    assert sorted(read) == ["cam01.mp4", "cam02.mp4", "capture.toml"]
    assert originals.look() == first
    touch(lab)
    assert originals.look() != first
    assert read[3:] == ["cam01.mp4"]


def test_a_memory_without_the_time_of_change_is_not_believed(lab):
    """As versions before this rule left it."""
    stat, memory = lab.video.stat(), lab.folder / "file_digests.json"
    entry = [stat.st_size, stat.st_mtime_ns, stat.st_ino, "0" * 64]
    digests.write_json(memory, {str(lab.video.resolve()): entry})
    assert digests.FileDigests(memory)({"cam01": lab.video}) == {"cam01": digests.file_digest(lab.video)}


def test_a_run_that_began_with_other_settings_is_refused_although_nothing_was_read_yet(lab):
    capture = find_capture(lab.folder / "capture")
    lab.edit("fps = 25")
    originals = Originals(replace(capture), lab.folder / "file_digests.json")
    with pytest.raises(ValueError, match=r"capture\.toml says something else than when this run began"):
        originals.look()


def test_a_folder_changes_with_any_of_its_pictures(tmp_path):
    folder = tmp_path / "cam1"
    folder.mkdir()
    for name in ("0.png", "1.png"):
        (folder / name).write_bytes(name.encode())
    before, content = signature(folder), file_digest(folder)
    (folder / ".DS_Store").write_bytes(b"of no account")
    assert file_digest(folder) == content
    seen = set[str]()
    for change in (
        lambda: (folder / "0.png").write_bytes(b"other"),
        lambda: (folder / "0.png").rename(folder / "2.png"),
        lambda: (folder / "3.png").write_bytes(b"new"),
        lambda: (folder / "3.png").unlink(),
    ):
        change()
        assert signature(folder) != before
        before = signature(folder)
        seen.add(file_digest(folder))
    assert len(seen) == 3
    assert content not in seen
    twin = tmp_path / "twin"
    shutil.copytree(folder, twin)
    assert file_digest(twin) == file_digest(folder)
