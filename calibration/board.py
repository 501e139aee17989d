"""Boards of known size, ChArUco or of AprilTags: what they are, and where a picture shows their corners."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from calibration.importers.views import PIXEL_CENTRE

MOST_SIDE = 100
"""Squares or tags along a side"""
LEAST_PERIMETER = 0.01
"""Of a marker, as a share of the picture's longer side: 10 px a side in pictures 3,840 wide. OpenCV's 0.03 misses
boards in the middle of a stage"""


WINDOW_PX, WINDOW_CELLS = 10, 0.5
"""Half the side of the window in which a tag's corner is looked for, at most, and in cells of the tag: OpenCV's 0.3
draws corners inwards by 0.3 % of a board of four tags, from 0.7 on the neighbouring cells do so outwards"""


class BoardKind(StrEnum):
    """What is printed."""

    CHARUCO = "charuco"
    """A chessboard with a marker in each white square; its inner corners count"""
    APRILTAG = "apriltag"
    """Tags side by side; each tag's four corners count"""


DICTIONARIES = {BoardKind.CHARUCO: "5X5_100", BoardKind.APRILTAG: "APRILTAG_36h11"}
"""OpenCV's names of the markers, where none is said"""


@dataclass(frozen=True, kw_only=True)
class Board:
    """A flat board, as `[board]` in capture.toml describes it. Lengths in metres."""

    kind: BoardKind
    columns: int
    """Squares or tags along its width"""
    rows: int
    marker: float
    """Side of a marker or tag, its black border included"""
    square: float = 0.0
    """Side of a square of a ChArUco board"""
    gap: float = 0.0
    """Between two tags"""
    dictionary: str = ""
    """OpenCV's name without DICT_; empty for the usual one of the kind"""
    legacy: bool = False
    """The ChArUco board begins as those of OpenCV before 4.6 do, which matters where it has an even number of rows"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", _kind(self.kind))
        object.__setattr__(self, "dictionary", self.dictionary or DICTIONARIES[self.kind])
        least = 2 if self.kind is BoardKind.CHARUCO else 1
        if not (least <= self.columns <= MOST_SIDE and least <= self.rows <= MOST_SIDE):
            raise ValueError(
                f"columns and rows must be {least} to {MOST_SIDE}, but are {self.columns} and {self.rows}; a board of "
                f"kind {self.kind} counts {'squares' if self.kind is BoardKind.CHARUCO else 'tags'}"
            )
        self._check_lengths()
        if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            known = sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
            raise ValueError(f"dictionary must be one of {', '.join(known)}, but is {self.dictionary!r}")
        held, needed = len(self._markers.bytesList), self._marker_count
        if held < needed:
            raise ValueError(
                f"a {self.kind} board of {self.columns} x {self.rows} has {needed} markers, but the dictionary "
                f"{self.dictionary} only {held}; name the one it was printed with"
            )

    def _check_lengths(self) -> None:
        odd, right = ("gap", "square") if self.kind is BoardKind.CHARUCO else ("square", "gap")
        if getattr(self, odd):
            raise ValueError(f"a board of kind {self.kind} has no {odd}; its sizes are marker and {right}")
        if not 0 < self.marker < np.inf:
            raise ValueError(f"marker must be the side of a marker in metres, but is {self.marker}")
        if self.kind is BoardKind.CHARUCO and not self.marker < self.square < np.inf:
            raise ValueError(
                f"square must be the side of a square in metres, greater than marker, but is {self.square} with "
                f"marker = {self.marker}"
            )
        if self.kind is BoardKind.APRILTAG and self._marker_count > 1 and not 0 < self.gap < np.inf:
            raise ValueError(f"gap must be the distance between two tags in metres, but is {self.gap}")

    @classmethod
    def from_table(cls, table: dict[str, Any]) -> Board:
        """What a table of capture.toml describes; raises ValueError that names a key."""
        kinds = {"columns": int, "rows": int, "marker": float, "square": float, "gap": float, "legacy": bool}
        known = {field.name for field in fields(cls)}
        for key, value in table.items():
            if key not in known:
                raise ValueError(
                    f"unknown key {key!r}; known are {sorted(known)}, and keys of the capture stand above [board]"
                )
            kind = kinds.get(key, str)
            right = isinstance(value, (int, float) if kind is float else kind)
            if not right or (isinstance(value, bool) and kind is not bool):
                said = {int: "a whole number", float: "a number of metres", bool: "true or false", str: "a text"}[kind]
                raise ValueError(f"{key} must be {said}, but is {value!r}")
        if missing := [key for key in ("kind", "columns", "rows", "marker") if key not in table]:
            raise ValueError(f"a board needs {', '.join(missing)}, too")
        return cls(**table)

    def __str__(self) -> str:
        return f"{self.kind} board of {self.columns} x {self.rows} ({self.dictionary})"

    @property
    def _marker_count(self) -> int:
        inside = self.columns * self.rows
        return inside // 2 if self.kind is BoardKind.CHARUCO else inside

    @property
    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    @cached_property
    def layout(self) -> cv2.aruco.CharucoBoard | cv2.aruco.GridBoard:
        """OpenCV's description of the same."""
        size = (self.columns, self.rows)
        if self.kind is BoardKind.APRILTAG:
            return cv2.aruco.GridBoard(size, self.marker, self.gap or self.marker, self._markers)
        board = cv2.aruco.CharucoBoard(size, self.square, self.marker, self._markers)
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def points(self) -> np.ndarray:
        """Its corners on the board, float64 [K, 2], metres: x along its width, y down its height."""
        layout = self.layout
        if isinstance(layout, cv2.aruco.CharucoBoard):
            found = np.asarray(layout.getChessboardCorners())
        else:
            found = np.concatenate(layout.getObjPoints())
        points: np.ndarray = found[:, :2].astype(np.float64)
        return points

    def __getstate__(self) -> dict[str, Any]:
        """OpenCV's objects cannot be sent to another process."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True)
class Corners:
    """What a picture shows of a board."""

    ids: np.ndarray
    """int64 [K], indices into `Board.points`, ascending, each once"""
    pixels: np.ndarray
    """float64 [K, 2], where the centre of the top-left pixel is (0.5, 0.5)"""
    markers: int
    """Of the board's dictionary that were seen; with none of its corners, the board is described wrong"""


def find_corners(board: Board, picture: np.ndarray) -> Corners:
    """The board's corners in a picture as filmed, uint8 [H, W, 3] RGB."""
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = LEAST_PERIMETER
    layout = board.layout
    if isinstance(layout, cv2.aruco.CharucoBoard):
        pixels, ids, _, markers = cv2.aruco.CharucoDetector(layout, detectorParams=parameters).detectBoard(gray)
        return _corners(board, pixels, ids, 0 if markers is None else len(markers))
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize, parameters.relativeCornerRefinmentWinSize = WINDOW_PX, WINDOW_CELLS
    tags, ids, _ = cv2.aruco.ArucoDetector(layout.getDictionary(), parameters).detectMarkers(gray)
    if ids is None or not len(ids):
        return _corners(board, None, None, 0)
    return _corners(board, np.concatenate(tags), 4 * ids.reshape(-1, 1) + np.arange(4), len(ids))


def _corners(board: Board, pixels: np.ndarray | None, ids: np.ndarray | None, markers: int) -> Corners:
    """Arrays of OpenCV's, as sorted ones without doubles; None where nothing is seen."""
    if pixels is None or ids is None or not len(ids):
        return Corners(np.zeros(0, np.int64), np.zeros((0, 2)), markers)
    own, first, count = np.unique(np.ravel(ids).astype(np.int64), return_index=True, return_counts=True)
    once = (count == 1) & (own < len(board.points))  # a tag that is seen twice is another thing at least once
    return Corners(own[once], np.reshape(pixels, (-1, 2)).astype(np.float64)[first[once]] + PIXEL_CENTRE, markers)


def _kind(value: str) -> BoardKind:
    try:
        return BoardKind(value)
    except ValueError:
        raise ValueError(f"kind must be one of {', '.join(BoardKind)}, but is {value!r}") from None
