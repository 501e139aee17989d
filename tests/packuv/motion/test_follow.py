"""Following a camera: what moves is where filmed pictures changed, tOF how far the rendered motion is from theirs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from packuv.motion import Follower

HEIGHT, WIDTH = 96, 160
RNG = np.random.default_rng(11)
WALL = cv2.GaussianBlur(RNG.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), (0, 0), 2)
BALL = cv2.GaussianBlur(RNG.integers(0, 256, (40, 40, 3), np.uint8), (0, 0), 1.5)


def picture(x: int) -> np.ndarray:
    """A textured square at column x, before a wall."""
    seen = WALL.copy()
    seen[30:70, x : x + 40] = BALL
    return seen


def follow(filmed, rendered):
    follower = Follower()
    return [follower.step(a, b) for a, b in zip(filmed, rendered, strict=True)]


def test_the_first_picture_has_nothing_to_be_compared_with():
    assert follow([WALL], [WALL]) == [None]


def test_what_moves_is_where_the_square_was_and_is():
    _, change = follow([picture(40), picture(44)], [picture(40), picture(44)])
    assert change is not None
    assert change.tof_px == 0
    place = np.zeros((HEIGHT, WIDTH), bool)
    place[30:70, 40:84] = True
    assert change.moving[place].mean() > 0.95
    assert change.moving[~place].mean() < 0.2  # masks are grown by three pixels
    assert not change.moving[:, 100:].any()


def test_a_still_render_lacks_the_motion_of_the_square():
    _, change = follow([picture(40), picture(44)], [picture(40)] * 2)
    assert change is not None
    share = 40 * 44 / (HEIGHT * WIDTH)
    assert change.tof_px == pytest.approx(4 * share, rel=0.3)  # flow at borders is smooth


def test_in_a_still_scene_nothing_moves():
    _, change = follow([WALL] * 2, [WALL] * 2)
    assert change is not None
    assert not change.moving.any()
    assert change.tof_px == 0


def test_only_what_was_filmed_says_what_moves():
    _, change = follow([WALL] * 2, [picture(40), picture(44)])
    assert change is not None
    assert not change.moving.any()
    assert change.tof_px > 0.1
