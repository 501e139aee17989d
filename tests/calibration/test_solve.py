"""Solving a rig from pictures alone, judged against the cameras that took them."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.features import FeatureOptions
from calibration.importers import load_rig
from calibration.judge import matches_at
from calibration.refine import PLACES, SOLVED, RefineOptions, refine
from calibration.rig import Rig
from calibration.solve import Lens, SolveOptions, solve_rig
from tests.support.calibration_scene import filmed, render
from tests.support.needs import need_data

OPTIONS = SolveOptions(features=FeatureOptions(max_features=800), lens=Lens.PINHOLE, shared_lens=True)


def similarity(points: np.ndarray, onto: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that bring points [N, 3] nearest to others (Umeyama, 1991)."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    left, sizes, right = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = left @ sign @ right
    scale = float(np.trace(np.diag(sizes) @ sign) / (a**2).sum())
    return scale, turn, onto.mean(axis=0) - scale * turn @ points.mean(axis=0)


def errors(solved: Rig, truth: Rig) -> tuple[float, float]:
    """Greatest error of a centre, as a share of the rig's extent, and of a rotation, degrees, in the best alignment."""
    truth = truth.select(solved.names)
    scale, turn, shift = similarity(solved.centres, truth.centres)
    extent = np.linalg.norm(truth.centres.max(axis=0) - truth.centres.min(axis=0))
    centres = np.linalg.norm(scale * solved.centres @ turn.T + shift - truth.centres, axis=1).max() / extent
    turns = [
        np.linalg.norm(cv2.Rodrigues(a.camera_from_world[:3, :3] @ turn.T @ b.camera_from_world[:3, :3].T)[0])
        for a, b in zip(solved.cameras, truth.cameras, strict=True)
    ]
    return float(centres), float(np.degrees(max(turns)))


@pytest.mark.slow
def test_a_textured_room_gives_its_cameras_back(tmp_path):
    truth, _, pictures = filmed(6)
    rig = solve_rig(pictures, OPTIONS, tmp_path / "first")
    centre, turn_deg = errors(rig, truth)
    assert rig.names == truth.names
    # A tenth of a pixel over a focal length of 304 is 0.02 degrees; COLMAP keeps the principal point at the middle,
    # 3 and 2 pixels from the truth, which turns every camera by 0.7 degrees about an axis of its own.
    assert centre < 0.02
    assert turn_deg < 1
    assert all(camera.fx == pytest.approx(304, rel=0.03) for camera in rig.cameras)
    assert rig.source.startswith("COLMAP, 6 of 6 cameras")
    report = json.loads((tmp_path / "first/report.json").read_text())
    assert report["matches"]["explained_share"] > 0.95
    again = solve_rig(pictures, OPTIONS, tmp_path / "second")
    assert all(
        np.array_equal(a.camera_from_world, b.camera_from_world)
        for a, b in zip(rig.cameras, again.cameras, strict=True)
    )


@pytest.mark.slow
def test_known_lenses_stay_as_they_are_and_steady_the_rig(tmp_path):
    truth, _, pictures = filmed(6)
    rig = solve_rig(pictures, replace(OPTIONS, shared_lens=False), tmp_path, lenses=truth)
    assert [(c.fx, c.fy, c.cx, c.cy, c.distortion) for c in rig.cameras] == [
        (c.fx, c.fy, c.cx, c.cy, c.distortion) for c in truth.cameras
    ]
    matches = next(matches_at(rig, [pictures]))
    done = refine(rig, matches, levels=PLACES, options=RefineOptions(adjust=SOLVED))
    solved, refined = errors(rig, truth), errors(done.rig, truth)
    assert refined <= solved
    assert refined[0] < 0.005
    assert refined[1] < 0.15  # pictures of 320x240: a pixel is 0.19 degrees


@pytest.mark.slow
def test_instants_of_a_standing_rig_count_as_one_picture_each(tmp_path):
    truth, _, pictures = filmed(6)
    shots = {c.name: [pictures[c.name], render(c, seed=3)] for c in truth.cameras}
    rig = solve_rig(shots, OPTIONS, tmp_path)
    assert errors(rig, truth)[0] < 0.02
    one = solve_rig(pictures, OPTIONS, tmp_path / "one")
    assert len(one.cameras) == 6
    both, single = (json.loads((folder / "report.json").read_text()) for folder in (tmp_path, tmp_path / "one"))
    assert both["matches"]["matches"] > 1.3 * single["matches"]["matches"]


def test_a_standing_scene_counts_once(tmp_path):
    """The same picture given twice must not look like twice the evidence."""
    _, _, pictures = filmed(6)
    few = {name: pictures[name] for name in ("cam1", "cam2")}
    counts = []
    for repeats in (1, 2):
        folder = tmp_path / str(repeats)
        with suppress(ValueError):  # two pictures may or may not suffice; what was given to COLMAP is looked at
            solve_rig({name: [shot] * repeats for name, shot in few.items()}, OPTIONS, folder)
        with np.load(folder / "matches.npz") as matches:
            counts.append({key: len(rows) for key, rows in matches.items()})
    assert counts[0] == counts[1]
    assert counts[0]["0 1"] > 30


def test_pictures_without_texture_say_which_cameras_were_not_placed(tmp_path):
    grey = {f"cam{i}": np.full((60, 80, 3), 100 + i, np.uint8) for i in range(3)}
    with pytest.raises(
        ValueError, match=r"must place 90% of 3 cameras .* placed 0 \(\[\]\), not \['cam0', 'cam1', 'cam2'\]"
    ):
        solve_rig(grey, OPTIONS, tmp_path)


def test_pictures_must_be_alike(tmp_path):
    picture = np.zeros((60, 80, 3), np.uint8)
    with pytest.raises(ValueError, match=r"same number of instants each, but got \{'a': 1, 'b': 2\}"):
        solve_rig({"a": picture, "b": [picture, picture]}, SolveOptions(), tmp_path)
    with pytest.raises(ValueError, match="camera 'b' needs uint8 pictures"):
        solve_rig({"a": [picture] * 2, "b": [picture, picture[:30]]}, SolveOptions(), tmp_path)
    with pytest.raises(ValueError, match="two cameras or more"):
        solve_rig({"a": picture}, SolveOptions(), tmp_path)


@pytest.mark.slow
def test_photographs_of_a_fox_agree_with_their_calibration(data, tmp_path):
    folder = need_data(data / "fox")
    files = sorted((folder / "images").iterdir())[::3]
    pictures = {path.stem: cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_2)[..., ::-1].copy() for path in files}
    rig = solve_rig(pictures, replace(OPTIONS, features=FeatureOptions(max_features=2048), lens=Lens.OPENCV), tmp_path)
    centre, turn_deg = errors(rig, load_rig(folder / "transforms.json"))
    assert len(rig.cameras) >= 16
    assert centre < 0.05  # measured 0.8 % in the median over 25 photographs, 4 % at worst
    assert turn_deg < 2
