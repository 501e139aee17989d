"""What goes from stores and what stays, whoever uses them meanwhile."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from tasks.artefacts.retention import DAY_SECONDS, REMAKEABLE, Cleaning, Policy, State, Why, clean_folder
from tasks.artefacts.store import RECEIPT, Building, Key, Store, try_lock

BYTES = 1000
RESULTS = ("sync", "rig", "points", "keyframes", "encode", "verify", "evaluate")


def make(store: Store, stage: str, version: int = 1, *, inputs: Any = ()) -> Key:
    def build(building: Building) -> None:
        (building.out / "data").write_bytes(bytes(BYTES))

    return store.make(stage, version, None, {"inputs": list(inputs)}, build)


def age(path: Path, days: float) -> None:
    then = time.time() - days * DAY_SECONDS
    for file in [path, *path.rglob("*")]:
        os.utime(file, (then, then))


def write_run(store: Store, keys: Iterable[Key], *, failed: bool = False, days_ago: float = 0) -> None:
    """run.json as a run leaves it: stages name more artefacts than the list of those that count."""
    names = [str(key) for key in keys]
    stages = [{"stage": name, "outcome": "made", "artefact": name} for name in names]
    stages += [{"stage": "fit 0-2", "outcome": "failed", "reason": "?"}] if failed else []
    run = store.root.parent / "run.json"
    run.write_text(json.dumps({"stages": stages, "artefacts": [{"artefact": name} for name in names[1:]]}))
    age(run, days_ago)


def finished(folder: Path, name: str = "dance", *, days_ago: float = 0) -> tuple[Store, list[Key]]:
    """A sequence whose last run came to its end, with what an earlier run left."""
    store = Store(folder / name / "store")
    old = [make(store, stage, 0) for stage in ("motion", "encode")]
    keys = [make(store, stage) for stage in (*RESULTS, *REMAKEABLE)]
    for key in [*old, *keys]:
        age(store.path(key), days_ago)
    write_run(store, keys, days_ago=days_ago)
    os.link(store.path(keys[RESULTS.index("encode")]) / "data", store.root.parent / "scene.mkv")
    return store, keys


def stages(store: Store) -> set[str]:
    return {folder.parent.name for folder in store.root.glob("[!.]*/*/")}


def gone(cleaning: Cleaning) -> dict[str, Why]:
    return {item.name.split("/")[0]: item.why for item in cleaning.gone if item.why}


def test_what_the_last_run_did_not_use_goes_and_nothing_else(tmp_path):
    store, keys = finished(tmp_path)
    told = clean_folder(tmp_path, Policy(), dry_run=True)
    assert len(list(store.keys())) == len(keys) + 2
    done = clean_folder(tmp_path, Policy())
    assert done == told
    assert gone(done) == {"motion": Why.SUPERSEDED, "encode": Why.SUPERSEDED}
    assert set(store.keys()) == set(keys)
    assert store.verify() == []
    assert 2 * BYTES < done.freed_bytes < 4 * BYTES  # data and receipts
    assert not list((store.root / ".work").glob("*/"))
    assert clean_folder(tmp_path, Policy()).gone == []
    assert clean_folder(store.root, Policy()).sequences == clean_folder(store.root.parent, Policy()).sequences


def test_what_a_run_made_that_did_not_end_stays(tmp_path):
    """It was killed hours after the last one that ended, so `run.json` does not know it."""
    store, keys = finished(tmp_path, days_ago=1)
    later = make(store, "segment", 2)
    again = make(store, "motion", 0)
    assert again.reused
    work = store.root / ".work" / f"segment-{'0' * 64}"
    (work / "scratch").mkdir(parents=True)
    (work / "scratch" / "checkpoint").write_text("frame 7")
    clean_folder(tmp_path, Policy(quota_bytes=0))
    assert {later, again} < set(store.keys())
    assert (work / "scratch" / "checkpoint").exists()
    write_run(store, keys)
    assert gone(clean_folder(tmp_path, Policy())).keys() == {"segment", "motion", work.name}
    assert not work.exists()


@pytest.mark.parametrize("harm", ["failed", "stopped early", "absent", "no JSON"])
def test_nothing_is_superseded_where_the_last_run_does_not_tell(tmp_path, harm):
    store, keys = finished(tmp_path)
    match harm:
        case "failed":
            write_run(store, keys, failed=True)
        case "stopped early":
            write_run(store, keys[:3])
        case "absent":
            (tmp_path / "dance/run.json").unlink()
        case "no JSON":
            (tmp_path / "dance/run.json").write_text('{"half')
    done = clean_folder(tmp_path, Policy(quota_bytes=0))
    assert (done.gone, done.sequences[0].state) == ([], State.UNFINISHED)


def test_days_count_from_the_last_use(tmp_path):
    store, _ = finished(tmp_path, days_ago=10)
    left = store.root / ".work" / f"motion-{'1' * 64}"
    left.mkdir(parents=True)
    age(left, 10)
    (tmp_path / "dance/run.json").unlink()  # age alone tells that an unfinished build is not gone on with
    assert gone(clean_folder(tmp_path, Policy(keep_days=11))) == {}
    assert gone(clean_folder(tmp_path, Policy(keep_days=9))) == {left.name: Why.LEFT_OVER}

    store, keys = finished(tmp_path, "hall", days_ago=10)
    assert make(store, "encode", 0).reused
    write_run(store, keys)
    assert gone(clean_folder(tmp_path, Policy(keep_days=11))) == {}
    assert gone(clean_folder(tmp_path, Policy(keep_days=9))) == {"motion": Why.SUPERSEDED}
    assert gone(clean_folder(tmp_path, Policy())) == {"encode": Why.SUPERSEDED}


def test_a_quota_takes_intermediates_stage_by_stage_the_oldest_first_and_results_never(tmp_path):
    old, _ = finished(tmp_path, "a", days_ago=3)
    new, _ = finished(tmp_path, "b", days_ago=2)
    unfinished, _ = finished(tmp_path, "c", days_ago=9)
    (tmp_path / "c/run.json").unlink()
    held = clean_folder(tmp_path, Policy()).kept_bytes
    order = []
    while True:
        done = clean_folder(tmp_path, Policy(quota_bytes=held - 1))
        if not done.gone:
            break
        (item,) = done.gone
        order.append((item.folder.parts[-4], item.stage))
        held = done.kept_bytes
        on_disk = {path.stat().st_ino: path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()}
        assert done.kept_bytes == sum(on_disk.values())
    assert order == [(sequence, stage) for stage in REMAKEABLE for sequence in "ab"]
    for store in (old, new):
        assert stages(store) == set(RESULTS)
        assert store.verify() == []
    assert len(list(unfinished.keys())) == len(RESULTS) + len(REMAKEABLE) + 2


def test_a_quota_takes_nothing_that_frees_nothing(tmp_path):
    """All files have a second name in a snapshot, as `cp -al` makes it."""
    store, keys = finished(tmp_path / "runs")
    clean_folder(tmp_path / "runs", Policy())
    shutil.copytree(tmp_path / "runs", tmp_path / "snapshot", copy_function=os.link)
    clean_folder(tmp_path / "runs", Policy(quota_bytes=0))
    assert set(store.keys()) == set(keys)


def test_what_is_gone_is_made_again(tmp_path):
    store, keys = finished(tmp_path)
    motion = keys[len(RESULTS)]
    segment = make(store, "segment", 3, inputs=[motion])
    write_run(store, [*keys, segment])
    assert store.absent() == set()
    clean_folder(tmp_path, Policy(quota_bytes=clean_folder(tmp_path, Policy()).kept_bytes - 1))
    assert store.absent() == {str(motion)}
    assert make(store, "segment", 3, inputs=[motion]).reused
    again = make(store, "motion")
    assert (again, again.reused) == (motion, False)


def test_a_sequence_that_is_processed_is_left_alone(tmp_path):
    store, keys = finished(tmp_path)
    other, _ = finished(tmp_path, "hall")
    with store.in_use(), store.in_use():
        done = clean_folder(tmp_path, Policy(quota_bytes=0))
    assert [sequence.state for sequence in done.sequences] == [State.BUSY, State.FINISHED]
    assert len(list(store.keys())) == len(keys) + 2
    assert stages(other) == set(RESULTS)


BUILDER = """
import sys
from tasks.artefacts.store import Store

def build(building):
    (building.out / "data").write_text("x")
    print("building", flush=True)
    sys.stdin.readline()

Store(sys.argv[1]).make("motion", 0, None, {"inputs": []}, build)
"""


def test_what_is_being_built_stays_although_nobody_says_that_the_store_is_in_use(tmp_path):
    store, keys = finished(tmp_path, days_ago=1)
    (old,) = [key for key in set(store.keys()) - set(keys) if key.stage == "motion"]
    (store.path(old) / RECEIPT).unlink()
    write_run(store, keys)
    command = [sys.executable, "-c", BUILDER, str(store.root)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as builder:
        assert builder.stdout is not None
        assert builder.stdout.readline() == "building\n"
        age(store.root / ".work" / f"motion-{old.digest}", 1)
        clean_folder(tmp_path, Policy())
        builder.communicate("go\n")
    assert builder.returncode == 0
    assert store.holds(old)


def test_a_reader_sees_an_artefact_whole_or_not_at_all(tmp_path):
    store, keys = finished(tmp_path)
    with open(store.path(keys[0]) / "data", "rb") as opened:
        place = store.withdraw(store.path(keys[0]))
        assert place is not None
        assert not store.holds(keys[0])
        shutil.rmtree(place)
        assert opened.read() == bytes(BYTES)


def test_what_a_killed_cleaning_left_goes_next_time(tmp_path):
    store, keys = finished(tmp_path)
    place = store.withdraw(store.path(keys[-1]))
    (tmp_path / "dance/run.json").unlink()
    (item,) = clean_folder(tmp_path, Policy(keep_days=30)).gone
    assert (item.folder, item.why) == (place, Why.LEFT_OVER)
    assert not item.folder.exists()


def test_databases_of_the_workflow_engine_go_unless_a_run_uses_them(tmp_path):
    finished(tmp_path)
    for number in range(3):
        home = tmp_path / ".prefect" / str(number)
        (home / "storage").mkdir(parents=True)
        (home / "in_use.lock").touch()
        (home / "prefect.db").write_bytes(bytes(BYTES))
    age(tmp_path / ".prefect/2", 5)
    with contextlib.ExitStack() as stack:
        used = stack.enter_context(open(tmp_path / ".prefect/0/in_use.lock", "ab"))
        assert try_lock(used.fileno())
        assert [item.name for item in clean_folder(tmp_path, Policy(keep_days=4)).engine] == [".prefect/2"]
        assert [item.name for item in clean_folder(tmp_path, Policy()).engine] == [".prefect/1"]
    left = {str(path.relative_to(tmp_path / ".prefect")) for path in (tmp_path / ".prefect").rglob("*.*")}
    assert left == {"0/in_use.lock", "0/prefect.db", "1/in_use.lock", "2/in_use.lock"}


def test_a_folder_without_a_store_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no artefact store; name the folder that `packuv run --out`"):
        clean_folder(tmp_path, Policy())
    with pytest.raises(ValueError, match="keep_days must be at least 0, but is -1"):
        Policy(keep_days=-1)
