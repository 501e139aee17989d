"""When a take goes on with the rig of another one, and what it says when it does not."""

from __future__ import annotations

import json
from dataclasses import replace

import av
import numpy as np
import pytest

from calibration.accept import MatchesReport, Verdict
from calibration.features import FeatureOptions
from calibration.judge import SharedJudgement
from calibration.moved import Standing
from calibration.solve import Lens, SolveOptions
from pipelines.events import Journal
from sync.align import AlignOptions
from sync.capture import find_capture
from tasks.artefacts.jobs import Jobs
from tasks.artefacts.originals import Originals
from tasks.artefacts.stage import Files, Site
from tasks.artefacts.store import Key, Store
from tasks.artefacts.workshop import Workshop
from tasks.stages.calibrate import (
    CHECK,
    BorrowRig,
    FindPoints,
    PointOptions,
    RigOptions,
    SolveRig,
    _attempts,
    _KeptPictures,
    _lent,
    _moved,
    find_rig,
    read_names,
    store_of,
)
from tasks.stages.footage import RIG, PictureOptions, Take
from tasks.stages.plan import Plan
from tasks.stages.synchronize import Synchronize
from tests.support.artefacts import build_here, put
from tests.support.calibration_scene import filmed

NAMES = ("cam01", "cam02", "cam03", "cam04")
STAGE = BorrowRig(
    take=Take(groups=Key("sync", "0" * 64), cameras=NAMES),
    first=0,
    lender="take01",
    rig=Files({}),
    options=RigOptions(),
)


def judgement(*, fitting: float, verdict: Verdict = Verdict.ACCEPTED) -> SharedJudgement:
    """cam03 was moved."""
    right = Standing(points=90, fitting=0.93, agreeing=0.95, offset_px=0.4, left_px=0.3, turned_deg=0.1, shifted=0.001)
    moved = replace(right, fitting=fitting, offset_px=6.5)
    report = MatchesReport(5, 900, 0.9, 0.3, {}, (), None, verdict, "the poses explain 3% of the matches")
    return SharedJudgement({name: moved if name == "cam03" else right for name in NAMES}, ("cam03",), report)


def check(found: SharedJudgement) -> None:
    STAGE._check(found, {name: _moved(name, found, "take01") for name in found.moved})


def test_a_camera_that_was_moved_a_little_is_a_finding():
    found = judgement(fitting=0.7)
    check(found)
    text = "has been moved since take01: 70% of its matches fit, others 93%, its picture lies 6.5 px off"
    assert _moved("cam03", found, "take01") == text


def test_a_camera_that_cannot_be_used_ends_the_run_and_says_what_to_do():
    with pytest.raises(ValueError, match=r'cam03 has been moved .*12% of its matches.*ignore = \["cam03"\].*rig_from'):
        check(judgement(fitting=0.12))


def test_a_rig_that_is_wrong_altogether_is_told_from_a_moved_camera():
    with pytest.raises(
        ValueError, match="the rig of take01 does not agree with this take's pictures: the poses explain"
    ):
        check(judgement(fitting=0.7, verdict=Verdict.REJECTED))


def test_a_lent_rig_is_found_by_its_content(tmp_path):
    root = store_of(tmp_path / "take02" / "store", "take01")
    assert root == tmp_path / "take01" / "store"
    site = Site(root, tmp_path, 1)
    keys = [put(site, "rig", lambda out, text=text: (out / RIG).write_text(text), text=text) for text in ("a", "b")]
    store = Store(root)
    for key in keys:
        sha256 = store.receipt(key).outputs[RIG]["sha256"]
        assert _lent(root, Files({RIG: sha256})) == store.path(key) / RIG
    with pytest.raises(FileNotFoundError, match="has lost its rig"):
        _lent(root, Files({RIG: "0" * 64}))


def test_who_trusts_a_rig_that_was_lent_does_not_have_it_solved_again(tmp_path):
    (tmp_path / "videos").mkdir()
    videos = {name: tmp_path / "videos" / f"{name}.mp4" for name in NAMES}
    for video in videos.values():
        video.write_bytes(b"content")
    originals = Originals(find_capture(tmp_path), tmp_path / "file_digests.json")
    workshop = Workshop(Store(tmp_path / "store"), originals, Jobs(threads=1), Journal())
    plan = Plan(tmp_path, videos, (), 0, None, "cpu", side_by_side=False)
    groups, pictures = STAGE.take.groups, PictureOptions()
    stages = [find_rig(workshop, plan, groups, pictures, RigOptions(trust=trust)) for trust in (False, True)]
    assert stages[0] == stages[1]


def test_pictures_kept_for_cameras_that_are_not_fitted_come_back(tmp_path):
    rng, kept = np.random.default_rng(0), _KeptPictures(tmp_path, NAMES)
    instants = [{name: rng.integers(0, 256, (4, 6, 3), np.uint8) for name in names} for names in (NAMES, NAMES[1:])]
    for instant in instants:
        kept.add(instant)
    for instant, loaded in zip(instants, kept.load(), strict=True):
        assert list(loaded) == list(instant)
        assert all(np.array_equal(loaded[name], instant[name]) for name in instant)


def test_colours_that_gain_nothing_are_said(tmp_path):
    stage = FindPoints(take=STAGE.take, fitted=NAMES, options=PointOptions())
    notes = {
        "points": 9,
        "balanced": True,
        "shaded": False,
        "shading": "shading does not pay",
        "unlike": {"cam02": "few"},
    }
    assert list(stage.spared(tmp_path, notes)) == [("lens shading", "shading does not pay"), ("colour of cam02", "few")]
    plain = {**notes, "balanced": False, "reason": "no need", "unlike": {}}
    assert list(stage.spared(tmp_path, plain)) == [("colour balance", "no need")]


def test_a_solve_starts_from_several_instants_where_lenses_are_known_and_from_the_first_where_not():
    instants = np.array([3, 4, 7, 8, 9, 12])
    several = [3, 7, 8, 12]
    assert _attempts(instants, 4, several_first=True) == [several, [3]]
    assert _attempts(instants, 4, several_first=False) == [[3], several]
    for few, more in ((instants[:1], 4), (instants, 1)):
        assert _attempts(few, more, several_first=True) == _attempts(few, more, several_first=False) == [[3]]


@pytest.mark.slow
def test_a_solve_goes_on_without_a_camera_where_that_is_allowed(tmp_path):
    """Six cameras in a textured room, and one before whose lens the cap is."""
    _, _, pictures = filmed(6)
    pictures["capped"] = np.full_like(next(iter(pictures.values())), 20)
    videos = tmp_path / "capture" / "videos"
    videos.mkdir(parents=True)
    for name, picture in pictures.items():
        with av.open(str(videos / f"{name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], "bgr0"
            for _ in range(2):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
    site = Site(tmp_path / "store", tmp_path / "capture", 1)
    files = Files(dict.fromkeys(find_capture(site.capture).videos, "content"))
    sync = Synchronize(videos=files, timecodes=Files({}), fps=None, timecode_column=None, options=AlignOptions())
    _, made = build_here(sync, site, tmp_path / "sync")
    groups = put(site, "sync", lambda out: [path.rename(out / path.name) for path in made.iterdir()])
    solve = SolveOptions(features=FeatureOptions(max_features=800), lens=Lens.PINHOLE, shared_lens=True)
    stage = SolveRig(
        take=Take(groups=groups, cameras=tuple(find_capture(site.capture).videos)),
        first=0,
        options=RigOptions(solve=replace(solve, min_registered=0.8)),
    )
    _, out = build_here(stage, site, tmp_path / "solve")
    assert set(read_names(out)) == pictures.keys() - {"capped"}
    assert json.loads((out / CHECK).read_text())["suspicious"]["capped"].startswith("could not be placed")

    plan = Plan(site.capture, find_capture(site.capture).videos, ("capped", "cam0"), 0, None, "cpu", True)
    left = plan.only(read_names(out))
    assert (left.held_out, len(left.fitted)) == (("cam0",), 5)

    with pytest.raises(ValueError, match=r'to go on without, write ignore = \["capped"\] into capture.toml'):
        build_here(replace(stage, options=RigOptions(solve=replace(solve, min_registered=1.0))), site, tmp_path / "all")
