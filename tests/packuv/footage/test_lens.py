"""Lenses in a scene's header: what stands beside their cameras gives every one of them back."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.footage.lens import LensCamera, abridged, unabridged, undistorted_camera

NAMES = ("a", "b", "c")
COUNTS = {"straight": 0, "distorted": 5, "rational": 8, "fisheye": 4}
FLOATS = st.floats(-0.01, 0.01)


@st.composite
def lens(draw: st.DrawFn, name: str) -> LensCamera:
    """Of some kind, with or without gains and shading, anywhere."""
    kind = draw(st.sampled_from(sorted(COUNTS)))
    pose = np.eye(4)
    pose[:3, 3] = draw(st.tuples(*[st.floats(-1e3, 1e3)] * 3))
    pinhole = PinholeCamera(name, 64, 48, draw(st.floats(40, 90)), draw(st.sampled_from([60, 61.5])), 31.0, 24, pose)
    return LensCamera(
        pinhole,
        tuple(draw(FLOATS) for _ in range(COUNTS[kind])),
        draw(st.sampled_from([(1.0, 1.0, 1.0), (0.9, 1.0, 1.1)])),
        draw(st.one_of(st.just((0.0, 0.0)), st.tuples(FLOATS, FLOATS))),
        kind == "fisheye",
    )


LENSES = st.tuples(*map(lens, NAMES))


def text(lenses: Any) -> str:
    return json.dumps([item.to_json() for item in lenses], sort_keys=True)


@given(LENSES, st.sampled_from([1.0, 0.83]), st.sampled_from([1, 2]))
def test_lenses_beside_their_cameras_come_back(lenses: tuple[LensCamera, ...], zoom: float, scale: int) -> None:
    cameras = [replace(item.pinhole, fx=zoom * item.pinhole.fx) for item in lenses]
    cameras = [camera.scaled(scale * camera.width, scale * camera.height) for camera in cameras]
    entries = json.loads(json.dumps(abridged(lenses, cameras)))
    found = unabridged(entries, cameras, "lenses")
    assert tuple(found) == NAMES
    assert text(found.values()) == text(lenses)
    for entry, item in zip(entries, lenses, strict=True):
        assert "camera_from_world" not in entry
        assert ("width" in entry) == (scale > 1)
        assert ("fx" in entry) == (scale > 1 or zoom < 1)
        assert ("distortion" in entry) == bool(item.distortion)
    assert text(unabridged([item.to_json() for item in lenses], cameras, "lenses").values()) == text(lenses)  # older


def test_of_a_distorted_lens_only_focal_lengths_differ_from_its_undistorted_twin() -> None:
    for own, said in (((), set()), ((-0.08, 0.01, 0.001, 0.0), {"fx", "fy", "distortion"})):
        bent = LensCamera(PLAIN[0], own)
        entries = abridged([bent], [undistorted_camera(bent)])
        assert [set(entry) for entry in entries] == [{"name", *said}]


PLAIN = tuple(PinholeCamera(name, 64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4)) for name in NAMES)


def test_a_lens_that_does_nothing_has_nothing_to_say() -> None:
    assert abridged(map(LensCamera, PLAIN), PLAIN) == [{"name": name} for name in NAMES]
    assert text(unabridged([{"name": "b"}], PLAIN, "lenses").values()) == text([LensCamera(PLAIN[1])])


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ({"a": 1}, "lenses must be a list"),
        ([1], "lenses: an entry must be an object"),
        ([{}], "lenses: an entry needs the field 'name'"),
        ([{"name": 3}], "lenses: a name must be printable text"),
        ([{"name": "d"}], "each once, but names 'd', which is none of them"),
        ([{"name": "a"}, {"name": "a"}], "each once, but names 'a', which it named before"),
        ([{"name": "a", "distortion": [0.1]}], "camera 'a': a lens has one of"),
        ([{"name": "a", "fisheye": True}], "camera 'a': a fisheye lens has 4 coefficients, not 0"),
        ([{"name": "a", "camera_from_world": []}], "camera 'a': camera_from_world must hold 4 entries"),
        ([{"name": "a", "gains": [1, 1, 0]}], "camera 'a': gains must be three positive numbers"),
    ],
)
def test_entries_that_contradict_the_cameras_are_refused(entries: Any, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        unabridged(entries, PLAIN, "lenses")


def test_cameras_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="must differ in name, but 3 have 2 names"):
        unabridged([], (*PLAIN[:2], replace(PLAIN[2], name="a")), "lenses")
