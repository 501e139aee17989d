"""Light and exposures are found again in pictures that were made with them, and none where nothing changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from packuv.colour import GAMMA, OFFSET
from packuv.footage import FrameReader, Light, LightOptions, measure_light
from packuv.footage.light import STEPS, common, light_of, packed, unpacked
from packuv.footage.ratios import HELD, PARTS, Ratios, measure_ratios
from tests.support.planes import write_planes

INSTANTS, HEIGHT, WIDTH = 24, 90, 160
NOISE = 1.5
"""Grey levels of 255, deviation"""
NEAR = 0.002
"""Share of the light by which an instant may be off: a quarter of a grey level"""
STEADY = np.zeros((INSTANTS, 3))
NAMES = [f"cam{number:02d}" for number in range(8)]


def noise(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


@cache
def room(seed: int) -> np.ndarray:
    """float64 [H, W, 3], sRGB: soft blobs of all tones, a clipped lamp, and a dark corner."""
    rng, (y, x) = noise(seed), np.mgrid[0:HEIGHT, 0:WIDTH]
    picture = np.zeros((HEIGHT, WIDTH, 3))
    for _ in range(12):
        (row, column), size = rng.uniform((0, 0), (HEIGHT, WIDTH)), rng.uniform(10, 50)
        picture += rng.uniform(0.1, 0.5, 3) * np.exp(-((y - row) ** 2 + (x - column) ** 2) / (2 * size**2))[..., None]
    picture = 0.15 + 0.6 * picture / picture.max()
    picture[10:18, 10:22] = 1.3
    picture[-12:, -30:] = 0.03
    return picture


Paint = Callable[[np.ndarray, int], None]


def film(logs: np.ndarray, seed: int, paint: Paint | None = None) -> Callable[[int], np.ndarray]:
    """A camera's pictures in light of these logarithms, [T, 3]; `paint` draws what moves, before light shines on it."""

    def shot(instant: int) -> np.ndarray:
        picture = room(seed).copy()
        if paint:
            paint(picture, instant)
        lit = (picture + OFFSET) * np.exp(logs[instant] / GAMMA) - OFFSET
        levels = 255 * np.clip(lit, 0, 1) + noise(1000 * seed + instant).normal(0, NOISE, picture.shape)
        return np.rint(np.clip(levels, 0, 255)).astype(np.uint8)

    return shot


def crowd(picture: np.ndarray, instant: int) -> None:
    """Covers some 40 % at each instant, brighter and brighter, elsewhere at each."""
    rng = noise(instant)
    for _ in range(9):
        row, column = rng.integers(0, HEIGHT - 30), rng.integers(0, WIDTH - 36)
        picture[row : row + 30, column : column + 36] = rng.uniform(0.3, 0.5, 3) + 0.012 * instant


def ratios(
    logs: Mapping[str, np.ndarray], paint: Paint | None = None, *, absent: Mapping[str, range] | None = None
) -> dict[str, Ratios]:
    """Of cameras that film other sides of the room; `absent` tells at which instants one has no picture."""
    found = {}
    for seed, (name, own) in enumerate(logs.items()):
        frames = np.arange(len(own))
        frames[list((absent or {}).get(name, ()))] = -1
        found[name] = measure_ratios(film(own, seed, paint), frames, width=WIDTH, samples=15)
    return found


def fading() -> np.ndarray:
    """float64 [T, 3] of mean 0: from +4 to -4 %, blue faster than red, with some flicker."""
    fall = np.linspace(0.04, -0.04, INSTANTS)[:, None] * (0.7, 1.0, 1.4)
    logs = fall + 0.01 * np.sin(np.arange(INSTANTS) * 2.1)[:, None]
    return np.asarray(logs - logs.mean(axis=0))


def jump(factor: float = 1.25, at: int = 15) -> np.ndarray:
    """float64 [T, 3] of mean 0: a camera's exposure that changes for good."""
    logs = np.where(np.arange(INSTANTS) < at, 0, np.log(factor))[:, None] * np.ones(3)
    return np.asarray(logs - logs.mean(axis=0))


def measured(found: Mapping[str, Ratios], fitted: list[str] | None = None) -> Light:
    return light_of(found, fitted or list(found), LightOptions())


@pytest.fixture(scope="module")
def lit() -> dict[str, Ratios]:
    """All cameras in fading light; one of them jumps."""
    logs = dict.fromkeys(NAMES, fading())
    return ratios({**logs, "cam03": fading() + jump()})


def test_light_and_a_cameras_jump_are_told_apart(lit):
    light = measured(lit)
    assert np.abs(light.light - fading()).max() < NEAR
    assert set(light.exposures) == {"cam03"}
    assert np.abs(light.exposures["cam03"] - jump()).max() < NEAR
    both = light.of(["cam03", "cam00"], INSTANTS)
    assert np.allclose(both[:, 1], light.light)
    assert np.allclose(both[:, 0] - both[:, 1], light.exposures["cam03"], atol=1e-6)


def test_means_over_the_instants_are_1(lit):
    light = measured(lit)
    for logs in (light.light, *light.exposures.values()):
        assert np.abs(logs.astype(np.float64).mean(axis=0)).max() < 1 / STEPS


def test_cameras_that_are_not_fitted_tell_no_light_but_have_exposures(lit):
    without = measured({name: ratio for name, ratio in lit.items() if name != "cam03"})
    light = measured(lit, [name for name in NAMES if name != "cam03"])
    assert np.array_equal(light.light, without.light)
    assert set(light.exposures) == {"cam03"}


def test_steady_light_is_no_light():
    light = measured(ratios(dict.fromkeys(NAMES, STEADY)))
    assert light.steady
    assert light.facts["steady"]
    assert light.facts["spread"] < LightOptions().least_light
    assert light.of(NAMES, INSTANTS) is None


@pytest.mark.parametrize("logs", [STEADY, fading()], ids=["steady", "fading"])
def test_a_crowd_changes_nothing(logs):
    error = measured(ratios(dict.fromkeys(NAMES[:4], logs), crowd)).light - logs
    assert np.sqrt((error**2).mean()) < NEAR / 2
    assert np.abs(error).max() < 2 * NEAR  # there are instants at which few steady pixels are left


def test_what_moves_everywhere_tells_nothing():
    def shuffled(picture: np.ndarray, instant: int) -> None:
        picture[:] = noise(instant).uniform(0.15, 0.8, (HEIGHT // 10, WIDTH // 10, 3)).repeat(10, 0).repeat(10, 1)

    light = measured(ratios(dict.fromkeys(NAMES[:3], fading()), shuffled))
    assert light.steady
    assert light.facts["unknown"] == NAMES[:3]


def test_a_cut_to_another_scene_is_no_light():
    def cut(picture: np.ndarray, instant: int) -> None:
        if instant >= 16:
            picture[:] = room(77)[::-1, ::-1] ** 0.5

    light = measured(ratios(dict.fromkeys(NAMES[:4], STEADY), cut))
    assert np.abs(light.light).max() < 0.01
    assert not light.exposures


def test_cameras_that_start_late_or_miss_pictures_agree_with_the_others():
    absent = {"cam01": range(14), "cam02": range(5, 9), "cam04": range(INSTANTS)}
    light = measured(ratios(dict.fromkeys(NAMES[:5], fading()), absent=absent))
    assert np.abs(light.light - fading()).max() < NEAR
    assert not light.exposures
    assert light.facts["unknown"] == ["cam04"]


def test_one_camera_has_nobody_to_confirm_light():
    light = measured(ratios({"cam00": fading()}))
    assert not light.light.any()
    assert light.facts["left"] is None
    assert np.abs(light.exposures["cam00"] - fading()).max() < NEAR


def test_cameras_out_of_phase_have_no_light_in_common():
    """Mains flicker meets each camera's shutter at another time: exposures, whose sum with light is what counts."""
    phases = np.linspace(0, 2 * np.pi, 9)[:8]
    waves = {
        name: np.asarray(0.05 * np.sin(2.4 * np.arange(INSTANTS) + phase)[:, None] * np.ones(3))
        for name, phase in zip(NAMES, phases, strict=True)
    }
    light = measured(ratios(waves))
    both = light.of(NAMES, INSTANTS)
    for column, wave in enumerate(waves.values()):
        assert np.abs(both[:, column] - (wave - wave.mean(axis=0))).max() < NEAR
    assert not light.light.any()


def test_a_shadow_over_half_the_picture_is_no_exposure():
    def shadow(picture: np.ndarray, instant: int) -> None:
        picture[:, : WIDTH // 2] *= 1 - 0.002 * instant

    light = measured(ratios(dict.fromkeys(NAMES[:4], STEADY)) | {"cam05": ratios({"x": STEADY}, shadow)["x"]})
    assert light.steady


def test_what_leaves_a_black_stage_takes_no_light_along():
    """A door of one colour slides away before black, as a person leaves: the place goes dark, the light does not."""

    def stage(picture: np.ndarray, instant: int) -> None:
        standing = picture[:30, :60].copy()
        picture[:] = 0
        picture[:30, :60] = standing
        gone = max(0, 4 * (instant - INSTANTS // 2))
        picture[20:, 70 + gone : 130] = (0.35, 0.45, 0.4)

    bare = ratios(dict.fromkeys(NAMES[:4], STEADY), stage)
    for measured_ratio in bare.values():
        assert np.abs(measured_ratio.whole[np.isfinite(measured_ratio.whole)]).max() < 0.1
    assert measured(bare).steady


def test_lamps_that_go_out_are_light():
    logs = STEADY.copy()
    logs[10:12] = -4.5
    light = measured(ratios(dict.fromkeys(NAMES[:3], logs)))
    assert (light.light[10:12] < light.light[[9, 12]] - 3).all()


def test_one_instant_is_steady():
    assert measured(ratios({name: np.zeros((1, 3)) for name in NAMES[:3]})).steady


def test_a_measurement_that_is_cut_off_goes_on_to_the_same(monkeypatch, tmp_path):
    monkeypatch.setattr("packuv.footage.ratios.KEPT", 5)
    monkeypatch.setattr("packuv.footage.ratios.HELD", 4)  # else all pictures are read first
    shot, frames = film(fading(), 0), np.arange(INSTANTS)
    frames[7] = -1
    seen: list[int] = []

    def dies(instant: int) -> np.ndarray:
        seen.append(instant)
        if len(seen) == 3 + 12:
            raise KeyboardInterrupt
        return shot(instant)

    def counts(instant: int) -> np.ndarray:
        seen.append(instant)
        return shot(instant)

    whole = measure_ratios(shot, frames, width=WIDTH, samples=3)
    with pytest.raises(KeyboardInterrupt):
        measure_ratios(dies, frames, width=WIDTH, samples=3, kept=tmp_path)
    seen.clear()
    resumed = measure_ratios(counts, frames, width=WIDTH, samples=3, kept=tmp_path)
    assert seen[:3] == [0, 12, 23]  # what stands still
    assert seen[3:] == [t for t in range(11, 23) if t != 12]  # ten are kept
    assert np.array_equal(resumed.whole, whole.whole, equal_nan=True)
    assert np.array_equal(resumed.parts, whole.parts, equal_nan=True)


def test_long_recordings_are_measured_as_short_ones_are(monkeypatch):
    frames = np.arange(INSTANTS)
    short = measure_ratios(film(fading(), 1), frames, width=WIDTH, samples=9)
    monkeypatch.setattr("packuv.footage.ratios.HELD", 3)
    long = measure_ratios(film(fading(), 1), frames, width=WIDTH, samples=9)
    assert HELD > INSTANTS
    assert np.array_equal(short.whole, long.whole)
    assert np.array_equal(short.parts, long.parts)


@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.integers(1, 9))
def test_what_cameras_have_in_common_does_not_depend_on_their_levels(seed, cameras, instants):
    rng = noise(seed)
    own = rng.normal(0, 0.02, (instants, 1, 3)) + np.zeros((1, cameras, 1))
    level = rng.normal(0, 0.3, (1, cameras, 3))
    light = common(own + level)
    assert np.allclose(light, own[:, 0] - own[:, 0].mean(axis=0), atol=1e-9)
    assert np.allclose(light.mean(axis=0), 0, atol=1e-12)


def test_pictures_are_read_from_videos_once(tmp_path: Path):
    """Two cameras in 8-bit grey that gets darker, one of which misses an instant."""
    logs, reads = fading()[:6, 1:2], []

    class Counting(FrameReader):
        def read(self, camera: str, frame: int) -> np.ndarray:
            reads.append((camera, frame))
            return super().read(camera, frame)

    for seed, name in enumerate(NAMES[:2]):
        shots = map(film(np.repeat(logs, 3, axis=1), seed), range(6))
        grey = [shot[..., 1] for shot in shots]
        frames = [
            [16 + np.rint(g * (219 / 255)).astype(np.uint8), *[np.full(g.shape, 128, np.uint8)] * 2] for g in grey
        ]
        write_planes(tmp_path / f"{name}.mkv", "yuv444p", frames, (1, 1, 2, 1))
    reader = Counting({name: tmp_path / f"{name}.mkv" for name in NAMES[:2]})
    numbers = {"cam00": np.arange(6), "cam01": np.array([0, 1, 2, -1, 4, 5])}
    told: list[float] = []
    light = measure_light(
        reader, numbers, NAMES[:2], LightOptions(), progress=lambda done, total, note="": told.append(done / total)
    )
    assert np.abs(light.light - (logs - logs.mean())).max() < 2 * NEAR  # limited range has coarser steps
    assert len(set(reads)) == len(reads) == 11
    assert told[-1] == 1
    light.save(tmp_path / "light.npz")
    again = Light.load(tmp_path / "light.npz")
    assert np.array_equal(again.light, light.light)
    assert again.exposures.keys() == light.exposures.keys()


def test_instants_beyond_those_measured_are_steady():
    light = Light(np.full((2, 3), 0.1, np.float32), {"a": np.full((2, 3), 0.2, np.float32)})
    both = light.of(["a", "b"], 4)
    assert np.allclose(both[:, :, 0], [[0.3, 0.1], [0.3, 0.1], [0, 0], [0, 0]], atol=1e-6)
    assert np.array_equal(light.of(["b"], 1), light.light[None, :1])
    with pytest.raises(ValueError, match=r"a must be \[2, 3\] as the light is, but is \(3, 3\)"):
        replace(light, exposures={"a": np.zeros((3, 3))})


@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_packed_exposures_come_back(seed, instants):
    logs = (np.rint(noise(seed).normal(0, 1, (instants, 3)) * STEPS) / STEPS).astype(np.float32)
    assert np.array_equal(unpacked(packed(logs), instants, "x"), logs)
    assert np.array_equal(unpacked(packed(logs), instants // 2, "x"), logs[: instants // 2])


@pytest.mark.parametrize("text", [None, 3, "", "@", "AAAA", packed(np.zeros((3, 3)))], ids=repr)
def test_what_is_no_exposure_is_refused(text):
    with pytest.raises(ValueError, match="extra: exposure must be the packed exposure of 4 instants or more"):
        unpacked(text, 4, "extra: exposure")
    with pytest.raises(ValueError, match="within 10 of 0"):
        unpacked(packed(np.full((4, 3), 11.0)), 4, "x")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"width": 8}, "16 px wide"),
        ({"samples": 0}, "a sample"),
        ({"least_light": -1}, "must not be negative"),
        ({"most_left": 0}, r"must lie in \(0, 1\]"),
    ],
)
def test_unusable_options_are_refused(change, said):
    with pytest.raises(ValueError, match=said):
        LightOptions(**change)


def test_parts_are_quarters_of_the_picture():
    found = measure_ratios(film(fading(), 2), np.arange(INSTANTS), width=WIDTH, samples=15)
    assert found.parts.shape == (INSTANTS, PARTS, 3)
    known = found.parts[:, np.isfinite(found.parts).all(axis=(0, 2))]
    level = known - known.mean(axis=0)
    assert np.abs(level - fading()[:, None]).max() < 2 * NEAR
