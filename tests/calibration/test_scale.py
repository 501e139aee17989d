"""Boards in pictures, the scale and the up that they tell, and what is said where they contradict each other."""

from __future__ import annotations

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.board import Board, Corners, find_corners
from calibration.importers import load_rig
from calibration.rig import Camera, Rig
from calibration.scale import (
    Distance,
    Located,
    Measured,
    ScaleOptions,
    contradictions,
    locate_board,
    measure_board,
    measure_distances,
    scaled,
    up_of_board,
    up_of_cameras,
)
from tests.support.boards import board_pose, extent, show
from tests.support.calibration_scene import look_at, ring

OPTIONS = ScaleOptions()
SCALE_TOLERANCE = 0.005
"""Of the scale, as a share; measured: 0.0004 by ChArUco boards, 0.0018 by AprilTags"""
UP_TOLERANCE_DEG = 0.5
"""Measured: 0.07"""
CORNER_TOLERANCE_PX = 0.5
"""By the median; measured: 0.05 to 0.2, by AprilTags 0.3"""
EXACT = 1e-9

CHARUCO = Board(kind="charuco", columns=8, rows=5, square=0.12, marker=0.09)  # type: ignore[arg-type]  # text, as a file has it
TAGS = Board(kind="apriltag", columns=4, rows=3, marker=0.15, gap=0.05)  # type: ignore[arg-type]  # likewise
SMALL = Board(kind="charuco", columns=9, rows=6, square=0.08, marker=0.06, dictionary="4X4_100")  # type: ignore[arg-type]  # likewise
FLOOR = ((0.1, 0.0, 0.05), (0.0, -1.0, 0.0))
"""Middle and normal of a board that lies; up is -y in these rigs"""


def room(count: int = 4, *, size: tuple[int, int] = (960, 540)) -> Rig:
    return ring(count, radius=2.2, height=-1.6, size=size)


def seen_in(rig: Rig, board: Board, pose: np.ndarray, **how: object) -> dict[str, Corners]:
    return {name: find_corners(board, picture) for name, picture in show(rig, board, pose, **how).items()}  # type: ignore[arg-type]  # as `show` takes them


def located_in(rig: Rig, board: Board, pose: np.ndarray, **how: object) -> Located:
    found = locate_board(rig, seen_in(rig, board, pose, **how), options=OPTIONS)
    assert found is not None
    return found


def corners_of(board: Board, pose: np.ndarray) -> np.ndarray:
    """Where they truly are, world, float64 [K, 3]."""
    flat = board.points - np.array(extent(board)) / 2
    truth: np.ndarray = flat @ pose[:3, :2].T + pose[:3, 3]
    return truth


def turned(rig: Rig, vector: tuple[float, float, float], factor: float, shift: float = 0.0) -> tuple[Rig, np.ndarray]:
    """The rig in another world: turned, grown and moved; and the turn, float64 [3, 3]."""
    turn = cv2.Rodrigues(np.array(vector))[0]

    def pose(camera: Camera) -> np.ndarray:
        found = np.eye(4)
        found[:3, :3] = camera.camera_from_world[:3, :3] @ turn.T
        found[:3, 3] = -found[:3, :3] @ (factor * turn @ camera.centre + shift)
        return found

    return replace(rig, cameras=tuple(replace(one, camera_from_world=pose(one)) for one in rig.cameras)), turn


# Corners


@pytest.mark.parametrize("board", [CHARUCO, TAGS, SMALL], ids=str)
@pytest.mark.parametrize(("normal", "turn"), [((0, -1, 0), 20), ((0.4, -1, 0.3), 140)])
def test_corners_are_found_where_the_cameras_show_them(board, normal, turn):
    rig, pose = room(), board_pose(FLOOR[0], normal, turn)
    truth = corners_of(board, pose)
    seen = seen_in(rig, board, pose)
    off = np.concatenate([found.pixels - rig[name].project(truth[found.ids])[0] for name, found in seen.items()])
    assert len(off) > 2 * len(board.points)
    assert np.median(np.linalg.norm(off, axis=1)) < CORNER_TOLERANCE_PX
    assert (np.abs(np.median(off, axis=0)) < 0.1).all(), "half a pixel would be a convention mixed up"


def test_the_white_back_of_a_board_shows_nothing():
    rig, pose = room(), board_pose((0, 0, 0), (0, 1, 0))
    assert all(not len(found.ids) for found in seen_in(rig, CHARUCO, pose).values())


def test_a_board_can_be_sent_to_another_process():
    assert len(CHARUCO.points) == 28
    assert pickle.loads(pickle.dumps(CHARUCO)) == CHARUCO
    assert np.array_equal(pickle.loads(pickle.dumps(TAGS)).points, TAGS.points)


# Scale and up, from pictures


@pytest.mark.parametrize("board", [CHARUCO, TAGS], ids=str)
@pytest.mark.parametrize(("normal", "turn"), [((0, -1, 0), 0), ((0, -1, 0), 75), ((0.3, -1, -0.2), 200)])
def test_scale_and_up_are_those_of_the_board(board, normal, turn):
    true, pose = room(), board_pose(FLOOR[0], normal, turn)
    rig, turn_of_world = turned(true, (0.4, -0.9, 0.3), 1 / 0.37, 0.8)
    located = locate_board(rig, seen_in(true, board, pose), options=OPTIONS)
    assert located is not None
    measured = measure_board(board, [located] * 4, options=OPTIONS)
    assert measured is not None
    assert measured.metres_per_unit == pytest.approx(0.37, rel=SCALE_TOLERANCE)
    assert measured.spread < SCALE_TOLERANCE
    assert not measured.doubts
    up = up_of_board(rig, [located] * 4, options=OPTIONS)
    truth = turn_of_world @ (np.array(normal) / np.linalg.norm(normal))
    assert np.degrees(np.arccos(min(1.0, up.direction @ truth))) < UP_TOLERANCE_DEG
    assert not up.doubts


@pytest.mark.parametrize("fisheye", [False, True])
def test_lenses_are_taken_out_of_what_is_measured(fisheye):
    lens = (0.03, 0.01, -0.002, 0.001) if fisheye else (-0.28, 0.09, 0.001, -0.002)
    rig = room(3, size=(640, 360))
    bent = [replace(one, fx=360.0, fy=362.0, distortion=lens, fisheye=fisheye) for one in rig.cameras]
    big = Board(kind="charuco", columns=6, rows=5, square=0.24, marker=0.18)  # type: ignore[arg-type]  # likewise
    located = located_in(replace(rig, cameras=tuple(bent)), big, board_pose((0.4, 0, 0.3), (0, -1, 0), 30))
    measured = measure_board(big, [located] * 4, options=OPTIONS)
    assert measured is not None
    assert measured.metres_per_unit == pytest.approx(1, rel=SCALE_TOLERANCE)
    straight = [replace(one, distortion=(), fisheye=False) for one in bent]
    seen = seen_in(replace(rig, cameras=tuple(bent)), big, board_pose((0.4, 0, 0.3), (0, -1, 0), 30))
    wrong = locate_board(replace(rig, cameras=tuple(straight)), seen, options=OPTIONS)
    off = measure_board(big, [wrong] * 4, options=OPTIONS) if wrong else None
    assert off is None or abs(off.metres_per_unit - 1) > SCALE_TOLERANCE, "the lens makes no difference here"


def test_half_a_board_is_enough():
    located = located_in(room(), CHARUCO, board_pose(*FLOOR, 30), part=0.5)
    assert 6 <= len(located.ids) < len(CHARUCO.points) * 0.6
    measured = measure_board(CHARUCO, [located] * 4, options=OPTIONS)
    assert measured is not None
    assert measured.metres_per_unit == pytest.approx(1, rel=SCALE_TOLERANCE)


def test_a_board_that_one_camera_sees_tells_no_scale():
    seen = seen_in(room(), CHARUCO, board_pose(*FLOOR))
    assert len(seen["cam01"].ids) > 20
    assert locate_board(room(), {"cam01": seen["cam01"]}, options=OPTIONS) is None
    assert locate_board(room(), {}, options=OPTIONS) is None


def test_a_camera_that_takes_something_else_for_the_board_is_left_out():
    seen = seen_in(room(), CHARUCO, board_pose(*FLOOR))
    wrong = seen["cam02"]
    seen["cam02"] = replace(wrong, pixels=wrong.pixels + np.array([40.0, 12.0]))
    located = locate_board(room(), seen, options=OPTIONS)
    assert located is not None
    assert "cam02" not in located.cameras
    measured = measure_board(CHARUCO, [located], options=OPTIONS)
    assert measured is not None
    assert measured.metres_per_unit == pytest.approx(1, rel=SCALE_TOLERANCE)


def test_a_print_that_is_longer_one_way_is_a_finding_with_both_figures():
    located = located_in(room(), CHARUCO, board_pose(*FLOOR, 30), stretch=(1.05, 1.0))
    measured = measure_board(CHARUCO, [located] * 4, options=OPTIONS)
    assert measured is not None
    (doubt,) = measured.doubts
    assert "rows say that one unit is 0.95" in doubt
    assert "columns 1" in doubt
    assert "4.9% apart" in doubt


def test_a_single_instant_is_said_to_be_one():
    measured = measure_board(CHARUCO, [located_in(room(), CHARUCO, board_pose(*FLOOR))], options=OPTIONS)
    assert measured is not None
    assert "only one instant" in measured.doubts[0]


# From places


def placed(board: Board, pose: np.ndarray, rig: Rig, *, factor: float = 1.0) -> Located:
    return Located(np.arange(len(board.points)), corners_of(board, pose) * factor, rig.names)


def test_lengths_that_disagree_are_a_finding():
    rig = room()
    ones = [placed(CHARUCO, board_pose(*FLOOR), rig, factor=factor) for factor in (0.9, 0.95, 1.0, 1.05, 1.1)]
    measured = measure_board(CHARUCO, ones, options=OPTIONS)
    assert measured is not None
    assert "lengths on the board disagree by" in measured.doubts[0]


@given(st.floats(0.01, 100), st.tuples(*(st.floats(-3, 3),) * 3))
@settings(max_examples=30)
def test_a_scaled_rig_shows_scaled_points_where_the_rig_showed_them(factor, vector):
    rig, _ = turned(room(3), vector, 1.0, 0.5)
    points = np.array([[0.1, 0.2, 0.3], [-0.4, 0.1, 0.2]])
    grown = scaled(rig, factor)
    assert grown.metric
    for a, b in zip(rig.cameras, grown.cameras, strict=True):
        assert np.allclose(b.centre, factor * a.centre, atol=EXACT * factor)
        assert np.allclose(b.project(factor * points)[0], a.project(points)[0], atol=1e-6)


def test_a_distance_between_two_cameras_is_a_scale():
    rig = room()
    apart = float(np.linalg.norm(rig["cam00"].centre - rig["cam01"].centre))
    measured = measure_distances(rig, [Distance(("cam00", "cam01"), 5 * apart)], options=OPTIONS)
    assert measured.metres_per_unit == pytest.approx(5, rel=EXACT)
    assert not measured.doubts
    grown = scaled(rig, measured.metres_per_unit)
    assert np.linalg.norm(grown["cam00"].centre - grown["cam01"].centre) == pytest.approx(5 * apart, rel=EXACT)
    two = [Distance(("cam00", "cam01"), 5 * apart), Distance(("cam01", "cam00"), 6 * apart)]
    assert "by one and 6 m by another, 20.0% apart" in measure_distances(rig, two, options=OPTIONS).doubts[0]
    with pytest.raises(ValueError, match="stand in one place by the calibration"):
        measure_distances(
            Rig((rig.cameras[0], replace(rig.cameras[0], name="b")), ""),
            [Distance(("cam00", "b"), 1.0)],
            options=OPTIONS,
        )


def test_what_contradicts_the_measured_scale_is_said_with_both_figures():
    board, distance = Measured(0.93, 0.001, "the board"), Measured(1.0, 0, "the known distance of a to b")
    metric = replace(room(), metric=True, source="calibration.csv")
    said = list(contradictions(metric, board, distance, options=OPTIONS))
    assert said[0].startswith("one unit of the calibration is 0.93 m by the board, but 1 m by the known distance of a")
    assert said[1] == "one unit is a metre by calibration.csv, but 0.93 m by the board, which is believed"
    half = Measured(0.5, 0, distance.told)
    assert "by the known distance" in next(contradictions(metric, None, half, options=OPTIONS))
    assert not list(contradictions(metric, Measured(1.01, 0, ""), Measured(1.0, 0, ""), options=OPTIONS))
    assert not list(contradictions(room(), board, None, options=OPTIONS))
    assert not list(contradictions(metric, None, None, options=OPTIONS))


def test_a_board_that_moves_tells_no_up():
    rig = room()
    lying = [placed(CHARUCO, board_pose(*FLOOR, turn), rig) for turn in (0, 40, 80)]
    held = placed(CHARUCO, board_pose(FLOOR[0], (1, -0.3, 0)), rig)
    up = up_of_board(rig, [*lying, held], options=OPTIONS)
    assert np.allclose(up.direction, (0, -1, 0), atol=EXACT)
    assert "did not lie still: at 1 of 4 instants" in up.doubts[0]
    moving = [placed(CHARUCO, board_pose(FLOOR[0], (np.sin(a), -np.cos(a), 0)), rig) for a in (0.1, 0.3, 0.5)]
    with pytest.raises(ValueError, match="at 3 instants at most 1 of its normals agree"):
        up_of_board(rig, moving, options=OPTIONS)
    stood = up_of_board(rig, [replace(held, cameras=("cam01",))] * 3, options=OPTIONS)
    assert "degrees off the cameras' own" in stood.doubts[0]
    line = Located(np.arange(7), corners_of(CHARUCO, board_pose(*FLOOR))[:7], rig.names)
    with pytest.raises(ValueError, match="no instant shows enough of it"):
        up_of_board(rig, [line], options=OPTIONS)


# Up, by the cameras


def test_up_by_cameras_is_not_tilted_by_looking_down():
    side = Rig(
        tuple(
            replace(camera, camera_from_world=look_at((x, -2.0, -3.0), (0, 0, 0)))
            for camera, x in zip(room(4).cameras, (-2.0, -0.7, 0.6, 2.1), strict=True)
        ),
        "cameras on one side that look down by 30 degrees",
    )
    up = up_of_cameras(side)
    assert np.allclose(up.direction, (0, -1, 0), atol=EXACT)
    assert not up.doubts
    elsewhere, turn = turned(side, (0.0, 0.0, 0.5), 2.0)
    assert np.allclose(up_of_cameras(elsewhere).direction, turn @ (0, -1, 0), atol=EXACT)


def test_cameras_that_are_held_anyhow_tell_no_up():
    rig = room(4)
    flipped = Rig(tuple(one.turned(2 * (i % 2)) for i, one in enumerate(rig.cameras)), "every other upside down")
    with pytest.raises(ValueError, match="up directions cancel each other"):
        up_of_cameras(flipped)
    rolls = [np.eye(4), np.eye(4)]
    for roll, angle in zip(rolls, (0.3, -0.3), strict=True):
        roll[:3, :3] = cv2.Rodrigues(np.array([0, 0, angle]))[0]
    askew = (replace(c, camera_from_world=rolls[i % 2] @ c.camera_from_world) for i, c in enumerate(rig.cameras))
    assert "doubtful: they are rolled about it by 14 degrees" in up_of_cameras(Rig(tuple(askew), "askew")).doubts[0]


def test_up_goes_into_rig_json_only_where_it_is_known(tmp_path):
    rig = room(3)
    rig.save(tmp_path / "rig.json")
    assert '"up"' not in (tmp_path / "rig.json").read_text()
    assert load_rig(tmp_path).up is None
    replace(rig, up=(0.0, -0.6, 0.8), metric=True).save(tmp_path / "rig.json")
    loaded = load_rig(tmp_path).select(["cam01", "cam02"])
    assert (loaded.up, loaded.metric) == ((0.0, -0.6, 0.8), True)
    with pytest.raises(ValueError, match="up must be a unit vector"):
        replace(rig, up=(0.0, 1.0, 1.0))


# Descriptions


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "chess"}, "kind must be one of charuco, apriltag, but is 'chess'"),
        ({"columns": 1}, "columns and rows must be 2 to 100, but are 1 and 5"),
        ({"columns": 7.5}, "columns must be a whole number, but is 7.5"),
        ({"square": 0.02}, "square must be the side of a square in metres, greater than marker"),
        ({"marker": 0}, "marker must be the side of a marker in metres, but is 0"),
        ({"gap": 0.01}, "a board of kind charuco has no gap; its sizes are marker and square"),
        ({"dictionary": "6X6"}, "dictionary must be one of 4X4_100.*but is '6X6'"),
        ({"dictionary": "4X4_50", "columns": 20, "rows": 20}, "has 200 markers, but the dictionary 4X4_50 only 50"),
        ({"name": "dance"}, r"unknown key 'name'; .*above \[board\]"),
        ({"marker": None}, "a board needs marker, too"),
        ({"legacy": 1}, "legacy must be true or false"),
    ],
)
def test_boards_that_cannot_be_are_named(change, message):
    table = {"kind": "charuco", "columns": 8, "rows": 5, "square": 0.04, "marker": 0.03, **change}
    with pytest.raises(ValueError, match=message):
        Board.from_table({key: value for key, value in table.items() if value is not None})


def test_a_table_describes_a_board():
    table = {"kind": "charuco", "columns": 8, "rows": 5, "square": 0.12, "marker": 0.09}
    assert Board.from_table(table) == CHARUCO
    assert CHARUCO.dictionary == "5X5_100"
    single = Board.from_table({"kind": "apriltag", "columns": 1, "rows": 1, "marker": 1})
    assert np.array_equal(single.points, [[0, 0], [1, 0], [1, 1], [0, 1]])
    with pytest.raises(ValueError, match="gap must be the distance between two tags"):
        Board.from_table({"kind": "apriltag", "columns": 2, "rows": 1, "marker": 1})


@pytest.mark.parametrize(
    "table",
    [
        {"cameras": ["a", "b"]},
        {"cameras": ["a", "a"], "metres": 1},
        {"cameras": "ab", "metres": 1},
        {"cameras": ["a", "b"], "metres": 0},
        {"cameras": ["a", "b"], "metres": 1, "feet": 3},
    ],
)
def test_distances_that_cannot_be_are_shown_what_they_should_be(table):
    with pytest.raises(ValueError, match="distance must be between two cameras, as"):
        Distance.from_table(table)
