"""A rig written out for other programs: COLMAP, nerfstudio (transforms.json), LLFF and N3DV (poses_bounds.npy)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from calibration.importers.names import natural_key
from calibration.rig import Camera, Rig

_COLMAP_PARAMETERS = {"PINHOLE": 4, "OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12}
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_CENTRED_PX = 1e-6
"""How far from the middle a principal point may lie for a format that has none: less than any calibration knows."""


def write_colmap(rig: Rig, folder: Path) -> None:
    """Write a COLMAP text model without points: one camera and one image `<name>.png` for each camera of the rig.

    COLMAP has no place for colour gains; they are left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lenses, images = (
        ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"],
        ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"],
    )
    for number, camera in enumerate(rig.cameras, start=1):
        model, parameters = colmap_lens(camera)
        pose = (*_quaternion(camera.camera_from_world[:3, :3]), *camera.camera_from_world[:3, 3])
        lenses.append(f"{number} {model} {camera.width} {camera.height} {_decimals(parameters)}")
        images += [f"{number} {_decimals(pose)} {number} {camera.name}.png", ""]
    (folder / "cameras.txt").write_text("\n".join(lenses) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    (folder / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")


def write_transforms(rig: Rig, path: Path) -> None:
    """Write nerfstudio's transforms.json with intrinsics in each frame; gains are left out.

    Raises ValueError for a rational lens model (8 coefficients), which the format cannot hold.
    """
    frames = [_transforms_frame(camera) for camera in rig.cameras]
    fisheye = all(camera.fisheye for camera in rig.cameras)
    shared = {"camera_model": "OPENCV_FISHEYE", "is_fisheye": True} if fisheye else {"camera_model": "OPENCV"}
    path.write_text(json.dumps({**shared, "frames": frames}, indent=1))


def write_poses_bounds(rig: Rig, path: Path, bounds: np.ndarray) -> None:
    """Write LLFF's poses_bounds.npy, one row a camera in the rig's order; `bounds` [C, 2] are near and far depths.

    The format names no cameras: its rows belong to the videos in the order of their names. Raises ValueError for what
    it cannot hold: lenses, two focal lengths, a principal point off the middle, names out of order.
    """
    if list(rig.names) != sorted(rig.names, key=natural_key) or bounds.shape != (len(rig.cameras), 2):
        raise ValueError(
            f"poses_bounds.npy needs cameras in the order of their names and two bounds for each, but has {rig.names} "
            f"and bounds {bounds.shape}; sort the rig"
        )
    rows = [np.append(_llff_pose(camera), depths) for camera, depths in zip(rig.cameras, bounds, strict=True)]
    np.save(path, np.stack(rows))


# Details


def _quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Unit w x y z with w >= 0: the largest eigenvector of Bar-Itzhack's matrix, sound for every rotation."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    lower = [
        [a - e - i, 0, 0, 0],
        [d + b, e - a - i, 0, 0],
        [g + c, h + f, i - a - e, 0],
        [h - f, c - g, d - b, a + e + i],
    ]
    x, y, z, w = np.linalg.eigh(np.array(lower) / 3)[1][:, -1]
    sign = -1.0 if w < 0 else 1.0
    return float(sign * w), float(sign * x), float(sign * y), float(sign * z)


def _decimals(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)  # repr of a float reads back to the same float


def colmap_lens(camera: Camera) -> tuple[str, tuple[float, ...]]:
    base = (camera.fx, camera.fy, camera.cx, camera.cy)
    model = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV", 8: "FULL_OPENCV"}[len(camera.distortion)]
    model = "OPENCV_FISHEYE" if camera.fisheye else model
    return model, (base + camera.distortion + (0.0,) * 8)[: _COLMAP_PARAMETERS[model]]


def _transforms_frame(camera: Camera) -> dict[str, Any]:
    if len(camera.distortion) > 5:
        raise ValueError(f"camera {camera.name!r}: transforms.json holds no rational lens model; write COLMAP instead")
    pose = np.linalg.inv(camera.camera_from_world) @ _OPENCV_FROM_OPENGL
    keys = ("k1", "k2", "k3", "k4") if camera.fisheye else ("k1", "k2", "p1", "p2", "k3")
    lens = dict(zip(keys, camera.distortion, strict=False))
    return {
        **({"camera_model": "OPENCV_FISHEYE", "is_fisheye": True} if camera.fisheye else {}),
        "file_path": f"images/{camera.name}.png",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        **lens,
        "transform_matrix": pose.tolist(),
    }


def _llff_pose(camera: Camera) -> np.ndarray:
    """15 numbers: rows of [3, 5], axes down, right, back as seen from the world, centre, and height, width, focal."""
    off = max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2))
    if camera.distortion or camera.fx != camera.fy or off > _CENTRED_PX:
        raise ValueError(
            f"camera {camera.name!r}: poses_bounds.npy holds one focal length and no lens or principal point, but the "
            f"camera has fx {camera.fx}, fy {camera.fy}, a centre {off:.3g} px off the middle and "
            f"{len(camera.distortion)} lens coefficients; write COLMAP or transforms.json instead"
        )
    right, down, forward = camera.camera_from_world[:3, :3]
    size = (camera.height, camera.width, camera.fx)
    return np.stack([down, right, -forward, camera.centre, size], axis=1).ravel()
