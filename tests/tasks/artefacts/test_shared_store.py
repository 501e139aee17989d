"""A store on a folder that machines share, where the kernel's locks do not reach: what is there is whole all the same.

Machines are processes here to which `flock` does nothing and whose machine has a name of its own, so that neither lock
nor table of processes tells one what the other does. Leases are short.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tasks.artefacts import presence
from tasks.artefacts import store as stores
from tasks.artefacts.presence import LostError, clock, is_alive, is_ended, is_here, is_name, own_name
from tasks.artefacts.store import RECEIPT, Building, Key, Store

LEASE = 3.0
STEPS = 8
MACHINE = f"""
import fcntl, os, sys, time
from pathlib import Path
fcntl.flock = lambda *_: None
from tasks.artefacts import presence, store
presence.LEASE_SECONDS, presence.BEAT_SECONDS, presence.LOOK_SECONDS = {LEASE}, 0.2, 0.05
store.CLAIM_POLL_SECONDS = 0.1
root, machine, pause = sys.argv[1], sys.argv[2], float(sys.argv[3])
presence.machine = lambda: machine
shop = store.Store(root)
"""
BUILDER = (
    MACHINE
    + f"""
def write(path, text):
    path.with_suffix(".part").write_text(text)
    os.replace(path.with_suffix(".part"), path)

def build(building):
    for step in range({STEPS}):
        mark = building.scratch / f"{{step}}.txt"
        if mark.exists():
            print("kept", step, flush=True)
        else:
            print("step", step, flush=True)
            time.sleep(pause)
            write(mark, str(step) * 1000)
        building.check()
    for step in range({STEPS}):
        (building.out / f"{{step}}.txt").write_text((building.scratch / f"{{step}}.txt").read_text())
    print("built", flush=True)

key = shop.make("fit", 1, None, {{}}, build)
print("reused" if key.reused else "made", flush=True)
"""
)


@pytest.fixture
def key(tmp_path) -> Key:
    return Store(tmp_path).key("fit", 1, None, {})


@contextlib.contextmanager
def running(
    root: Path, machine: str, *, pause: float = 0.05, program: str = BUILDER
) -> Iterator[subprocess.Popen[str]]:
    """A process of another machine; ended at the end."""
    command = [sys.executable, "-c", program, str(root), machine, str(pause)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        process.communicate()


def until(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdout is not None
    while (told := process.stdout.readline()) != f"{line}\n":
        assert told, f"it ended before it said {line!r}"


def check_whole(root: Path, key: Key) -> None:
    """The artefact is what one builder makes, and nothing of its building is left."""
    store = Store(root)
    assert store.verify() == []
    texts = {path.name: path.read_text() for path in store.path(key).glob("*.txt")}
    assert texts == {f"{step}.txt": str(step) * 1000 for step in range(STEPS)}
    assert not store.work_folder(key).exists()


# --- who is there


def test_a_name_tells_whose_it_is():
    own = own_name()
    assert is_here(own)
    assert not is_ended(own)
    host, machine, pid, started, chance = own.rsplit("-", 4)
    assert int(pid) == os.getpid()
    assert is_ended(f"{host}-{machine}-{pid}-{int(started) + 1}-{chance}")  # an earlier process had the number
    assert not is_here(f"{host}-0123456789ab-{pid}-{started}-{chance}")
    assert not is_ended(f"{host}-0123456789ab-{pid}-{int(started) + 1}-{chance}")  # nobody here can tell
    for no_name in ("", "out", "gone-fit-00", "a-b-c-d-e"):
        assert not is_here(no_name)
        assert not is_ended(no_name)
        assert not is_name(no_name)


def test_a_process_that_ended_is_gone_at_once_and_a_silent_one_after_its_lease(tmp_path):
    code = "from tasks.artefacts.presence import own_name; print(own_name())"
    ended = tmp_path / subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip()
    elsewhere = tmp_path / "elsewhere-0123456789ab-1-1-00000000"
    for path in (ended, elsewhere, tmp_path / own_name()):
        path.touch()
    assert all(is_alive(path) == (path != ended) for path in tmp_path.iterdir())
    os.utime(elsewhere, (time.time() - presence.LEASE_SECONDS - 1,) * 2)
    assert not is_alive(elsewhere)
    assert not is_alive(tmp_path / "elsewhere-0123456789ab-2-1-00000000")


def test_the_clock_is_that_of_the_file_system(tmp_path, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 0.0)  # a machine whose clock is wrong
    (tmp_path / "file").touch()
    assert abs(clock(tmp_path) - (tmp_path / "file").stat().st_mtime) < 5
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# --- one artefact, several machines


@pytest.mark.parametrize("machines", ["ab", "aa"])
def test_of_two_builders_without_locks_one_builds_and_the_other_waits(tmp_path, key, machines):
    with running(tmp_path, machines[0]) as first:
        until(first, "step 0")
        with running(tmp_path, machines[1]) as second:
            assert first.communicate()[0].split("\n")[-2] == "made"
            assert second.communicate()[0] == "reused\n"
    check_whole(tmp_path, key)


@pytest.mark.parametrize("moment", ["step 3", "built"])
def test_a_builder_that_is_silent_past_its_lease_is_overtaken_and_does_no_harm(tmp_path, key, moment):
    with running(tmp_path, "a", pause=0.2) as silent:
        until(silent, moment)
        silent.send_signal(signal.SIGSTOP)
        with running(tmp_path, "b") as other:
            told = other.communicate()[0].split("\n")
            assert told[-2] in ("made", "reused")
            if moment == "step 3":
                assert told[:4] == ["kept 0", "kept 1", "kept 2", "step 3"]  # with what the first one had
        check_whole(tmp_path, key)
        before = {path: path.stat().st_ino for path in Store(tmp_path).path(key).iterdir()}
        silent.send_signal(signal.SIGCONT)
        assert silent.communicate()[0].split("\n")[-2] == "reused"
        assert silent.returncode == 0
    check_whole(tmp_path, key)
    assert {path: path.stat().st_ino for path in Store(tmp_path).path(key).iterdir()} == before


def test_what_a_silent_builder_holds_open_is_not_what_the_other_reads(tmp_path):
    """It may wake up at any moment and write on, for names that have gone do not close a file."""
    store, names = Store(tmp_path), []

    def fails(building: Building) -> None:
        (building.scratch / "state.txt").write_text("whole")
        names.append(building.scratch / "state.txt")
        raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        store.make("fit", 1, None, {}, fails)
    left = names[0].parents[1]
    silent = left.with_name("elsewhere-0123456789ab-1-1-00000000")
    left.rename(silent)
    (silent / "released").unlink()
    os.utime(silent, (0, 0))

    def build(building: Building) -> None:
        written.write("torn")
        written.flush()
        (building.out / "state.txt").write_text((building.scratch / "state.txt").read_text())

    with open(silent / "scratch" / "state.txt", "w") as written:
        written.write("whole")
        written.flush()
        key = store.make("fit", 1, None, {}, build)
    assert (store.path(key) / "state.txt").read_text() == "whole"
    assert store.verify() == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_builders_stopped_killed_and_woken_at_any_moment_leave_it_whole(tmp_path, key, seed):
    rng, store, seen = random.Random(seed), Store(tmp_path), 0
    with contextlib.ExitStack() as stack:
        crew = [stack.enter_context(running(tmp_path, machine, pause=0.1)) for machine in "abc"]
        stopped: list[subprocess.Popen[str]] = []
        deadline = time.monotonic() + 120
        while any(one.poll() is None for one in crew) and time.monotonic() < deadline:
            time.sleep(rng.uniform(0, 0.25))
            if store.holds(key):  # a reader at any moment
                assert store.verify() == []
                seen += 1
            busy = [one for one in crew if one.poll() is None and one not in stopped]
            what = rng.random()
            if busy and what < 0.15:
                stopped.append(rng.choice(busy))
                stopped[-1].send_signal(signal.SIGSTOP)
            elif stopped and what > 0.85:
                stopped.pop(rng.randrange(len(stopped))).send_signal(signal.SIGCONT)
            elif busy and len(busy) > 1 and what > 0.82:
                rng.choice(busy).kill()
                crew.append(stack.enter_context(running(tmp_path, rng.choice("abcd"), pause=0.1)))
        assert all(one.poll() in (0, -signal.SIGKILL) for one in crew)
    assert seen
    check_whole(tmp_path, key)


def test_of_two_who_publish_the_first_wins(tmp_path, monkeypatch, key):
    """As where the other was not seen in time: each builds, in a folder of its own."""
    one, other = Store(tmp_path), Store(tmp_path)
    monkeypatch.setattr(stores, "_goes_on", lambda place: False)
    monkeypatch.setattr(stores, "_take_over", lambda left, own: None)
    monkeypatch.setattr("fcntl.flock", lambda *_: None)

    def write(text: str):
        return lambda building: (building.out / "data.txt").write_text(text) and None

    def slow(building: Building) -> None:
        (building.out / "data.txt").write_text("second")
        made = other.make("fit", 1, None, {}, write("first"))
        assert not made.reused

    assert one.make("fit", 1, None, {}, slow).reused
    assert (one.path(key) / "data.txt").read_text() == "first"
    assert one.verify() == []
    assert not one.work_folder(key).exists()


@pytest.mark.parametrize("looks", [1, 3, 4, 5])
def test_what_the_system_remembers_of_a_server_does_no_harm(tmp_path, monkeypatch, looks):
    """The cache of a network file system says "not there" for a while; each look afresh may still come too early."""
    store, calls, whole = Store(tmp_path), [], stores._is_whole

    def build(building: Building) -> None:
        calls.append(1)
        (building.out / "data.txt").write_text("x")

    key = store.make("fit", 1, None, {}, build)
    stale = [True] * looks
    monkeypatch.setattr(stores, "look_afresh", lambda folder: stale and stale.pop())
    monkeypatch.setattr(stores, "_is_whole", lambda folder: not stale and whole(folder))
    assert store.make("fit", 1, None, {}, build).reused or len(calls) == 2
    stale.clear()
    assert len(calls) == (1 if looks <= 3 else 2)
    assert store.holds(key)
    assert store.verify() == []


def test_a_folder_that_lost_its_receipt_gives_way_and_one_that_came_just_now_does_not(tmp_path, monkeypatch):
    store = Store(tmp_path)

    def build(building: Building) -> None:
        (building.out / "data.txt").write_text("x")

    key = store.make("fit", 1, None, {}, build)
    inode = store.path(key).stat().st_ino
    monkeypatch.setattr(Store, "appeared", lambda self, key: False)  # however often it looks
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(LostError, match="was made by somebody else"):
        store._place(out, key)
    assert store.path(key).stat().st_ino == inode
    (store.path(key) / RECEIPT).unlink()
    (out / "new.txt").touch()
    store._place(out, key)
    assert [path.name for path in (tmp_path / "fit" / key.digest).iterdir()] == ["new.txt"]


# --- who cleans up, and who runs


USER = (
    MACHINE
    + """
presence.LEASE_SECONDS = 600
with shop.in_use():
    print("in use", flush=True)
    sys.stdin.readline()
"""
)
CLEANER = (
    MACHINE
    + """
presence.LEASE_SECONDS = 600
with shop.alone() as alone:
    print("alone" if alone else "not alone", flush=True)
    sys.stdin.readline()
"""
)


def test_a_run_on_another_machine_keeps_the_cleaner_away_until_it_ends_or_is_silent(tmp_path):
    with running(tmp_path, "a", program=USER) as user:
        until(user, "in use")
        with running(tmp_path, "b", program=CLEANER) as cleaner:
            assert cleaner.communicate("\n")[0] == "not alone\n"
        user.kill()  # on another machine nobody knows for a while
        user.wait()
        with running(tmp_path, "b", program=CLEANER) as cleaner:
            assert cleaner.communicate("\n")[0] == "not alone\n"
        (left,) = (tmp_path / ".in_use").iterdir()
        os.utime(left, (time.time() - 601,) * 2)
        with running(tmp_path, "b", program=CLEANER) as cleaner:
            assert cleaner.communicate("\n")[0] == "alone\n"
    assert list((tmp_path / ".in_use").iterdir()) == []


def test_a_run_waits_for_who_cleans_up_on_another_machine(tmp_path):
    with running(tmp_path, "a", program=CLEANER) as cleaner:
        until(cleaner, "alone")
        with running(tmp_path, "b", program=USER) as user:
            while not list((tmp_path / ".in_use").glob("run-*")):
                time.sleep(0.05)
            time.sleep(0.5)
            assert user.stdout is not None
            assert not select.select([user.stdout], [], [], 0)[0]
            cleaner.communicate("\n")
            until(user, "in use")


def test_what_another_machine_builds_is_not_taken_away(tmp_path, key, monkeypatch):
    monkeypatch.setattr("fcntl.flock", lambda *_: None)
    with running(tmp_path, "a", pause=0.3) as builder:
        until(builder, "step 1")
        store = Store(tmp_path)
        assert store.withdraw(store.work_folder(key)) is None
        (tmp_path / "fit" / key.digest).mkdir(parents=True)
        assert store.withdraw(tmp_path / "fit" / key.digest) is None
        assert builder.communicate()[0].split("\n")[-2] == "made"
    assert store.withdraw(store.path(key)) is not None
