"""How long a unit of a rig is, and where up is: by a board of known size that cameras see, by distances, or as told.

A board's corners are located by the rig from pictures of one instant. The ratio of a known length to the located one is
the scale; lengths are taken along the board's rows and columns, between the outermost corners that are located, since
these say most. The board's plane tells up where it lies on the floor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calibration.board import Board, Corners
from calibration.multiview import Sightings, locate
from calibration.rig import Rig

ASTRAY_DEG = 45.0
"""Between the board's normal and the cameras' own up: beyond it, the board does not lie on the floor"""
ROLLED_DEG = 5.0
"""By which cameras may be rolled about their axis, by the median, before the up that they tell is doubtful"""
SPREAD_AXES = 0.02
"""Least second eigenvalue of the mean of x x^T of the cameras' horizontal axes x by which they tell a vertical: they
spread by 8 degrees"""


@dataclass(frozen=True)
class ScaleOptions:
    """How a board is looked for and measured."""

    instants: int = 16
    """Instants, spread over the recording, at which it is looked for; while it is not found often enough, twice as many
    each time"""
    most_instants: int = 256
    """After so many, the search is given up"""
    enough: int = 4
    """Instants at which two cameras or more must locate it for the search to end"""
    max_error_px: float = 2.0
    """Distance from where a located corner should be shown at which a sighting of it is dropped"""
    min_angle_deg: float = 2.0
    """Between two rays of a located corner"""
    tolerance: float = 0.02
    """Share by which lengths of one board, other distances or a scale that was given may differ from the scale"""
    lying_deg: float = 2.0
    """By which the normals of a board that lies still may differ"""

    def __post_init__(self) -> None:
        if not 1 <= self.instants <= self.most_instants or self.enough < 1:
            raise ValueError(f"1 <= instants <= most_instants and enough >= 1 must hold, but options are {self}")
        if min(self.max_error_px, self.min_angle_deg, self.tolerance, self.lying_deg) <= 0:
            raise ValueError(f"errors, angles and tolerances must be positive, but options are {self}")


@dataclass(frozen=True)
class Distance:
    """Between the centres of two cameras."""

    cameras: tuple[str, str]
    metres: float

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Distance:
        """What a table of capture.toml says; raises ValueError that shows what it should."""
        names, metres = table.get("cameras"), table.get("metres")
        pair = tuple(map(str, names)) if isinstance(names, list) else ()
        number = metres if isinstance(metres, (int, float)) and not isinstance(metres, bool) else 0.0
        if len(set(pair)) != 2 or len(pair) != 2 or not 0 < number < np.inf or len(table) != 2:
            raise ValueError(
                'distance must be between two cameras, as { cameras = ["cam01", "cam05"], metres = 2.35 }, but is '
                f"{dict(table)}"
            )
        return cls((pair[0], pair[1]), float(number))


@dataclass(frozen=True)
class Located:
    """A board at one instant, where the rig sees it."""

    ids: np.ndarray
    """int64 [K], indices into `Board.points`, ascending"""
    xyz: np.ndarray
    """float64 [K, 3], world, units of the rig"""
    cameras: tuple[str, ...]
    """That see these corners"""


@dataclass(frozen=True)
class Measured:
    """The scale of a rig."""

    metres_per_unit: float
    spread: float
    """Deviation of one length from it, as a share; 0 for a single one"""
    told: str
    """By what, for people"""
    doubts: tuple[str, ...] = ()
    """What a person should look at"""
    figures: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Upward:
    """Where up is."""

    direction: np.ndarray
    """float64 [3], unit, world"""
    told: str
    doubts: tuple[str, ...] = ()


# Scale


def locate_board(rig: Rig, seen: Mapping[str, Corners], *, options: ScaleOptions) -> Located | None:
    """The corners that two cameras or more locate at an instant; None for fewer than 2."""
    ids, camera, pixels = [], [], []
    for index, name in enumerate(rig.names):
        if name in seen:
            ids.append(seen[name].ids)
            camera.append(np.full(len(seen[name].ids), index, np.int32))
            pixels.append(seen[name].pixels)
    if not ids:
        return None
    number, order = np.concatenate(ids), np.argsort(np.concatenate(ids), kind="stable")
    own, point = np.unique(number[order], return_inverse=True)
    given = Sightings(point.astype(np.int32), np.concatenate(camera)[order], np.concatenate(pixels)[order])
    kept, xyz, _ = locate(
        rig, given, max_error_px=options.max_error_px, min_views=2, min_angle_deg=options.min_angle_deg
    )
    if len(xyz) < 2:
        return None
    names = tuple(rig.names[index] for index in np.unique(kept.camera))
    return Located(_named(given, kept, own), xyz, names)


def _named(given: Sightings, kept: Sightings, ids: np.ndarray) -> np.ndarray:
    """Which of `ids` the points of the sightings that were kept are: a camera shows no two corners at one place."""
    rows = {
        (camera, *pixel): point
        for point, camera, pixel in zip(given.point, given.camera, given.pixels.tolist(), strict=True)
    }
    first = kept.starts
    shown = zip(kept.camera[first], kept.pixels[first].tolist(), strict=True)
    named: np.ndarray = ids[[rows[camera, *pixel] for camera, pixel in shown]]
    return named


def measure_board(board: Board, located: Sequence[Located], *, options: ScaleOptions) -> Measured | None:
    """The scale by which a board has its size; None where no two corners of a row or column are located."""
    lengths = np.array([length for one in located for length in _lengths(board, one)])  # [L, 3]
    if not len(lengths):
        return None
    known, ratios, across = lengths[:, 0], lengths[:, 0] / lengths[:, 1], lengths[:, 2] > 0
    scale = _median(ratios, known)
    spread = 1.4826 * _median(np.abs(ratios / scale - 1), known)
    cameras = {name for one in located for name in one.cameras}
    told = f"the {board} ({_counted(len(located), 'instant')}, {_counted(len(cameras), 'camera')})"
    sides = [_median(ratios[own], known[own]) if own.any() else scale for own in (~across, across)]
    doubts = _board_doubts(scale, spread, sides, options.tolerance)
    if len(located) == 1:
        doubts = (*doubts, f"only one instant shows the {board} to two cameras, so nothing confirms the scale by it")
    figures = {"lengths": len(lengths), "instants": len(located), "rows": sides[0], "columns": sides[1]}
    return Measured(scale, spread, told, doubts, figures)


def _lengths(board: Board, one: Located) -> Iterator[tuple[float, float, float]]:
    """Between the outermost located corners of each row, then of each column: known, located, 1 for a column."""
    places = board.points[one.ids]
    for along, which in ((0, 0.0), (1, 1.0)):
        lines = np.round(places[:, 1 - along] / board.marker * 100).astype(np.int64)
        for line in np.unique(lines):
            own = np.flatnonzero(lines == line)
            a, b = own[places[own, along].argmin()], own[places[own, along].argmax()]
            if a != b:
                located = float(np.linalg.norm(one.xyz[a] - one.xyz[b]))
                yield float(np.linalg.norm(places[a] - places[b])), max(located, 1e-12), which


def _board_doubts(scale: float, spread: float, sides: Sequence[float], tolerance: float) -> tuple[str, ...]:
    row, column = sides
    apart = abs(row / column - 1)
    if apart > tolerance:
        return (
            f"the board's rows say that one unit is {row:.4g} m, its columns {column:.4g} m, {apart:.1%} apart: it was "
            "printed longer one way, or square, marker or gap in capture.toml is wrong, or the calibration is",
        )
    if spread > tolerance:
        return (
            f"lengths on the board disagree by {spread:.1%} about a unit of {scale:.4g} m: its corners are seen wrong, "
            "or the calibration is",
        )
    return ()


def measure_distances(rig: Rig, distances: Sequence[Distance], *, options: ScaleOptions) -> Measured:
    """The scale by which cameras have their known distances; raises ValueError for cameras in one place."""
    ratios = []
    for distance in distances:
        a, b = (rig[name].centre for name in distance.cameras)
        apart = float(np.linalg.norm(a - b))
        if apart <= 1e-9 * max(float(np.abs(rig.centres).max()), 1e-12):
            raise ValueError(
                f"{' and '.join(distance.cameras)} are {distance.metres:g} m apart by capture.toml, but stand in one "
                "place by the calibration; name two others"
            )
        ratios.append(distance.metres / apart)
    scale = float(np.median(ratios))
    worst = int(np.argmax(np.abs(np.array(ratios) / scale - 1)))
    doubts: tuple[str, ...] = ()
    if abs(ratios[worst] / scale - 1) > options.tolerance:
        least, most = min(ratios), max(ratios)
        doubts = (
            f"the distances in capture.toml disagree: one unit would be {least:.4g} m by one and {most:.4g} m by "
            f"another, {most / least - 1:.1%} apart; {scale:.4g} m is taken",
        )
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) / scale - 1)))
    between = "; ".join(f"{a} to {b}" for a, b in (distance.cameras for distance in distances[:3]))
    return Measured(scale, spread, f"the known distance of {between}", doubts)


def contradictions(
    rig: Rig, board: Measured | None, distance: Measured | None, *, options: ScaleOptions
) -> Iterator[str]:
    """What else says another scale than the board does, or, without one, than the distances do."""
    best = board or distance
    if best is None:
        return
    if board and distance and abs(distance.metres_per_unit / board.metres_per_unit - 1) > options.tolerance:
        yield (
            f"one unit of the calibration is {board.metres_per_unit:.4g} m by the board, but "
            f"{distance.metres_per_unit:.4g} m by {distance.told}; the board is believed"
        )
    if rig.metric and abs(best.metres_per_unit - 1) > options.tolerance:
        yield (
            f"one unit is a metre by {rig.source}, but {best.metres_per_unit:.4g} m by "
            f"{'the board' if board else best.told}, which is believed"
        )


def scaled(rig: Rig, metres_per_unit: float) -> Rig:
    """The rig in metres."""

    def placed(pose: np.ndarray) -> np.ndarray:
        grown = pose.copy()
        grown[:3, 3] *= metres_per_unit
        return grown

    cameras = (replace(one, camera_from_world=placed(one.camera_from_world)) for one in rig.cameras)
    return replace(rig, cameras=tuple(cameras), metric=True)


# Up


def up_of_board(rig: Rig, located: Sequence[Located], *, options: ScaleOptions) -> Upward:
    """The side to which a board that lies on the floor shows its print.

    Raises ValueError where no instant tells its plane, or where it did not lie still at most instants.
    """
    normals = [normal for one in located if (normal := _normal(rig, one)) is not None]
    if not normals:
        raise ValueError("up = 'board', but no instant shows enough of it to tell its plane; give up otherwise")
    cosines = np.clip(np.array(normals) @ np.array(normals).T, -1, 1)
    still = np.degrees(np.arccos(cosines)) <= options.lying_deg
    agreeing = still[still.sum(axis=1).argmax()]
    if 2 * agreeing.sum() < len(normals):
        raise ValueError(
            f"up = 'board' is for a board that lies on the floor, but at {len(normals)} instants at most "
            f"{agreeing.sum()} of its normals agree within {options.lying_deg:g} degrees; lay it down, or give "
            "up = 'cameras' or a direction"
        )
    direction = _unit(np.array(normals)[agreeing].sum(axis=0))
    doubts = []
    if not agreeing.all():
        doubts.append(
            f"the board did not lie still: at {len(normals) - agreeing.sum()} of {len(normals)} instants its normal is "
            f"more than {options.lying_deg:g} degrees off; up is that of the others"
        )
    own, _ = _vertical(rig)
    away = _angle_deg(direction, own)
    if away > ASTRAY_DEG:
        doubts.append(f"up by the board is {away:.0f} degrees off the cameras' own: does it lie on the floor?")
    told = f"the board on the floor ({_counted(int(agreeing.sum()), 'instant')})"
    return Upward(direction, told, tuple(doubts))


def _normal(rig: Rig, one: Located) -> np.ndarray | None:
    """Of a located board, unit, towards the cameras that see it; None where its corners lie on one line."""
    middle = one.xyz.mean(axis=0)
    spread, axes = np.linalg.svd(one.xyz - middle, full_matrices=False)[1:]
    if len(spread) < 3 or spread[1] < 0.05 * spread[0]:
        return None
    seen = np.mean([rig[name].centre for name in one.cameras], axis=0) - middle
    normal: np.ndarray = axes[2] if axes[2] @ seen > 0 else -axes[2]
    return normal


def up_of_cameras(rig: Rig) -> Upward:
    """The direction about which cameras are not rolled: their pictures' horizontal axes are level.

    Raises ValueError where their own up directions cancel each other.
    """
    direction, sure = _vertical(rig)
    if not sure:
        raise ValueError(
            "up = 'cameras' needs cameras that are held upright, but their up directions cancel each other; give a "
            "direction, up = [x, y, z], or a board on the floor"
        )
    across = np.stack([camera.camera_from_world[0, :3] for camera in rig.cameras])
    rolls = np.degrees(np.arcsin(np.clip(np.abs(across @ direction), 0, 1)))
    doubts: tuple[str, ...] = ()
    if np.median(rolls) > ROLLED_DEG:
        doubts = (
            f"up by the cameras is doubtful: they are rolled about it by {np.median(rolls):.0f} degrees by the median",
        )
    return Upward(direction, f"the cameras' own (rolled by {np.median(rolls):.1f} degrees by the median)", doubts)


def _vertical(rig: Rig) -> tuple[np.ndarray, bool]:
    """Up by the cameras' axes, unit, and whether these agree about it."""
    rotations = np.stack([camera.camera_from_world[:3, :3] for camera in rig.cameras])
    across, mean = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(across.T @ across / len(across))
    level = vectors[:, 0] if values[1] > SPREAD_AXES else mean
    side = float(level @ mean)
    return _unit(level if side >= 0 else -level), abs(side) > 0.2 * float(np.linalg.norm(level))


def up_as_told(direction: Sequence[float]) -> Upward:
    return Upward(_unit(np.asarray(direction, dtype=np.float64)), "up in capture.toml")


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(reached, reached[-1] / 2)]])


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"
