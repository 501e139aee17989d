"""Recorded captures: their calibrations must explain their pictures."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from calibration.accept import Verdict, check_rig
from calibration.colour import ColourModel, balance
from calibration.features import FeatureOptions
from calibration.importers import load_rig
from calibration.judge import judge
from calibration.triangulate import TriangulateOptions, triangulate
from tests.support.needs import need_data


def nearest_frame(timecodes: Path, time_us: int) -> int:
    """Number of the video frame whose line frame_<epoch microseconds>_<index> is nearest to a time."""
    times = np.array([int(line.split("_")[1]) for line in timecodes.read_text().split()])
    return int(np.abs(times - time_us).argmin())


def frame(video: Path, number: int) -> np.ndarray:
    with av.open(str(video)) as container:
        for index, picture in enumerate(container.decode(video=0)):
            if index == number:
                return picture.to_ndarray(format="rgb24")
    raise AssertionError(f"{video} has no frame {number}")


@pytest.mark.slow
def test_a_studio_with_27_cameras(data):
    folder = need_data(data / "basketball")
    videos = sorted((folder / "videos").iterdir())
    time_us = int((folder / "timecodes/cam03.txt").read_text().split()[75].split("_")[1])
    pictures = {v.stem: frame(v, nearest_frame(folder / f"timecodes/{v.stem}.txt", time_us)) for v in videos}
    judgement = judge(load_rig(folder / "calibration", sorted(pictures)), pictures)
    assert judgement.matches.verdict is Verdict.ACCEPTED
    assert judgement.matches.explained_share > 0.9
    rig = judgement.rig
    report = check_rig(rig)
    assert report.seen_share == 1
    assert not report.suspicious
    points = triangulate(rig, [pictures])
    assert len(points.xyz) > 600  # measured 839 of 4.1 views each
    assert points.matches.reprojection_px < 0.6  # measured 0.41
    inside = np.linalg.norm(points.xyz - report.scene_centre, axis=1) < 2 * report.rig_radius
    assert inside.mean() > 0.95  # the dome's wall stands where the cameras do
    colour = balance(rig, points)
    assert colour.kept
    assert colour.spreads[ColourModel.GAINS] < 0.6 * colour.spreads[ColourModel.NONE]  # measured 4.0 % after 10.7 %


@pytest.mark.slow
def test_photographs_with_a_transforms_file(data):
    folder = need_data(data / "fox")
    files = sorted((folder / "images").iterdir())[10:16]
    pictures = {path.stem: cv2.imread(str(path))[..., ::-1].copy() for path in files}
    rig = load_rig(folder / "transforms.json", sorted(pictures))
    points = triangulate(rig, [pictures], options=TriangulateOptions(features=FeatureOptions(max_features=1500)))
    assert points.matches.verdict is Verdict.ACCEPTED
    assert points.matches.explained_share > 0.97  # measured 0.996 over all 50
    assert points.matches.pair_median_px < 1
    assert len(points.xyz) > 300
