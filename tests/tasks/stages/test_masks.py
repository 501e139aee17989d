"""Foreground masks of balls, right and moved, through the stages that measure motion and compare."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from sync.capture import find_capture
from sync.masks import find_masks
from tasks.artefacts.stage import Files, Notes, Site
from tasks.artefacts.store import Key
from tasks.report.facts import ReportInput
from tasks.report.findings import findings
from tasks.stages.footage import RIG, Take
from tasks.stages.masks import CheckMasks, CheckUnseenMasks, believed, doubts
from tasks.stages.track import FindMotion
from tests.support.artefacts import build_here, put
from tests.support.balls import covered
from tests.tasks.stages.test_content import COUNT, FRAMES, HEIGHT, MOTION_OPTIONS, NAMES, WIDTH, calibrated, film
from tests.tasks.stages.test_content import synchronized as synchronize

FITTED = NAMES[:2]
NONE, MOVED = (0, 0), (8, 0)
"""Pixels"""
BORDER = 0.04
"""Share of what moves that is measured beyond the border of the balls; it was 0.02"""


def write_masks(capture: Path, shifts: dict[str, tuple[int, int]]) -> None:
    """Of the balls in 16 bits, of label 1, moved by columns and rows."""
    shutil.rmtree(capture / "masks", ignore_errors=True)
    for name, shift in shifts.items():
        (capture / "masks" / name).mkdir(parents=True)
        seen = covered(NAMES.index(name), COUNT, np.arange(FRAMES), WIDTH, HEIGHT)
        for number, balls in enumerate(seen.reshape(-1, HEIGHT, WIDTH)):
            mask = np.roll(balls, shift, (1, 0)).astype(np.uint16)
            cv2.imwrite(str(capture / "masks" / name / f"{number:06d}.png"), mask)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Site, Take, Key]:
    folder = tmp_path_factory.mktemp("balls")
    site = Site(folder / "store", folder / "capture", 1)
    film(site.capture, {})
    rig = put(site, "rig", lambda out: calibrated().save(out / RIG))
    take = Take(groups=synchronize(site, folder / "sync"), rig=rig, cameras=FITTED)
    _, made = build_here(FindMotion(take=take, options=MOTION_OPTIONS), site, folder / "motion")
    motion = put(site, "motion", lambda out: shutil.copytree(made, out, dirs_exist_ok=True))
    return site, take, motion


def compared(measured: tuple[Site, Take, Key], folder: Path) -> Notes:
    site, take, motion = measured
    masks = {name: "content" for name in find_masks(find_capture(site.capture)) if name in take.cameras}
    return build_here(CheckMasks(take=take, motion=motion, masks=Files(masks)), site, folder)[0]


def test_masks_of_what_moves_are_believed(measured: tuple[Site, Take, Key], tmp_path: Path) -> None:
    write_masks(measured[0].capture, {"cam0": NONE, "cam4": NONE})  # the last of which nobody fits
    notes = compared(measured, tmp_path)
    assert list(notes["cameras"]) == ["cam0"]
    assert notes["without"] == ["cam1"]
    facts = notes["cameras"]["cam0"]
    truth = covered(0, COUNT, np.arange(FRAMES), WIDTH, HEIGHT).mean()
    assert facts["foreground_share"] == pytest.approx(truth)
    assert facts["outside_share"] < BORDER
    assert facts["fit"]["shift_px"] == NONE
    assert not doubts(notes)
    assert believed(notes) == ["cam0"]


def test_masks_of_cameras_whose_motion_nobody_measured_are_checked_alike(
    measured: tuple[Site, Take, Key], tmp_path: Path
) -> None:
    site, take, _ = measured
    write_masks(site.capture, {"cam0": NONE, "cam1": MOVED})
    whole = compared(measured, tmp_path / "seen")
    masks = Files({"cam0": "content", "cam1": "content"})
    check = CheckUnseenMasks(take=take, masks=masks, motion_options=MOTION_OPTIONS)
    notes, _ = build_here(check, site, tmp_path / "unseen")
    assert notes == whole
    assert [what for what, _ in check.spared(tmp_path, notes)] == ["masks of cam1"]


def test_moved_and_empty_masks_are_named_with_where_they_fit(measured: tuple[Site, Take, Key], tmp_path: Path) -> None:
    write_masks(measured[0].capture, {"cam0": MOVED, "cam1": (0, -8)})
    notes = compared(measured, tmp_path / "moved")
    assert {name: np.sign(facts["fit"]["shift_px"]).tolist() for name, facts in notes["cameras"].items()} == {
        "cam0": [-1, 0],
        "cam1": [0, 1],
    }
    assert list(doubts(notes)) == ["cam0", "cam1"]
    (told,) = findings(ReportInput("balls", masks=doubts(notes)))
    assert "2 cameras have masks that do not fit what moves and are not used: cam0, cam1" in told.text
    assert not believed(notes)

    for path in (measured[0].capture / "masks" / "cam1").iterdir():
        cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint8))
    assert "0.00% of its pictures is foreground" in doubts(compared(measured, tmp_path / "empty"))["cam1"]
