"""Motion in the world from optical flow in the pictures of several cameras.

Each camera sees its own projection of a Gaussian's step to the next instant. Together they determine the step:
a warm start that carries fast things to where they are, before any iteration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera


@dataclass(frozen=True)
class LiftOptions:
    enabled: bool = True
    rounds: int = 4
    """Of reweighting; a camera whose optical flow belongs to something in front loses its say"""
    tolerance_px: float = 2.0
    """Disagreement between optical flow and step at which a camera counts half"""
    ridge: float = 0.3
    """Pull towards no motion, in squared pixels per squared pixel of motion: decides what no two cameras see"""
    min_views: int = 2
    """Cameras with optical flow that a Gaussian needs to be moved"""


def lift_motion(
    points: np.ndarray,  # [N, 3], world, at the previous instant
    cameras: Sequence[PinholeCamera],
    optical_flows: Sequence[np.ndarray | None],  # float32 [h, w, 2], full pixels, on the previous picture's grid
    masks: Sequence[np.ndarray | None],  # bool [H, W]: optical flow elsewhere is noise and counts as none
    *,
    near: float,
    options: LiftOptions,
) -> np.ndarray:  # float32 [N, 3], world
    """Step of each point to the next instant; zero where too few cameras saw it move. O(N C)."""
    steps = np.zeros(points.shape, np.float64)
    if not options.enabled or not len(points):
        return steps.astype(np.float32)
    seen = [
        _one_camera(points.astype(np.float64), camera, optical_flow, mask, near)
        for camera, optical_flow, mask in zip(cameras, optical_flows, masks, strict=True)
        if optical_flow is not None
    ]
    if not seen:
        return steps.astype(np.float32)
    jacobians, moved, valid = (np.stack(column, axis=1) for column in zip(*seen, strict=True))
    weight = valid.astype(np.float64)  # [N, C]
    for _ in range(options.rounds):
        steps = _solve(jacobians, moved, weight, options.ridge)
        error = np.linalg.norm(np.einsum("ncij,nj->nci", jacobians, steps) - moved, axis=2)
        weight = valid / (1 + (error / options.tolerance_px) ** 2)
    steps[valid.sum(axis=1) < options.min_views] = 0
    return steps.astype(np.float32)


def _one_camera(
    points: np.ndarray, camera: PinholeCamera, optical_flow: np.ndarray, mask: np.ndarray | None, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How pixels follow the points [N, 2, 3], how they moved [N, 2], and where this camera has a say, bool [N]."""
    pixels, depth = camera.project(points)
    h, w = optical_flow.shape[:2]
    valid = (depth > near) & (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    spot = np.where(valid[:, None], pixels, 0.0)
    cells = (spot * [w / camera.width, h / camera.height]).astype(np.int64)
    moved = optical_flow[cells[:, 1], cells[:, 0]].astype(np.float64)
    if mask is not None:
        inside = spot.astype(np.int64)
        moved[~mask[inside[:, 1], inside[:, 0]]] = 0
    z = np.where(valid, depth, 1.0)
    local = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    jacobian = np.zeros((len(points), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / z, -camera.fx * local[:, 0] / z**2
    jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / z, -camera.fy * local[:, 1] / z**2
    return jacobian @ camera.camera_from_world[:3, :3], moved, valid


def _solve(jacobians: np.ndarray, moved: np.ndarray, weight: np.ndarray, ridge: float) -> np.ndarray:
    """Weighted least squares per point, float64 [N, 3]."""
    weighted = jacobians * weight[:, :, None, None]
    system = np.einsum("ncij,ncik->njk", weighted, jacobians)
    right = np.einsum("ncij,nci->nj", weighted, moved)
    # The ridge is in pixels: scaled by how strongly one camera sees a step.
    scale = np.trace(system, axis1=1, axis2=2) / np.maximum(weight.sum(axis=1), 1e-9) / 3
    system += (ridge * scale + 1e-12)[:, None, None] * np.eye(3)
    return np.linalg.solve(system, right[:, :, None])[:, :, 0]
