"""Runs on record: who is alive, who was killed, and what is left when a run ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from pipelines import register as register_module
from pipelines.events import Journal
from pipelines.register import RUNNING, Place, bury, find_runs, registered
from tasks.artefacts.presence import LEASE_SECONDS
from tasks.artefacts.recipe import plain, write_json

HOLDS = """
import sys, time
from pathlib import Path
from pipelines.events import Journal
from pipelines.register import Place, registered
journal = Journal()
facts = dict(sequence="dance", capture="/data/dance", preset="draft")
engine = Place("http://127.0.0.1:1/api", "some-uuid")
with registered(Path(sys.argv[1]), engine=engine, **facts) as register, journal.heard_by(register):
    journal.started("fit keyframe 0")
    print("ready", flush=True)
    time.sleep(60)
"""


def test_a_run_is_on_record_while_it_lives_and_leaves_nothing(tmp_path):
    journal = Journal()
    with registered(tmp_path, sequence="dance", capture="/data/dance", preset="draft") as register:
        with journal.heard_by(register):
            journal.started("motion")
            journal.moved("motion", 3, 12, "cam03")
            journal.skipped("COLMAP", "there is a calibration")
            (found,) = find_runs(tmp_path)
        assert found.alive
        assert (found.record.sequence, found.record.pid) == ("dance", os.getpid())
        (stage,) = found.record.stages
        assert (stage.label, found.record.ended) == ("motion", 1)
        with registered(tmp_path, sequence="dance", capture="/data/dance", preset="draft"):
            assert [run.alive for run in find_runs(tmp_path)] == [True, True]
    assert find_runs(tmp_path) == []
    assert list((tmp_path / RUNNING).iterdir()) == []


def test_a_killed_run_is_found_dead_and_closed_once(tmp_path):
    earlier = {"sequence": "dance", "started": "2026-01-01T00:00:00+00:00", "artefacts": [{"artefact": "sync/00"}]}
    write_json(tmp_path / "run.json", earlier)
    with subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        assert [run.alive for run in find_runs(tmp_path)] == [True]
        told: list[Place] = []
        bury(tmp_path, told.append)
        assert told == []
        process.send_signal(signal.SIGKILL)
    (found,) = find_runs(tmp_path)
    assert not found.alive
    for _ in range(2):
        bury(tmp_path, told.append)
    assert [place.flow_run for place in told] == ["some-uuid"]
    record = json.loads((tmp_path / "run.json").read_text())
    assert (record["outcome"], record["reason"]) == ("killed", "killed at fit keyframe 0")
    assert record["artefacts"] == earlier["artefacts"]
    assert find_runs(tmp_path) == []


def test_a_killed_run_does_not_hide_a_later_one(tmp_path):
    later = {"sequence": "dance", "started": "2999-01-01T00:00:00+00:00", "outcome": "finished"}
    with registered(tmp_path, sequence="dance", capture="/data/dance", preset="draft"):
        (found,) = find_runs(tmp_path)
        record, path = found.record, found.path
    write_json(tmp_path / "run.json", later)
    path.write_text(json.dumps(plain(record)))
    bury(tmp_path, lambda place: None)
    assert json.loads((tmp_path / "run.json").read_text()) == later


@pytest.mark.parametrize(("silence", "alive"), [(0, True), (LEASE_SECONDS + 5, False)])
def test_a_run_on_another_machine_counts_as_killed_after_a_silence(tmp_path, silence, alive):
    with registered(tmp_path, sequence="dance", capture="/data/dance", preset="draft"):
        (found,) = find_runs(tmp_path)
    # The number is that of a process here, which means nothing: it is another machine's.
    elsewhere = replace(found.record, host="elsewhere", process=f"elsewhere-0123456789ab-{os.getpid()}-1-00000000")
    found.path.write_text(json.dumps(plain(elsewhere)))
    lock = found.path.with_suffix(".lock")
    lock.touch()
    os.utime(lock, (time.time() - silence,) * 2)
    (found,) = find_runs(tmp_path)
    assert (found.alive, found.record.here) == (alive, False)


def test_a_run_is_seen_where_locks_are_not(tmp_path, monkeypatch):
    monkeypatch.setattr("fcntl.flock", lambda *_: None)
    with registered(tmp_path, sequence="dance", capture="/data/dance", preset="draft"):
        (found,) = find_runs(tmp_path)
        assert found.alive
        assert found.record.here


def test_a_record_cut_short_is_passed_over(tmp_path):
    (tmp_path / RUNNING).mkdir()
    (tmp_path / RUNNING / "1.json").write_text('{"sequence": "da')
    assert find_runs(tmp_path) == []


def test_a_run_that_says_nothing_for_long_is_still_noted(tmp_path, monkeypatch):
    monkeypatch.setattr(register_module, "HEARTBEAT_SECONDS", 0.02)
    with registered(tmp_path, sequence="dance", capture="/data/dance", preset="draft"):
        (path,) = (tmp_path / RUNNING).glob("*.json")
        first, deadline = path.stat().st_mtime_ns, time.monotonic() + 10
        while path.stat().st_mtime_ns == first:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert not path.exists(), "nor does it write when the run is over"
