"""Pictures of a board of known size in a plain room: the board's print is warped by the cameras' true poses."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from calibration.board import Board, BoardKind
from calibration.rig import Camera, Rig

FINE = 4000.0
"""Pixels of the print per metre"""
FINER = 3
"""By which pictures are drawn larger, and averaged down"""
PAPER = 0.02
"""White about the print, metres"""


def board_pose(middle: Sequence[float], normal: Sequence[float], turn_deg: float = 0.0) -> np.ndarray:
    """World from board, float64 [4, 4]: the board's middle and the side of its print; turned about the normal."""
    back = -np.asarray(normal, float) / np.linalg.norm(normal)  # a board's z points away from who reads it
    across = np.cross(back, [0.2, 0.3, 1.0])
    across /= np.linalg.norm(across)
    turn = cv2.Rodrigues(back * np.radians(turn_deg))[0]
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.stack([across, np.cross(back, across), back], axis=1)
    pose[:3, 3] = middle
    return pose


def extent(board: Board) -> tuple[float, float]:
    """Width and height of the print, metres."""
    if board.kind is BoardKind.CHARUCO:
        return board.columns * board.square, board.rows * board.square
    step = board.marker + board.gap
    return board.columns * step - board.gap, board.rows * step - board.gap


def show(
    rig: Rig,
    board: Board,
    world_from_board: np.ndarray,
    *,
    stretch: tuple[float, float] = (1.0, 1.0),
    part: float = 1.0,
    noise: float = 2.0,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """What each camera films, uint8 [H, W, 3]; the print may be stretched, and only its left `part` be shown.

    The rig's unit is a metre, and the board lies before every camera. What a lens does is taken from the middles of
    pixels, and between them linearly.
    """
    width, height = extent(board)
    size = (round(width * FINE), round(height * FINE))
    sheet = board.layout.generateImage(size, marginSize=0)
    sheet = sheet[:, : round(part * size[0])]
    margin = round(PAPER * FINE)
    sheet = cv2.copyMakeBorder(sheet, *(margin,) * 4, cv2.BORDER_CONSTANT, value=255)
    # pixel centres of the print, at integers, to metres on the board
    metres = np.array(
        [
            [stretch[0] / FINE, 0, stretch[0] * ((0.5 - margin) / FINE - width / 2)],
            [0, stretch[1] / FINE, stretch[1] * ((0.5 - margin) / FINE - height / 2)],
            [0, 0, 1],
        ]
    )
    rng = np.random.default_rng(seed)
    return {camera.name: _film(camera, sheet, world_from_board, metres, noise, rng) for camera in rig.cameras}


def _film(
    camera: Camera, sheet: np.ndarray, pose: np.ndarray, metres: np.ndarray, noise: float, rng: np.random.Generator
) -> np.ndarray:
    local = camera.camera_from_world @ pose
    size = (camera.width, camera.height)
    # rays of all pixels, then of a larger picture's, then where they meet the sheet
    middles = np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), axis=-1)
    plane = camera.plane_from_pixels(middles.reshape(-1, 2)).reshape(*middles.shape).astype(np.float32)
    plane = cv2.resize(plane, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
    spots = cv2.perspectiveTransform(plane, np.linalg.inv(local[:3][:, [0, 1, 3]] @ metres))
    faces = local[:3, 2] @ local[:3, 3] > 0  # who stands behind sees the white back
    source = sheet if faces else np.full_like(sheet, 235)
    filmed = cv2.remap(source, spots, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
    picture = cv2.resize(filmed, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    picture = picture + noise * rng.standard_normal(picture.shape)
    return np.repeat(np.clip(np.round(picture), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)
