"""The report: every section is there, with data and without; what is bad is said; nothing is loaded from elsewhere."""

from __future__ import annotations

import base64
import json
import math
import re
from dataclasses import replace
from fractions import Fraction
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from calibration.accept import check_rig
from calibration.rig import Camera, Rig
from sync.align import CameraReport, SyncReport
from sync.clock import Clock, ClockMode, ClockState
from tasks.artefacts.recipe import restore
from tasks.report.facts import MAX_PSNR_DB, CameraEvidence, LastingChange, mean_by_frame
from tasks.report.findings import Severity
from tasks.report.limits import LIMITS
from tasks.report.page import SECTIONS, duration, page_text
from tasks.report.plots import (
    MOST_BARS,
    MOST_POINTS,
    Series,
    Volume,
    bar_chart,
    line_chart,
    rig_axes,
    rig_model,
    rig_views,
    thinned,
)
from tasks.report.record import report_json
from tasks.report.sections import VIEWER
from tasks.report.summary import summary
from tasks.report.verdict import Fitness, verdict
from tasks.report.write import (
    Comparison,
    Finding,
    FrameScore,
    LightCurve,
    MotionCurve,
    ReportInput,
    SceneFigures,
    StageOutcome,
    StageRecord,
    findings,
    frames_to_picture,
    scene_figures,
    write_report,
)

FRAMES = 12
HELD_OUT = ("cam1", "cam4")


def make_rig(count: int = 6) -> Rig:
    """A ring about the origin that looks inwards; z is up."""
    cameras = []
    for index, angle in enumerate(np.arange(count) * 2 * np.pi / count):
        eye = 3 * np.array([np.cos(angle), np.sin(angle), 0.1])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = [right, np.cross(forward, right), forward]
        pose[:3, 3] = -pose[:3, :3] @ eye
        gains = (1.0 + 0.02 * index, 1.0, 1.0)
        cameras.append(Camera(f"cam{index}", 320, 240, 260.0, 260.0, 160.0, 120.0, pose, gains=gains))
    return Rig(tuple(cameras), "a ring", metric=True)


def make_sync(**changes: object) -> SyncReport:
    clock = Clock(ClockState.TRUSTED, 0, 1_200_000.0, 9_000.0, 12.0, 1.0, 40_000.0)
    row = CameraReport(
        "cam0", FRAMES, 0, 0, 0, 0, 0, FRAMES * 33_000_000, 33_333_333, FRAMES, 1.0, clock, 9e5, 2e6, (0, 1, 9, 2, 0)
    )
    rows = [replace(row, camera=f"cam{index}") for index in range(6)]
    rows[3] = replace(rows[3], **changes)
    return SyncReport("cam0", False, 33_333_333, 16_666_666, True, ClockMode.TRUSTED, FRAMES, FRAMES - 1, tuple(rows))


def make_scores(level_db: float = 26.0) -> tuple[FrameScore, ...]:
    return tuple(
        FrameScore(camera, frame, level_db - 0.1 * frame - index, 0.9 - 0.01 * frame)
        for index, camera in enumerate(HELD_OUT)
        for frame in range(FRAMES)
    )


def make_scene() -> SceneFigures:
    sizes = tuple(900_000 if frame in (0, 7) else 50_000 for frame in range(FRAMES))
    return SceneFigures("scene.mkv", sum(sizes) + 12_345, Fraction(30), sizes, (5000,) * 12, (800,) * 12, True)


def make_light(factor: float = 1.05) -> LightCurve:
    """Light that falls by 4 %, and a camera whose exposure rises by a factor at frame 5."""
    level = np.where(np.arange(FRAMES) < 5, 0, np.log(factor))[:, None] * np.ones(3)
    return LightCurve(np.linspace(0.02, -0.02, FRAMES)[:, None] * np.ones(3), {"cam2": level - level.mean(axis=0)})


def make_report() -> ReportInput:
    rng = np.random.default_rng(2)
    truth = rng.integers(0, 256, (90, 160, 3), dtype=np.uint8)
    rig = make_rig()
    return ReportInput(
        "ring <test>",
        command="packuv run 'a b' --out runs",
        options={"fit": {"iterations": 10, "share": 0.5}},
        versions={"packuv": "0.1.0"},
        host="a laptop",
        finished="2026-11-22T12:00:00Z",
        seconds=75.0,
        sync=make_sync(),
        rig=rig,
        held_out=HELD_OUT,
        check=check_rig(rig),
        evidence={"cam0": CameraEvidence(210, 0.21, "measured with the others"), "cam1": CameraEvidence(gain="not")},
        light=make_light(),
        motion=MotionCurve(np.linspace(0, 2, FRAMES), (0, 7), (LastingChange(7, ("cam0", "cam2")),)),
        scores=make_scores(),
        scene=make_scene(),
        pictures=(Comparison("cam1", 3, truth, truth, "first"),),
        stages=(
            StageRecord("sync", StageOutcome.MADE, 1.5, 200_000_000),
            StageRecord("encode", StageOutcome.REUSED, 0.1),
            StageRecord("COLMAP", StageOutcome.SKIPPED, 0.0, reason="a calibration is given & valid"),
        ),
    )


class Page(HTMLParser):
    """Checks that tags close in order; keeps ids, addresses and words."""

    EMPTY = frozenset({"meta", "img", "link", "br", "line", "path", "rect", "circle"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.words = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        assert len(values) == len(attrs), f"an attribute twice in <{tag}>"
        self.ids += [str(values["id"])] if "id" in values else []
        self.addresses += [str(values[name]) for name in ("src", "href", "data", "action") if name in values]
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.EMPTY:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.EMPTY or self.open[-1:] == [tag]:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data if "style" not in self.open and "script" not in self.open else ""


def section(text: str, name: str) -> str:
    found = re.search(rf'<section id="{name}">(.*?)</section>', text, re.DOTALL)
    assert found
    return found[1]


# ---- the page


def test_the_page_has_every_section_and_stands_alone() -> None:
    text = page_text(make_report())
    page = Page(text)
    assert set(SECTIONS) | {"summary"} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    inside = ("#", "data:image/jpeg;base64,", f"{VIEWER}/#frame=")  # a link that a person may follow
    assert all(address.startswith(inside) for address in page.addresses)
    assert {address[1:] for address in page.addresses if address.startswith("#")} <= set(page.ids)
    told = text.replace(f'href="{VIEWER}/', "").replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"url\(|@import|https?:|<link|<iframe", told)
    for name in SECTIONS:
        assert 'class="none"' not in section(text, name), name


@pytest.mark.parametrize(
    "missing", ["sync", "rig", "check", "light", "motion", "scores", "scene", "pictures", "stages", "all"]
)
def test_a_missing_part_says_so_and_spoils_nothing(missing: str, tmp_path: Path) -> None:
    nothing = {name: None for name in ("sync", "rig", "check", "light", "motion", "scene")}
    nothing |= {name: () for name in ("scores", "pictures", "stages")}
    report = make_report()
    report = ReportInput("empty") if missing == "all" else replace(report, **{missing: nothing[missing]})
    files = write_report(report, tmp_path / "new")
    text = files.page.read_text()
    Page(text)
    told = {name for name in SECTIONS if 'class="none"' in section(text, name)}
    expected = {
        "sync": {"sync"},
        "rig": {"rig", "colour"},
        "check": set(),
        "light": {"light"},
        "motion": {"motion"},
        "scores": {"quality"},
        "scene": {"size", "gaussians"},
        "pictures": {"pictures"},
        "stages": {"stages", "skipped"},
        "all": set(SECTIONS),
    }
    assert told == expected[missing]
    assert json.loads(files.json.read_text())["name"] == report.name


def test_text_is_escaped() -> None:
    report = make_report()
    text = page_text(replace(report, command="<script>alert(1)</script>", host='"><img src=x>'))
    assert "<script>alert" not in text
    assert "<img src=x" not in text
    assert "ring &lt;test&gt;" in text


def test_names_and_reasons_stay_text_wherever_they_come_up() -> None:
    """A camera's name alone is in tables, plots, tooltips, captions and findings."""
    bad = "<script>alert('1') & \"2\"</script>"
    report, sync, rig = make_report(), make_sync(), make_rig()
    cameras = (replace(rig.cameras[0], name=bad, gains=(2.0, 1.0, 1.0)), *rig.cameras[1:])
    rows = (replace(sync.cameras[0], camera=bad, drops=9), *sync.cameras[1:])
    ugly = replace(
        report,
        name=bad,
        command=bad,
        options={"text": bad},
        versions={bad: bad},
        host=bad,
        finished=bad,
        sync=replace(sync, reference=bad, cameras=rows),
        rig=Rig(cameras, bad),
        held_out=(bad,),
        light=replace(make_light(), exposures={bad: make_light(2.0).exposures["cam2"]}, reason=bad),
        scores=tuple(replace(score, camera=bad) for score in report.scores[:FRAMES]),
        scene=replace(make_scene(), name=bad, verified=False, problem=bad),
        motion=replace(report.motion, changes=(LastingChange(7, (bad,)),)),
        pictures=tuple(replace(item, camera=bad, choice=bad) for item in report.pictures),
        stages=tuple(
            StageRecord(bad, outcome, 1.0, reason=bad) for outcome in (StageOutcome.FAILED, StageOutcome.SKIPPED)
        ),
    )
    text = page_text(ugly)
    assert text.count("<script") == page_text(report).count("<script") == 1
    assert "&amp;lt;" not in text  # escaped once
    words = Page(text).words
    for name in ("sync", "rig", "colour", "light", "motion", "quality", "pictures", "size", "stages", "skipped", "run"):
        assert bad.replace(" ", "") in Page(section(text, name)).words.replace(" ", ""), name
    assert words.count(bad) > 20


def test_the_summary_row_shows_the_figures() -> None:
    words = Page(page_text(make_report())).words
    scores = make_scores()
    assert f"{np.mean([score.psnr_db for score in scores]):.2f} dB" in words
    assert "1 min 15 s" in words
    assert "cameras, 2 held out" in words
    assert f"{(900_000 * 2 + 50_000 * 10 + 12_345) / 1e6 * 30 / 12:.2f} MB" in words


def test_lasting_changes_are_listed_and_a_cut_is_a_finding() -> None:
    report = make_report()
    assert "frame 7: cam0, cam2" in Page(page_text(report)).words
    assert report_json(report)["motion"]["changes"] == [{"frame": 7, "cameras": ["cam0", "cam2"]}]
    assert report.motion is not None
    cut = replace(report, motion=replace(report.motion, cuts=(5,)))
    assert any(item.section == "motion" and "frame 5" in item.text for item in findings(cut))
    assert not any(item.section == "motion" for item in findings(report))


# ---- report.json


def test_json_holds_the_numbers(tmp_path: Path) -> None:
    report = make_report()
    data = json.loads(write_report(report, tmp_path).json.read_text())
    assert SyncReport.from_json(data["sync"]) == report.sync
    assert [FrameScore(**score) for score in data["scores"]] == list(report.scores)
    assert data["cameras"][4]["held_out"] is True
    assert np.allclose(data["cameras"][0]["centre"], make_rig().cameras[0].centre)
    assert np.allclose(np.log(data["light"]["factors"]), make_light().light, atol=1e-5)
    assert data["light"]["exposures"].keys() == {"cam2"}
    assert data["motion"] == {
        "magnitude_px": np.linspace(0, 2, FRAMES).tolist(),
        "keyframes": [0, 7],
        "changes": [{"frame": 7, "cameras": ["cam0", "cam2"]}],
        "cuts": [],
    }
    assert data["scene"]["frame_bytes"] == list(make_scene().frame_bytes)
    assert data["summary"]["verified"] is True
    assert restore(tuple[Finding, ...], data["findings"]) == findings(report)
    assert data["verdict"]["fitness"] == "fit for delivery"


def test_equal_pictures_stay_finite(tmp_path: Path) -> None:
    report = replace(make_report(), scores=(FrameScore("cam1", 0, math.inf, 1.0),))
    files = write_report(report, tmp_path)
    assert json.loads(files.json.read_text())["scores"][0]["psnr_db"] == MAX_PSNR_DB
    assert "inf" not in Page(files.page.read_text()).words.split()


def test_a_report_replaces_the_one_before(tmp_path: Path) -> None:
    write_report(make_report(), tmp_path)
    write_report(ReportInput("second"), tmp_path)
    assert "second" in (tmp_path / "report.html").read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "report.json"]


# ---- findings


def texts(report: ReportInput) -> list[str]:
    return [f"{item.section}: {item.text}" for item in findings(report)]


def test_a_good_run_has_nothing_to_say() -> None:
    assert texts(make_report()) == []
    assert "No figure crosses its limit." in page_text(make_report())


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"matched_share": 0.71, "matched": 8}, "sync: cam3 has a frame at only 71% of the instants."),
        ({"drops": 4}, "sync: cam3 dropped 4 of 16 frames."),
        ({"residual_p95_ns": 12e6}, "sync: cam3: one frame in twenty is 0.36 frame periods or more off."),
        ({"duplicates": 2}, "sync: cam3: 2 duplicate timecodes."),
    ],
)
def test_a_bad_camera_is_named(change: dict[str, float], expected: str) -> None:
    report = replace(make_report(), sync=make_sync(**change))
    assert expected in texts(report)
    assert expected.partition(": ")[2] in Page(page_text(report)).words


def test_bad_colours_scores_files_and_stages_are_named() -> None:
    report = make_report()
    cameras = list(report.rig.cameras) if report.rig else []
    cameras[2] = replace(cameras[2], gains=(1.0, 0.5, 1.0))
    scores = tuple(
        replace(s, psnr_db=s.psnr_db - 14 * (s.camera == "cam1") - 8 * (s.frame == 9)) for s in report.scores
    )
    scene = replace(make_scene(), verified=False, problem="frame 3 differs", dynamic=(4000,) * 12)
    failed = StageRecord("encode", StageOutcome.FAILED, 2.0, reason="the disk is full")
    bad = replace(
        report, rig=Rig(tuple(cameras), "a ring"), scores=scores, scene=scene, stages=(*report.stages, failed)
    )
    assert texts(bad) == [
        "stages: The stage 'encode' failed: the disk is full.",
        "quality: The mean of 17.3 dB is below the limit of 20 dB: the difference shows at a glance.",
        "size: The scene file does not decode to what was fitted: frame 3 differs.",
        "quality: cam1 scores 10.8 dB, 6.5 dB below the median camera.",
        "quality: 1 of 12 frames score 3 dB or more below the median frame, the worst being frame 9 with 9.6 dB.",
        "gaussians: 80% of the Gaussians are dynamic: noise may pass for motion.",
        "colour: cam2 needs a colour gain of 0.50.",
    ]


def judged(report: ReportInput, **limits: float) -> tuple[Fitness, str]:
    kept = replace(LIMITS, **limits)
    found = verdict(report, kept, findings(report, kept))
    return found.fitness, found.text


def test_nine_gains_are_one_line_with_each_as_evidence() -> None:
    rig = make_rig(9)
    gains = [1.3 + 0.1 * index for index in range(9)]
    cameras = tuple(replace(c, gains=(gain, 1.0, 1.0)) for c, gain in zip(rig.cameras, gains, strict=True))
    (finding,) = findings(replace(make_report(), rig=replace(rig, cameras=cameras)))
    assert finding.text == (
        "9 cameras need a colour gain beyond 1.25 or 1/1.25: cam0 (1.30), cam1 (1.40), cam2 (1.50), cam3 (1.60), "
        "cam4 (1.70), cam5 (1.80) and 3 more."
    )
    assert [f"cam{index} needs a colour gain of {gain:.2f}." for index, gain in enumerate(gains)] == list(
        finding.evidence
    )
    assert finding.cure


def test_the_verdict_says_fit_unfit_or_that_nobody_can_tell() -> None:
    report = make_report()
    level = summary(report)["psnr_db"]
    fitness, text = judged(report)
    assert (fitness, f"{level:.2f} dB" in text) == (Fitness.FIT, True)
    assert judged(report, psnr_db=level - 0.01)[0] is Fitness.FIT
    fitness, text = judged(report, psnr_db=level + 0.1)
    assert fitness is Fitness.UNFIT
    assert "below the limit" in text
    assert "to do:" in text
    assert page_text(report, replace(LIMITS, psnr_db=40.0)).count('class="verdict unfit"') == 1
    for missing in ({"held_out": ()}, {"scores": ()}, {"scene": None}, {"scene": replace(make_scene(), verified=None)}):
        assert judged(replace(report, **missing))[0] is Fitness.UNJUDGED


@pytest.mark.parametrize(
    "limit", [{"moving_db": 23.0}, {"flicker": 0.01}, {"mb_per_30_frames": 1.0}], ids=lambda limit: next(iter(limit))
)
def test_limits_of_a_delivery_block_it_where_they_are_set(limit: dict[str, float]) -> None:
    scores = tuple(replace(score, moving_db=22.0, flicker=0.02) for score in make_scores())
    report = replace(make_report(), scores=scores)
    assert judged(report)[0] is Fitness.FIT
    assert judged(report, **limit)[0] is Fitness.UNFIT
    blocking = [item for item in findings(report, replace(LIMITS, **limit)) if item.severity is Severity.BLOCKS]
    assert len(blocking) == 1
    assert blocking[0].cure


def test_a_frame_is_not_worse_because_the_better_camera_did_not_film_it() -> None:
    whole = [
        FrameScore(camera, frame, level, 0.9) for camera, level in (("a", 24.0), ("b", 18.0)) for frame in range(9)
    ]
    part = [score for score in whole if (score.camera, score.frame) != ("a", 4)]
    assert mean_by_frame(part) == pytest.approx(mean_by_frame(whole)) == dict.fromkeys(range(9), pytest.approx(21.0))


def test_the_model_that_turns_has_the_cameras_on_their_ring() -> None:
    model = rig_model(make_rig(8).cameras, held_out=["cam2"], volume=Volume((0, 0, 0), 1.0))
    tips = np.array([camera["points"][0] for camera in model["cameras"]])
    middles = np.array([np.mean(camera["points"][1:], axis=0) for camera in model["cameras"]])
    assert np.allclose(np.linalg.norm(tips, axis=1), 1, atol=1e-3)
    assert (np.linalg.norm(middles, axis=1) < 0.9).all()  # they look inwards
    assert [camera["name"] for camera in model["cameras"] if camera["held"]] == ["cam2"]


def falling(slope_db: float, frames: int = 60) -> tuple[FrameScore, ...]:
    """Scores whose still areas change by this much in 100 frames."""
    return tuple(
        FrameScore(camera, frame, 26.0, 0.9, moving_db=22.0, still_db=28.0 + slope_db * frame / 100, tof_px=0.2)
        for camera in HELD_OUT
        for frame in range(frames)
    )


def test_still_places_that_rot_are_named() -> None:
    report = replace(make_report(), motion=None, scores=falling(-0.5))
    assert texts(report) == ["quality: Still places rot: they lose 0.50 dB per 100 frames."]
    assert summary(report)["still_trend_db"] == pytest.approx(-0.5)
    words = Page(page_text(report)).words
    assert "Where the error lies" in words
    assert "-0.50 over all" in words
    for scores in (falling(-0.25), falling(0.5), falling(-2.0, frames=20)):
        assert texts(replace(report, scores=scores)) == []


def test_fitted_cameras_far_above_unseen_ones_at_the_same_frames_are_a_finding() -> None:
    def beside(gap_db: float) -> ReportInput:
        """Fitted cameras above the unseen ones by a gap, at three frames, of which one camera lacks one."""
        unseen = {frame: np.mean([s.psnr_db for s in make_scores() if s.frame == frame]) for frame in (2, 6, 10)}
        pairs = [("cam0", 2), ("cam0", 6), ("cam0", 10), ("cam5", 2), ("cam5", 10)]
        own = tuple(FrameScore(camera, frame, unseen[frame] + gap_db, 0.95) for camera, frame in pairs)
        return replace(make_report(), fitted=own)

    near, far = beside(2.0), beside(9.0)
    assert summary(near)["fitted_gap_db"] == pytest.approx(2.0)
    assert summary(near)["fitted_cameras"] == ["cam0", "cam5"]
    assert summary(near)["psnr_db"] == summary(make_report())["psnr_db"]
    assert summary(make_report())["fitted_gap_db"] is None
    assert findings(near) == findings(make_report())
    (finding,) = set(findings(far)) - set(findings(near))
    assert "9.0 dB of what was fitted is not there from elsewhere" in finding.text
    assert finding.cure
    assert finding not in findings(far, replace(LIMITS, fitted_gap_db=9.5))
    for report in (near, far):
        assert "cam0, cam5" in section(page_text(report), "quality")
        assert len(report_json(report)["fitted"]) == 5
    assert "Fitted beside unseen" not in page_text(replace(near, held_out=()))
    assert "Fitted beside unseen" not in page_text(replace(near, scores=near.scores[:1]))  # no frame in common


def test_versions_of_stages_are_listed_and_artefacts_made_otherwise_are_one_finding() -> None:
    how = {"numpy 2.1.0, not 2.2.6": ("sync", "rig"), "another processor, a Z80": ("rig",)}
    report = replace(make_report(), stage_versions={"sync": 31, "rig": 7}, otherwise=how)
    page = section(page_text(report), "run")
    assert "sync  31" in page
    assert "rig   7" in page
    (finding,) = set(findings(report)) - set(findings(make_report()))
    assert finding.severity is Severity.NOTE
    assert finding.evidence == ("sync, rig: made by numpy 2.1.0, not 2.2.6.", "rig: made by another processor, a Z80.")
    run = report_json(report)["run"]
    assert (run["stage_versions"], run["otherwise"]) == ({"sync": 31, "rig": 7}, {k: list(v) for k, v in how.items()})


def test_scores_without_areas_show_none() -> None:
    report = make_report()
    assert "Where the error lies" not in Page(page_text(report)).words
    assert summary(report)["psnr_moving_db"] is None


def test_a_camera_whose_exposure_jumps_is_named() -> None:
    assert make_light(1.25).jump("cam2") == (pytest.approx(1.25), 5)
    assert texts(replace(make_report(), light=make_light(0.8))) == [
        "light: The exposure of cam2 jumps by a factor of 0.80 at frame 5; fit and scores allow for it."
    ]
    flicker = {"cam2": 0.2 * (-1.0) ** np.arange(FRAMES)[:, None] * np.ones(3)}
    assert texts(replace(make_report(), light=replace(make_light(), exposures=flicker))) == []
    steady = LightCurve(np.zeros((1, 3)), {"cam2": np.zeros((1, 3))})
    assert steady.jump("cam2") == (1.0, 0)


def test_steady_light_says_why() -> None:
    steady = LightCurve(np.zeros((FRAMES, 3)), reason="it changes by 0.05 %, less than 0.20 %")
    assert "0.05 %, less than" in section(page_text(replace(make_report(), light=steady)), "light")
    own = replace(steady, exposures=make_light().exposures)
    assert "Light of the room is taken for steady" in section(page_text(replace(make_report(), light=own)), "light")


def test_cameras_that_code_colour_otherwise_and_log_footage_are_named() -> None:
    usual = {"bit_depth": 10, "transfer": "bt709"}
    colours = {"cam0": usual, "cam1": {"bit_depth": 8, "transfer": None}, "cam2": usual}
    assert texts(replace(make_report(), colours=colours, log_like=("cam0", "cam2"))) == [
        "colour: The video of cam1 is coded otherwise than most: bit depth 8, not 10; transfer untold, not bt709.",
        'colour: cam0, cam2 look like log footage; say which in capture.toml, such as transfer = "slog3".',
    ]


def test_scores_without_held_out_cameras_are_not_sold_as_more() -> None:
    report = replace(make_report(), held_out=())
    assert "No camera was held out" in texts(report)[0]
    assert "PSNR, fitted cameras" in Page(page_text(report)).words


# ---- pictures


def test_pictures_are_embedded_with_their_difference() -> None:
    rng = np.random.default_rng(0)
    truth = cv2.GaussianBlur(rng.integers(0, 200, (90, 160, 3), dtype=np.uint8), (0, 0), 3)
    render = truth + np.uint8(10)
    report = ReportInput("pictures", pictures=(Comparison("cam1", 0, truth, render),))
    urls = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page_text(report))
    shown = [cv2.imdecode(np.frombuffer(base64.b64decode(url), np.uint8), cv2.IMREAD_COLOR)[..., ::-1] for url in urls]
    # JPEG of smooth pictures at quality 88 is within a few grey values
    for got, wanted in zip(shown, (truth, render, np.full_like(truth, 40)), strict=True):
        assert np.abs(got.astype(int) - wanted).mean() < 2


def test_pictures_may_be_files_and_large_ones_shrink(tmp_path: Path) -> None:
    picture = np.full((720, 1280, 3), (200, 100, 50), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), picture[..., ::-1])
    report = ReportInput("files", pictures=(Comparison("cam1", 0, tmp_path / "a.png", picture),))
    assert page_text(report).count('width="640" height="360"') == 3


def test_unusable_pictures_are_refused(tmp_path: Path) -> None:
    good, other = np.zeros((20, 30, 3), np.uint8), np.zeros((20, 31, 3), np.uint8)
    (tmp_path / "bad.png").write_text("no picture")
    for truth, error, message in [
        (tmp_path / "none.png", FileNotFoundError, "which is not there"),
        (tmp_path / "bad.png", ValueError, "cannot be read as a picture"),
        (other, ValueError, "must have one size, but have 31x20 and 30x20"),
        (good[..., 0], ValueError, r"must be uint8 \[H, W, 3\]"),
    ]:
        with pytest.raises(error, match=message):
            page_text(ReportInput("bad", pictures=(Comparison("cam1", 0, truth, good),)))


def test_first_middle_and_worst_frames_get_pictures() -> None:
    levels = [25, 24, 21, 24, 26]
    scores = [FrameScore("b", frame, level, 0.9) for frame, level in enumerate(levels)]
    scores += [FrameScore("a", 7, 20.0, 0.9)]
    assert frames_to_picture(scores[::-1]) == (
        ("a", 7, "first, middle, worst"),
        ("b", 0, "first"),
        ("b", 2, "middle, worst"),
    )
    assert frames_to_picture([]) == ()


# ---- plots


def svg_root(text: str) -> ElementTree.Element:
    return ElementTree.fromstring(text)


numbers = st.floats(-1e9, 1e9, allow_subnormal=False) | st.just(math.nan)


@given(
    st.lists(numbers, min_size=1, max_size=30),
    st.lists(st.integers(0, 29), max_size=4),
    st.booleans(),
)
def test_charts_of_any_numbers_are_sound(values: list[float], marks: list[int], from_zero: bool) -> None:
    series = [Series("a <b>", range(len(values)), values), Series("flat", range(len(values)), [1.0] * len(values))]
    chart = line_chart(series, title='"t"', x_label="x", y_label="y & z", marks=marks, from_zero=from_zero)
    root = svg_root(chart)
    assert "nan" not in chart
    points = re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)", chart)
    assert len(points) == len(values) + sum(not math.isnan(value) for value in values)
    assert all(-0.1 <= float(y) <= 260.1 for _, y in points)
    assert [text.text for text in root.iter("text") if text.get("class") == "label s1"].count("flat") == 1


@given(st.lists(st.floats(0, 1e12), max_size=40))
@example([5e-324])
def test_bars_stand_on_zero_and_keep_their_ratio(values: list[float]) -> None:
    root = svg_root(bar_chart(values, title="t", x_label="x", y_label="y", strong=[0]))
    heights = [float(bar.get("height", "nan")) for bar in root.iter("rect")]
    assert len(heights) == len(values)
    top = max(values, default=0)
    if top > 1e-6:
        assert np.allclose(np.array(heights) / max(heights), np.array(values) / top, atol=1e-3)  # two decimals of px


@given(st.integers(0, 2**32 - 1), st.integers(MOST_POINTS + 1, 6 * MOST_POINTS))
def test_a_long_line_keeps_its_extremes_ends_and_gaps(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=count)
    gap = rng.integers(1, count // 2)
    values[gap : gap + count // 4] = math.nan
    line = thinned(Series("a", range(count), values.tolist()))
    assert len(line.x) <= MOST_POINTS + 2
    assert list(line.x) == sorted(set(line.x))
    assert np.array_equal(np.array(line.y), values[list(line.x)], equal_nan=True)
    assert (np.nanmin(line.y), np.nanmax(line.y)) == (np.nanmin(values), np.nanmax(values))
    assert (line.x[0], line.x[-1]) == (0, count - 1)
    assert any(math.isnan(value) for value in line.y)


def test_a_short_line_stays_as_it_is() -> None:
    line = Series("a", range(MOST_POINTS), [1.0] * MOST_POINTS)
    assert thinned(line) is line


LONG = 54_000
SEGMENTS = 1350


def long_report() -> ReportInput:
    """Half an hour: as many segments with their keyframes, half of the rest skipped."""
    scores = tuple(FrameScore("cam1", frame, 30.0 - 3 * (frame == 27_001), 0.9, still_db=31.0) for frame in range(LONG))
    stages = [StageRecord("sync", StageOutcome.MADE, 1.5, 200_000_000)]
    for number in range(SEGMENTS):
        name = f"fit segment {number} (frames {40 * number}-{40 * number + 39})"
        stages.append(StageRecord(f"fit keyframe {40 * number}", StageOutcome.MADE, 2.0, 10**9))
        stages.append(StageRecord(name, StageOutcome.MADE, 60.0 + (number == 77), 10**9))
        stages.append(
            StageRecord(f"fit frames {40 * number}-{40 * number + 39}", StageOutcome.SKIPPED, 0.0, reason="still")
        )
    stages[500] = replace(stages[500], outcome=StageOutcome.FAILED, reason="no luck")
    sizes, counts = (900,) * LONG, (5000,) * LONG
    return replace(
        make_report(),
        light=LightCurve(np.random.default_rng(0).normal(0, 0.02, (LONG, 3)), {"cam2": np.zeros((LONG, 3))}),
        motion=MotionCurve(np.random.default_rng(1).random(LONG), tuple(range(0, LONG, 40))),
        scores=scores,
        scene=SceneFigures("scene.mkv", 10**9, Fraction(30), sizes, counts, counts),
        stages=tuple(stages),
    )


@pytest.fixture(scope="module")
def long_page() -> str:
    return page_text(long_report())


def test_half_an_hour_has_no_more_rows_than_a_person_reads(long_page: str) -> None:
    assert max(table.count("<tr") for table in long_page.split("<table")) < 60
    for row in (
        "fit segment 77 (frames",  # the longest
        f"{SEGMENTS - 6:,} more: fit segment",
        f"{SEGMENTS - 6:,} more: fit keyframe",
        f"{SEGMENTS - 6:,} more: fit frames",
    ):
        assert row in long_page
    failed = long_report().stages[500]
    assert f"<td>{failed.label}</td>" in long_page


def test_half_an_hour_has_plots_of_bounded_size(long_page: str) -> None:
    assert len(long_page) < 1_500_000
    paths = re.findall(r'<path class="line[^"]*" d="([^"]*)"', long_page)
    assert paths
    assert all(len(re.findall(r"[ML]", path)) <= MOST_POINTS + 2 for path in paths)
    assert long_page.count("<rect") < 2 * MOST_BARS + 400
    assert 'class="mark"' not in long_page
    assert "Dashed lines" not in long_page


def test_half_an_hour_has_no_list_by_frame_in_its_json() -> None:
    data = report_json(long_report())
    assert data["every"] == 11
    lists = [
        data["light"]["factors"],
        data["light"]["exposures"]["cam2"],
        data["motion"]["magnitude_px"],
        data["scores"],
    ]
    lists += [data["scene"][name] for name in ("frame_bytes", "gaussians", "dynamic")]
    assert {len(values) for values in lists} == {-(-LONG // 11)}
    assert [score["frame"] for score in data["scores"][:3]] == [0, 11, 22]
    assert data["summary"]["frames"] == LONG
    assert report_json(make_report())["every"] == 1


def test_the_rig_is_seen_from_above_and_from_the_side() -> None:
    rig = make_rig(8)
    across, away, up = rig_axes(rig.cameras)
    assert np.allclose(up, [0, 0, 1])
    assert np.allclose(np.cross(across, away), up)
    tilted = (0.0, 0.6, 0.8)
    assert np.allclose(rig_axes(rig.cameras, tilted)[2], tilted)
    assert np.allclose(np.stack(rig_axes(rig.cameras, tilted)) @ np.stack(rig_axes(rig.cameras, tilted)).T, np.eye(3))
    above, side = rig_views(rig.cameras, held_out=["cam2"], volume=Volume((0, 0, 0), 1.0), unit="m")
    dots = [
        [(float(c.get("cx", 0)), float(c.get("cy", 0))) for c in svg_root(view).iter("circle") if c.get("r") == "3"]
        for view in (above, side)
    ]
    ring = np.hypot(*(np.array(dots[0]) - 235).T)
    assert np.allclose(ring, ring[0], atol=0.1)  # a circle from above, a line from the side; pixels have one decimal
    assert np.ptp(np.array(dots[1])[:, 1]) < 0.2
    assert above.count('class="camera held"') == 2
    assert above.count('class="volume"') == 1


def test_cameras_on_a_pole_have_a_view_too() -> None:
    rig = make_rig(3)
    poses = []
    for index in range(3):
        pose = rig.cameras[0].camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ [0, 0, index]
        poses.append(replace(rig.cameras[index], camera_from_world=pose))
    axes = np.stack(rig_axes(poses))
    assert np.allclose(axes @ axes.T, np.eye(3))


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(None, "–"), (0.421, "0.42 s"), (12.34, "12.3 s"), (59.99, "60.0 s"), (245.2, "4 min 5 s"), (7380, "2 h 3 min")],
)
def test_durations_read_well(seconds: float | None, words: str) -> None:
    assert duration(seconds) == words


# ---- scene files


def test_figures_of_a_scene_come_from_its_header(tmp_path: Path) -> None:
    from packuv.gaussians.codes import OPACITY_RANGE, Codes, Quantizer, attribute_count
    from packuv.gaussians.segment import Segment
    from packuv.scene import SceneHeader, Sound, open_scene, write_scene

    rng, columns = np.random.default_rng(1), attribute_count(0)
    low, high = np.full(columns, -1.0), np.full(columns, 1.0)
    low[6], high[6] = OPACITY_RANGE
    quantizer = Quantizer(np.zeros(3), 1.0, np.ones(3), low, high)
    paths = []
    for first, length, count in ((0, 3, 40), (3, 2, 50)):
        key = Codes(
            rng.integers(0, 9, (count, 3), dtype=np.uint16), rng.integers(1, 9, (count, columns), dtype=np.uint8)
        )
        moves = np.arange(count) < 10
        xyz = np.repeat(key.xyz[None, :10], length - 1, axis=0)
        xyz[-1] += 1  # the second of three frames repeats the first, and takes no packet
        attributes = np.repeat(key.attributes[None, :10], length - 1, axis=0)
        paths.append(tmp_path / f"{first}.npz")
        Segment(first, key, moves, xyz, attributes).save(paths[-1])
    times = np.arange(5, dtype=np.int64) * 40_000_000
    header = SceneHeader(quantizer, times, Fraction(25))
    written = write_scene(tmp_path / "scene.mkv", paths, header)
    with open_scene(tmp_path / "scene.mkv") as scene:
        figures = scene_figures(scene, verified=True)
    assert figures.gaussians == (40, 40, 40, 50, 50)
    assert figures.dynamic == (10,) * 5
    assert figures.bytes == written.bytes
    assert sum(figures.frame_bytes) == sum(written.track_bytes.values())
    assert figures.frame_bytes[1] == 0 < min(figures.frame_bytes[index] for index in (0, 2, 3, 4))
    assert summary(ReportInput("s", scene=figures))["mb_per_30_frames"] == pytest.approx(written.bytes * 6 / 1e6)
    assert "of it header and index.</p>" in page_text(ReportInput("s", scene=figures))
    write_scene(tmp_path / "loud.mkv", paths, header, sound=Sound.of("cam7", np.ones((2, 9600), np.float32) / 2))
    with open_scene(tmp_path / "loud.mkv") as scene:
        loud = scene_figures(scene)
    assert (loud.sound, loud.frame_bytes) == ("cam7", figures.frame_bytes)
    assert "of it header and index, and what cam7 heard.</p>" in page_text(ReportInput("s", scene=loud))


def test_figures_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match="must have one length"):
        SceneFigures("s", 1, Fraction(30), (1, 2), (1,), (1,))
    with pytest.raises(ValueError, match="instants 0 to 2"):
        MotionCurve(np.zeros(3), (0, 3))
    with pytest.raises(ValueError, match="valid StageOutcome"):
        StageRecord("fit", "nearly", 1.0)


def test_shading_is_shown_and_an_odd_corner_is_said():
    rig = make_rig()
    lenses = [(-0.3, 0.05), (-0.9, 0.05), *[(0.0, 0.0)] * 4]
    cameras = tuple(replace(camera, shading=lens) for camera, lens in zip(rig.cameras, lenses, strict=True))
    report = replace(
        make_report(), rig=replace(rig, cameras=cameras), unlike={"cam3": "only 8 points tell its colours"}
    )
    found = [finding.text for finding in findings(report) if finding.section == "colour"]
    assert found == [
        "cam1 seems to have 43% of its light in the corner.",
        "cam3 keeps its colours as filmed: only 8 points tell its colours.",
    ]
    words = Page(page_text(report)).words
    assert "light in the corner" in words
    assert "78%" in words
    assert "No lens shading was found" in Page(page_text(make_report())).words
