"""Offsets by content: balls on smooth ways, seen by cameras all round at times that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sync.content import Activity, Content, Offset, Window, find_offsets
from sync.content.agreement import BLOCKS
from sync.content.offsets import MOST_SCATTER, _combined, _scatter
from tests.support.balls import WIDTH, camera_pose, discs, pixels_of

INSTANTS, REACH = 120, 8


def seen_by(number: int, count: int, times: np.ndarray, *, lost: tuple[int, ...] = ()) -> Activity:
    """What moves in the pictures of a camera that films at these times, in instants: where balls were and are."""
    moving = np.zeros((len(times), len(pixels_of()[0])), np.float32)
    flow = np.zeros((*moving.shape, 2), np.float32)
    for disc, middle in discs(number, count, times):
        swept = disc[1:] | disc[:-1]
        moving[1:][swept] = 1
        flow[1:][swept] = np.repeat(np.diff(middle, axis=0), swept.sum(axis=1), axis=0)
    there = np.arange(len(times)) > 0
    there[list(lost)] = False
    moving[list(lost)] = 0
    turn, centre = camera_pose(number, count)
    return _activity(moving, flow, there, centre, (turn.T @ pixels_of()).T)


def _activity(
    moving: np.ndarray, flow: np.ndarray, there: np.ndarray, centre: np.ndarray, rays: np.ndarray
) -> Activity:
    instants, cells = np.nonzero(moving)
    shares = moving[instants, cells]
    return Activity(there, instants, cells, shares, flow[instants, cells], moving.shape[1], centre, rays, WIDTH)


def _moving_at(own: Activity, moving: np.ndarray) -> Activity:
    """A camera as it stands, if this moved in its pictures, float32 [T, P], each cell by chance."""
    flow = np.random.default_rng(1).normal(size=(*moving.shape, 2)).astype(np.float32)
    assert own.centre is not None
    assert own.rays is not None
    return _activity(moving, flow, np.arange(len(moving)) > 0, own.centre, own.rays)


def rig(count: int, late: dict[int, float] | None = None) -> dict[str, Activity]:
    """Cameras of which some show what the others show so many instants later."""
    times = np.arange(INSTANTS, dtype=float)
    return {f"cam{number}": seen_by(number, count, times + (late or {}).get(number, 0.0)) for number in range(count)}


@pytest.mark.parametrize("count", [3, 6, 12])
def test_cameras_in_step_are_told_to_be(count):
    offsets = find_offsets(rig(count), REACH)
    assert len(offsets) == count
    for offset in offsets.values():
        assert offset.decided
        assert not offset.lies
        assert abs(offset.instants) < 0.2


@pytest.mark.parametrize("late", [-5, -2, -1, 1, 2, 5])
def test_a_camera_that_is_frames_off_is_named_and_no_other(late):
    for number in (0, 3):
        offsets = find_offsets(rig(6, {number: late}), REACH)
        assert [name for name, offset in offsets.items() if offset.lies] == [f"cam{number}"]
        assert offsets[f"cam{number}"].instants == pytest.approx(late, abs=0.25)


@pytest.mark.parametrize("late", [-2, 1, 5])
def test_a_liar_among_few_draws_nobody_along(late):
    """Of two seconds that few cameras see, who lies may remain untold, but nobody else is named."""
    for number in range(4):
        seen = {name: _first(own, 50) for name, own in rig(4, {number: late}).items()}
        offsets = find_offsets(seen, REACH)
        assert {name for name, offset in offsets.items() if offset.lies} <= {f"cam{number}"}


@pytest.mark.parametrize("late", [-17, 14, 20])
def test_who_is_farther_off_than_is_looked_for_is_neither_confirmed_nor_given_another_number(late):
    for number in (0, 4):
        seen = {name: _first(own, 50) for name, own in rig(6, {number: late}).items()}
        offsets = find_offsets(seen, REACH)
        assert not any(offset.lies for offset in offsets.values())
        assert not offsets[f"cam{number}"].decided


def _first(own: Activity, instants: int) -> Activity:
    return own.at(np.arange(instants))


def test_several_cameras_may_be_off_by_frames_of_their_own():
    offsets = find_offsets(rig(7, {1: 2, 4: -3}), REACH)
    assert {name: round(offset.away) for name, offset in offsets.items() if offset.lies} == {"cam1": 2, "cam4": -3}


@pytest.mark.parametrize("liars", [(0, 1), (2, 5), (1, 4)])
def test_two_of_six_that_lie_alike_are_named(liars):
    offsets = find_offsets(rig(6, dict.fromkeys(liars, 3.0)), REACH)
    assert {name: round(own.away) for name, own in offsets.items() if own.lies} == {f"cam{one}": 3 for one in liars}


@pytest.mark.parametrize("late", [-3, 1, 4])
def test_where_everything_moves_at_all_times_its_speed_tells(late):
    times = np.arange(80, dtype=float)
    seen = {f"cam{number}": drifting(number, 5, times + late * (number == 2)) for number in range(5)}
    for name, offset in find_offsets(seen, REACH).items():
        assert offset.instants == pytest.approx(late if name == "cam2" else 0, abs=0.1)
        assert offset.lies == (name == "cam2")
    still = {name: replace(own, flow=0 * own.flow) for name, own in seen.items()}
    assert not any(offset.decided for offset in find_offsets(still, REACH).values())


def drifting(number: int, count: int, times: np.ndarray) -> Activity:
    """A cloud as deep as the middle, which fills the picture and goes to and fro."""
    turn, centre = camera_pose(number, count)
    pixels = pixels_of()
    rates, phases = np.random.default_rng(9).uniform(0.2, 0.9, (2, 3, 4))
    steps = 0.02 * np.sin(rates * times[:, None, None] + 9 * phases).sum(axis=2)  # [T, 3]
    depth = np.linalg.norm(centre) / pixels[2, 0]
    x, y, z = depth * pixels[:, None, :] + (turn @ steps.T)[:, :, None]  # [T, P] each
    flow = np.stack([pixels[2, 0] * x / z - pixels[0], pixels[2, 0] * y / z - pixels[1]], axis=-1)
    moving = np.ones(flow.shape[:2], np.float32)
    return _activity(moving, flow, np.ones(len(times), bool), centre, (turn.T @ pixels).T)


def test_instants_are_chosen_as_from_a_table():
    own = rig(3)["cam1"]
    rows = np.array([5, -1, 5, 0, 119, 3])
    found, whole = own.at(rows), _table(own)
    assert np.array_equal(_table(found), np.where(rows[:, None] >= 0, whole[rows], 0))
    assert np.array_equal(found.there, np.where(rows >= 0, own.there[rows], False))
    assert np.array_equal(_table(own.at(np.arange(INSTANTS))), whole)


def _table(own: Activity) -> np.ndarray:
    table = np.zeros((len(own.there), own.count))
    table[own.instants, own.cells] = own.shares
    return table


@pytest.mark.parametrize("late", [-0.4, 0.3, 0.5])
def test_parts_of_a_frame_are_measured_and_no_lie_where_the_times_say_so(late):
    offset = find_offsets(rig(6, {2: late}), REACH)["cam2"]
    assert offset.instants == pytest.approx(late, abs=0.15)
    expected = find_offsets(rig(6, {2: 1 + late}), REACH, {"cam2": 1 + late})["cam2"]
    assert abs(expected.away) < 0.2
    assert not expected.lies


def test_the_order_of_cameras_hardly_matters():
    seen = rig(5, {1: 1})
    again = find_offsets(dict(reversed(seen.items())), REACH)
    for name, offset in find_offsets(seen, REACH).items():
        assert again[name].instants == pytest.approx(offset.instants, abs=0.1)
        assert again[name].lies == offset.lies


def test_lost_frames_are_no_motion_and_no_rest():
    seen = rig(6, {2: 1})
    seen["cam4"] = seen_by(4, 6, np.arange(INSTANTS, dtype=float), lost=(20, 21, 60, 61, 62, 63, 100))
    offsets = find_offsets(seen, REACH)
    assert [name for name, offset in offsets.items() if offset.lies] == ["cam2"]


def test_who_sees_nothing_move_is_not_judged():
    seen = rig(4)
    nothing = np.zeros((INSTANTS, seen["cam3"].count), np.float32)
    seen["cam3"] = _moving_at(seen["cam3"], nothing)
    assert set(find_offsets(seen, REACH)) == {"cam0", "cam1", "cam2"}
    still = {name: _moving_at(own, nothing) for name, own in seen.items()}
    assert find_offsets(still, REACH) == {}
    assert find_offsets({}, REACH) == {}


def test_motion_that_no_other_camera_sees_decides_nothing():
    rng = np.random.default_rng(0)
    seen = rig(5)
    noise = (rng.random((INSTANTS, seen["cam0"].count)) < 0.002).astype(np.float32)
    seen["cam0"] = _moving_at(seen["cam0"], noise)
    offsets = find_offsets(seen, REACH)
    assert not any(offset.lies for offset in offsets.values())
    assert not offsets["cam0"].decided


@pytest.mark.parametrize("share", [0.0005, 0.01, 0.5, 1.0])
def test_whatever_moves_figures_are_finite(share):
    rng = np.random.default_rng(7)
    for instants in (4, 9, 17):
        seen = {}
        for name, own in rig(3).items():
            moving = (rng.random((instants, own.count)) < share).astype(np.float32)
            seen[name] = _moving_at(own, moving)
        for offset in find_offsets(seen, REACH).values():
            assert np.isfinite([offset.instants, offset.error, offset.clear]).all()


def test_pictures_that_agree_nowhere_tell_nothing():
    levels = np.zeros((2 * REACH + 1, BLOCKS))
    for told in ([(levels, Offset(1.0, 0.1))], [(levels - 0.1, Offset(1.0, 0.1)), (levels, Offset(2.0, 0.3))]):
        own = _combined(told, REACH)
        assert own.clear == 0
        assert own.by_chance
        assert np.isfinite([own.instants, own.error]).all()


def test_two_cameras_do_not_tell_how_much_right_ones_scatter():
    """One of them is the median; whether the other is off by chance only a third could tell."""
    two = {0: Offset(0.0, 0.2), 1: Offset(0.3, 0.2)}
    assert _scatter(two) == MOST_SCATTER
    assert 1 < _scatter(two | {2: Offset(-0.2, 0.2)}) < MOST_SCATTER
    seen = {name: own for name, own in rig(6, {1: 3}).items() if name in {"cam0", "cam1"}}
    assert any(offset.lies for offset in find_offsets(seen, REACH).values())


def test_a_whole_frame_that_is_not_sure_is_no_confirmation():
    for away in np.linspace(-1.5, 1.5, 31):
        for error in np.linspace(0.02, 0.6, 30):
            offset = Offset(float(away), float(error))
            assert not (abs(away) >= 0.99 and offset.decided and not offset.lies)
    assert Offset(0.1, 0.3).decided
    assert not Offset(0.8, 0.28).lies
    assert not Offset(0.8, 0.28).decided


def test_the_stretch_that_says_most_against_a_camera_is_told():
    right, wrong, unsure = Offset(0.1, 0.1), Offset(2.1, 0.1), Offset(4.0, 2.0)
    windows = (Window(0, 99, {"a": right, "b": unsure}), Window(100, 199, {"a": wrong, "c": right}))
    content = Content(("a", "b", "c", "d"), windows)
    assert content.worst("a") == (windows[1], wrong)
    assert content.worst("b") is None
    assert content.worst("c") == (windows[1], right)
    assert content.undecided == ("b", "d")
