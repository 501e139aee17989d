"""What a run has fitted so far, while it goes on and after it stopped."""

from __future__ import annotations

import contextlib
import json
import urllib.error
import urllib.request
from threading import Thread

import numpy as np
import pytest

from packuv.fit.frames import Track
from packuv.fit.keyframe import KeyState
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.codes import OPACITY, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.viewer import ViewerServer
from pipelines.commands.preview import Growth, view_run
from pipelines.events import Journal
from pipelines.register import bury, find_runs, registered
from pipelines.unfinished import Unfinished, find_parts
from sync.align import AlignOptions, align
from sync.timecode import Timecodes
from tasks.artefacts.recipe import plain, write_json
from tasks.artefacts.store import SCRATCH, Store
from tasks.stages.fitting import SEGMENT
from tasks.stages.footage import RIG, Take
from tests.support.calibration_scene import ring

COLUMNS = attribute_count(0)
QUANTIZER = Quantizer(np.zeros(3), 1.0, np.ones(3), np.full(COLUMNS, -1.0), np.full(COLUMNS, 1.0))
ROWS, SPARE = 40, 5


def state(instant):
    """A keyframe, or the backdrop."""
    rng = np.random.default_rng(0 if instant is None else 1 + instant)
    codes = Codes(rng.integers(0, 65536, (ROWS, 3), np.uint16), rng.integers(1, 256, (ROWS, COLUMNS), np.uint8))
    return KeyState(instant, QUANTIZER.decode(codes), 0, QUANTIZER, Bounds(np.zeros(3), 3.0, 0.1), {})


def segment(instant, frames):
    key = QUANTIZER.encode(state(instant).gaussians)
    moved = np.arange(ROWS) < 10
    xyz = np.stack([key.xyz[moved] + np.uint16(time) for time in range(1, frames)])
    return Segment(instant, key, moved, xyz, np.repeat(key.attributes[None, moved], frames - 1, axis=0))


class Fitting:
    """A run on record that makes artefacts."""

    def __init__(self, folder, journal):
        self.folder, self.store, self.journal = folder, Store(folder / "store"), journal
        rig = ring(3)
        stamps = Timecodes(np.arange(12, dtype=np.int64) * 10**8, np.arange(12))
        groups, report = align(dict.fromkeys(rig.names, stamps), AlignOptions())

        def synchronized(out):
            groups.save(out, report)
            (out / "videos.json").write_text('{"rate": "10/1"}')

        names = rig.names[:-1]
        points = self.make("points", {}, lambda out: rig.save(out / RIG))
        self.take = Take(groups=self.make("sync", {}, synchronized), rig=points, cameras=names)

    def make(self, stage, options, fill):
        inputs = {"take": self.take} if stage in ("backdrop", "key") else {}
        key = self.store.make(stage, 1, options, inputs, lambda building: fill(building.out))
        self.journal.finished(stage, key, 1.0)
        return key

    def backdrop(self):
        self.make("backdrop", {}, state(None).save)

    def key(self, instant):
        self.make("key", {"instant": instant}, state(instant).save)

    def segment(self, instant, frames):
        part = segment(instant, frames)
        self.make("segment", {"instant": instant}, lambda out: part.save(out / SEGMENT))

    def begin_segment(self, instant, frames):
        """As a fit leaves it after so many frames, the keyframe counted."""
        scratch = self.store.root / ".work" / f"segment-{instant:064x}" / "somebody" / SCRATCH
        scratch.mkdir(parents=True)
        track = Track.resume(state(instant), SPARE, scratch)
        for time in range(1, frames):
            rows = np.zeros(ROWS + SPARE, bool)
            rows[time] = True
            track.model.gaussians.means[time] *= 0.5
            track.add((rows, {"instant": instant + time}))
            track.checkpoint()
        return track.segment(instant)


@pytest.fixture
def fitting(tmp_path):
    journal, facts = Journal(), {"sequence": "dance", "capture": "/data/dance", "preset": "draft"}
    folder = tmp_path / "dance"
    with registered(folder, **facts) as register, journal.heard_by(register):
        yield Fitting(folder, journal)


def told(folder):
    return [(part.first, part.frames, part.under_way) for part in find_parts(folder)]


def test_a_fit_is_seen_to_grow(fitting):
    assert told(fitting.folder) == []
    fitting.backdrop()
    assert told(fitting.folder) == [(0, 1, False)]
    fitting.key(6)
    assert told(fitting.folder) == [(6, 1, False)]
    fitting.key(0)
    fitting.begin_segment(0, 3)
    assert told(fitting.folder) == [(0, 3, True), (6, 1, False)]
    fitting.segment(0, 6)
    assert told(fitting.folder) == [(0, 6, False), (6, 1, False)]


def test_frames_are_those_that_were_fitted(fitting):
    fitting.key(0)
    fitting.key(6)
    fitting.segment(0, 4)
    begun = fitting.begin_segment(6, 3)
    shown = Unfinished(fitting.folder, None, find_parts(fitting.folder))
    assert shown.segments == (range(0, 4), range(4, 7))
    assert [camera.name for camera in shown.cameras if camera.name in shown.held_out] == [ring(3).names[-1]]
    for number, part in enumerate((segment(0, 4), begun)):
        assert np.array_equal(shown.dynamic(number), part.dynamic)
        for offset, frame in enumerate(shown.segments[number]):
            codes, fitted = shown.moving(frame), part.frame(offset)[part.dynamic]
            assert np.array_equal(codes.xyz, fitted.xyz)
            assert np.array_equal(codes.attributes, fitted.attributes)
    assert "7 frames of 2 segments, 1 of them whole" in shown.told


def test_rows_that_wait_for_their_birth_are_not_shown(fitting):
    fitting.key(0)
    fitting.begin_segment(0, 2)
    shown = Unfinished(fitting.folder, None, find_parts(fitting.folder))
    assert len(shown.key(0)) == ROWS
    assert (shown.key(0).attributes[:, OPACITY] > 0).all()


def test_what_a_stopped_run_left_is_shown(tmp_path):
    folder, journal = tmp_path / "dance", Journal()
    fitting = Fitting(folder, journal)
    fitting.key(0)
    names = [str(event.key) for event in journal.events]
    write_json(folder / "run.json", {"stages": [{"artefact": name} for name in names]})
    assert told(folder) == [(0, 1, False)]


def test_what_a_killed_run_left_is_shown_before_and_after_it_is_buried(tmp_path):
    journal, folder = Journal(), tmp_path / "dance"
    facts = {"sequence": "dance", "capture": "/data/dance", "preset": "draft"}
    with registered(folder, **facts) as register, journal.heard_by(register):
        Fitting(folder, journal).key(0)
        (found,) = find_runs(folder)
    write_json(found.path, plain(found.record))
    assert told(folder) == [(0, 1, False)]
    bury(folder, lambda place: None)
    assert find_runs(folder) == []
    assert told(folder) == [(0, 1, False)]


def test_a_port_that_is_none_is_refused_before_anything_is_waited_for(fitting):
    with pytest.raises(ValueError, match="a port is a number"):
        view_run(fitting.folder, None, "127.0.0.1", 99999)


def test_where_nothing_is_fitted_and_nobody_is_at_it_the_cure_is_said(tmp_path):
    (tmp_path / "dance").mkdir()
    with pytest.raises(FileNotFoundError, match="nothing that is fitted"):
        view_run(tmp_path / "dance", None, "127.0.0.1", 0)


def test_a_page_learns_of_more_and_its_old_numbers_are_over(fitting):
    fitting.key(0)
    growth = Growth(fitting.folder, None)
    first = growth.look()
    assert growth.look() is None

    def grown():
        now = growth.look()
        return (now, None) if now else None

    with ViewerServer(("127.0.0.1", 0), first, grown=grown) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        with contextlib.ExitStack() as stack:
            stack.callback(server.shutdown)
            made, frames = scene(server)
            assert frames == 1
            assert status(server, f"layers/0.bin?made={made}") == 200
            fitting.segment(0, 5)
            assert scene(server) == (made + 1, 5)
            assert status(server, f"layers/0.bin?made={made}") == 410
            assert status(server, f"frames/4.bin?made={made + 1}") == 200


def scene(server):
    """State and number of frames."""
    with urllib.request.urlopen(server.url + "scene.json") as answer:
        told = json.loads(answer.read())
    return told["made"], sum(part["length"] for part in told["segments"])


def status(server, path):
    try:
        with urllib.request.urlopen(server.url + path) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code
