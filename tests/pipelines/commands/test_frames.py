"""Frames that are asked for are there."""

from __future__ import annotations

import doctest

import pytest

from pipelines.commands import frames
from pipelines.commands.frames import check_frame, frames_of


def test_examples_in_docstrings():
    assert doctest.testmod(frames).failed == 0


def test_ranges_within_the_scene():
    assert frames_of(5, (0, None)) == range(5)
    assert frames_of(5, (1, 5)) == range(1, 5)
    check_frame(5, 4)


@pytest.mark.parametrize(("asked", "text"), [((3, 6), "3:6"), ((5, None), "5:5"), ((2, 2), "2:2"), ((-1, 2), "-1:2")])
def test_ranges_that_the_scene_lacks(asked, text):
    with pytest.raises(ValueError, match=f"the scene has frames 0 to 4, but {text} is asked for"):
        frames_of(5, asked)


@pytest.mark.parametrize("frame", [-1, 5])
def test_frames_that_the_scene_lacks(frame):
    with pytest.raises(ValueError, match=f"frames 0 to 4, but frame {frame} is asked for"):
        check_frame(5, frame)
