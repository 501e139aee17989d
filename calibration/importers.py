"""Calibrations made elsewhere, read into a `Rig` and written out again.

Read: COLMAP models (text, binary), transforms.json (nerfstudio, instant-ngp), caliscope's camera_array.toml, and our
own rig.json. What each says about axes, pixel centres and units is in docs/calibration.md; after loading everything
follows `calibration.rig`: OpenCV axes, world to camera, top-left pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

import json
import math
import struct
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from calibration.rig import Camera, Rig

_PICTURE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".exr"}
# COLMAP's model number: name and count of parameters (src/colmap/sensor/models.h).
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12),
}  # fmt: skip
_PARAMETER_COUNTS = dict(_MODELS.values())
_NERFSTUDIO_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class _View:
    """One posed picture; its camera's name is one of `names`, the file's videos tell which."""

    names: tuple[str, ...]
    camera: Camera


def load_rig(path: Path, names: Sequence[str] | None = None) -> Rig:
    """Read a calibration; `names` (of the videos) selects its cameras and sets their order.

    `path` is a file, or a folder that holds rig.json, a COLMAP model (there, or under sparse/0, sparse or colmap),
    transforms.json, or one caliscope .toml; the first of these counts. Cameras that no video needs are left out.
    Raises FileNotFoundError when nothing is there, and ValueError for an unreadable calibration or for videos
    without a camera.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no calibration at {path}")
    file = _find(path) if path.is_dir() else path
    try:
        views, metric = _read(file)
    except (KeyError, TypeError, IndexError, struct.error) as problem:
        raise ValueError(f"{file} is damaged or not a calibration: {type(problem).__name__}: {problem}") from problem
    except ValueError as problem:
        raise ValueError(f"{file}: {problem}") from problem
    if not views:
        raise ValueError(f"{file} holds no posed pictures")
    return Rig(tuple(_cameras(views, names, file)), str(file), metric)


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
        model, parameters = _colmap_model(camera)
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
    path.write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}, indent=1))


def _find(folder: Path) -> Path:
    models = [
        folder / sub / f"cameras.{kind}" for sub in (".", "sparse/0", "sparse", "colmap") for kind in ("bin", "txt")
    ]
    for file in (folder / "rig.json", *models, folder / "transforms.json", *sorted(folder.glob("*.toml"))):
        if file.is_file():
            return file
    raise ValueError(
        f"{folder} holds no calibration that we read (rig.json, COLMAP's cameras and images as .bin or .txt, "
        f"transforms.json, camera_array.toml), only {sorted(entry.name for entry in folder.iterdir())}"
    )


def _read(file: Path) -> tuple[list[_View], bool]:
    """The posed pictures of a calibration file, and whether its units are metres."""
    if file.suffix == ".toml":
        return _read_caliscope(tomllib.loads(file.read_text())), True
    if file.suffix == ".bin":
        return _read_colmap_binary(file.parent), False
    if file.suffix == ".txt":
        return _read_colmap_text(file.parent), False
    if file.suffix != ".json":
        raise ValueError("a calibration is a .json, .toml, .txt or .bin file, or a folder with one")
    data = json.loads(file.read_text())
    if "frames" in data:
        return [_transforms_view(data, frame) for frame in data["frames"]], False
    rig = Rig.load(file)
    return [_View((camera.name,), camera) for camera in rig.cameras], rig.metric


# Names


def _cameras(views: Sequence[_View], names: Sequence[str] | None, file: Path) -> Iterator[Camera]:
    """One camera for each name: the first way to name the pictures that knows all videos, or whose poses agree."""
    schemes = [_grouped(views, index) for index in range(len(views[0].names))]
    size = _extent(views)
    if names is None:
        names, scheme = _agreeing(schemes, size, file)
    else:
        scheme = _covering(schemes, names, file)
    for name in names:
        group = scheme[name]
        if not _agree(group, size):
            raise ValueError(
                f"{file}: the {len(group)} pictures of camera {name!r} must share one pose and lens, but differ"
            )
        yield replace(group[0], name=name)


def _grouped(views: Sequence[_View], index: int) -> dict[str, list[Camera]]:
    groups: dict[str, list[Camera]] = {}
    for view in views:
        groups.setdefault(view.names[index], []).append(view.camera)
    return groups


def _covering(schemes: Sequence[dict[str, list[Camera]]], names: Sequence[str], file: Path) -> dict[str, list[Camera]]:
    for scheme in schemes:
        if set(names) <= set(scheme):
            return scheme
    raise ValueError(
        f"every video needs a camera of its name in {file}; videos: {sorted(set(names))}; "
        f"cameras: {sorted(schemes[0])}; videos without a camera: {sorted(set(names) - set(schemes[0]))}"
    )


def _agreeing(
    schemes: Sequence[dict[str, list[Camera]]], size: float, file: Path
) -> tuple[list[str], dict[str, list[Camera]]]:
    for scheme in schemes:
        if "" not in scheme and all(_agree(group, size) for group in scheme.values()):
            return list(scheme), scheme
    raise ValueError(
        f"{file}: pictures of one camera must share one pose and lens, but neither their file names nor their folders "
        "group them so; keep one picture of each camera, named after it"
    )


def _extent(views: Sequence[_View]) -> float:
    """Size of the rig, to judge by what a distance between two poses of one camera means."""
    centres = np.stack([view.camera.centre for view in views])
    return float(np.linalg.norm(centres.max(axis=0) - centres.min(axis=0)))


def _agree(group: Sequence[Camera], size: float) -> bool:
    """Whether all are one camera: within 0.1 degrees, 0.1 % of the rig, and 0.1 % in focal length."""
    first = group[0]
    for other in group[1:]:
        turn = first.camera_from_world[:3, :3] @ other.camera_from_world[:3, :3].T
        angle_deg = math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(turn)) - 1) / 2))))
        shift = float(np.linalg.norm(first.centre - other.centre))
        same_lens = (first.width, first.height) == (other.width, other.height) and abs(other.fx / first.fx - 1) < 1e-3
        if angle_deg > 0.1 or shift > 1e-3 * size or not same_lens:
            return False
    return True


def _picture_names(path: str) -> tuple[str, str]:
    """Names that a picture's file may give its camera: the file's own, or its folder's."""
    picture = PurePosixPath(path.replace("\\", "/"))
    own = picture.stem if picture.suffix.lower() in _PICTURE_SUFFIXES else picture.name
    return own, picture.parent.name


# Lenses and poses


def _lens(coefficients: Iterable[float]) -> tuple[float, ...]:
    """The shortest of OpenCV's lens models (0, 4, 5, 8 coefficients) that holds these."""
    values = tuple(float(value) for value in coefficients)
    used = max((index + 1 for index, value in enumerate(values) if value), default=0)
    length = next(length for length in (0, 4, 5, 8) if length >= used)
    return (values + (0.0,) * 8)[:length]


def _pose(rotation: np.ndarray, translation: np.ndarray, what: str) -> np.ndarray:
    """Rigid [4, 4] from a rotation that text has rounded; raises ValueError when it is none."""
    left, scales, right = np.linalg.svd(rotation)
    if not np.allclose(scales, 1, atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError(f"{what}: the pose must hold a rotation, but its axes have lengths {np.round(scales, 4)} "
                         f"and determinant {np.linalg.det(rotation):.4f}")  # fmt: skip
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = left @ right, np.asarray(translation, dtype=np.float64)
    return pose


def _rotation(quaternion: Sequence[float]) -> np.ndarray:
    w, x, y, z = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


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


# COLMAP


def _read_colmap_text(folder: Path) -> list[_View]:
    lenses = {}
    for line in _content_lines(folder / "cameras.txt"):
        number, model, width, height, *parameters = line.split()
        lenses[int(number)] = _colmap_lens(model, int(width), int(height), [float(value) for value in parameters])
    # Every image takes two lines, and the second one is empty when it has no points: blank lines count.
    lines = [line for line in _lines(folder / "images.txt") if not line.startswith("#")]
    if any(len(line.split()) % 3 for line in lines[1::2]):
        raise ValueError("images.txt must give two lines for each image, the second with x y id of its points or empty")
    headers = [line.split(maxsplit=9) for line in lines[0::2] if line.strip()]
    return [
        _colmap_view([float(value) for value in fields[1:8]], lenses[int(fields[8])], fields[9].strip())
        for fields in headers
    ]


def _lines(path: Path) -> list[str]:
    if not path.exists():
        raise FileNotFoundError(f"a COLMAP model needs cameras and images side by side, but there is no {path}")
    return path.read_text().splitlines()


def _content_lines(path: Path) -> list[str]:
    return [line for line in _lines(path) if line.strip() and not line.startswith("#")]


def _read_colmap_binary(folder: Path) -> list[_View]:
    cameras, images = _Bytes(folder / "cameras.bin"), _Bytes(folder / "images.bin")
    lenses = {}
    for _ in range(cameras.take("<Q")[0]):
        number, model, width, height = cameras.take("<iiQQ")
        name, count = _MODELS[model]
        lenses[number] = _colmap_lens(name, width, height, cameras.take(f"<{count}d"))
    views = []
    for _ in range(images.take("<Q")[0]):
        _, *pose, camera = images.take("<i7di")
        views.append(_colmap_view(pose, lenses[camera], images.text()))
        images.skip(24 * images.take("<Q")[0])  # x, y, point of every feature
    return views


class _Bytes:
    """A little-endian file, read from front to back; a read past its end raises struct.error."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            raise FileNotFoundError(f"a COLMAP model needs cameras and images side by side, but there is no {path}")
        self._data, self._at = path.read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from(layout, self._data, self._at)
        self._at += struct.calcsize(layout)
        return values

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise struct.error("a name has no end")
        name, self._at = self._data[self._at : end].decode(), end + 1
        return name

    def skip(self, size_bytes: int) -> None:
        self._at += size_bytes
        if self._at > len(self._data):
            raise struct.error(f"{len(self._data)} bytes, but {self._at} are announced")


def _colmap_lens(model: str, width: int, height: int, parameters: Sequence[float]) -> Camera:
    if len(parameters) != _PARAMETER_COUNTS.get(model, -1):
        raise ValueError(f"COLMAP's model {model} does not have {len(parameters)} parameters")
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        f, cx, cy, *lens = parameters
        fx = fy = f
    elif model in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        fx, fy, cx, cy, *lens = parameters
    else:
        raise ValueError(
            f"COLMAP's lens model {model} is not supported; undistort the pictures (colmap image_undistorter), "
            "or solve with SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or FULL_OPENCV"
        )
    return Camera("", width, height, fx, fy, cx, cy, np.eye(4), _lens(lens))


def _colmap_view(pose: Sequence[float], lens: Camera, picture: str) -> _View:
    matrix = _pose(_rotation(pose[:4]), np.array(pose[4:7]), f"image {picture!r}")
    return _View(_picture_names(picture), replace(lens, camera_from_world=matrix))


def _colmap_model(camera: Camera) -> tuple[str, tuple[float, ...]]:
    base = (camera.fx, camera.fy, camera.cx, camera.cy)
    model = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV", 8: "FULL_OPENCV"}[len(camera.distortion)]
    return model, (base + camera.distortion + (0.0,) * 8)[: _PARAMETER_COUNTS[model]]


# transforms.json


def _transforms_view(shared: Mapping[str, Any], frame: Mapping[str, Any]) -> _View:
    picture = str(frame["file_path"])
    values = {**shared, **frame}
    if values.get("camera_model", "OPENCV") not in _NERFSTUDIO_MODELS or values.get("is_fisheye") or values.get("k4"):
        raise ValueError(
            f"{picture}: the lens model {values.get('camera_model', 'with k4 or is_fisheye')} is not supported; "
            f"undistort the pictures, or use one of {', '.join(_NERFSTUDIO_MODELS)}"
        )
    fx, fy, cx, cy, width, height = _transforms_intrinsics(values, picture)
    matrix = np.asarray(values["transform_matrix"], dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"{picture}: transform_matrix must be [4, 4] or [3, 4], not {matrix.shape}")
    world_from_camera = matrix[:3] @ _OPENCV_FROM_OPENGL
    rotation = world_from_camera[:, :3].T
    pose = _pose(rotation, -rotation @ world_from_camera[:, 3], picture)
    lens = _lens(values.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    return _View(_picture_names(picture), Camera("", width, height, fx, fy, cx, cy, pose, lens))


def _transforms_intrinsics(values: Mapping[str, Any], picture: str) -> tuple[float, float, float, float, int, int]:
    if "w" not in values or "h" not in values or not ("fl_x" in values or "camera_angle_x" in values):
        raise ValueError(
            f"{picture}: transforms.json must give w, h and fl_x (or camera_angle_x), at the top or in the frame"
        )
    width, height = int(values["w"]), int(values["h"])
    fx = float(values.get("fl_x") or width / 2 / math.tan(values["camera_angle_x"] / 2))
    fy = float(values.get("fl_y") or fx)
    return fx, fy, float(values.get("cx", width / 2)), float(values.get("cy", height / 2)), width, height


def _transforms_frame(camera: Camera) -> dict[str, Any]:
    if len(camera.distortion) > 5:
        raise ValueError(f"camera {camera.name!r}: transforms.json holds no rational lens model; write COLMAP instead")
    pose = np.linalg.inv(camera.camera_from_world) @ _OPENCV_FROM_OPENGL
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False))
    return {
        "file_path": f"images/{camera.name}.png", "w": camera.width, "h": camera.height, "fl_x": camera.fx,
        "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, **lens, "transform_matrix": pose.tolist(),
    }  # fmt: skip


# caliscope


def _read_caliscope(data: Mapping[str, Any]) -> list[_View]:
    """Both layouts: tables [cameras.N] of camera_array.toml, and [cam_N] of the older config.toml."""
    tables = data.get("cameras") or {key: table for key, table in data.items() if key.startswith("cam_")}
    posed = [table for table in tables.values() if "rotation" in table and not table.get("ignore")]
    return [_caliscope_view(table) for table in posed]


def _caliscope_view(table: Mapping[str, Any]) -> _View:
    number = table.get("cam_id", table.get("port"))
    if table.get("fisheye"):
        raise ValueError(
            f"camera {number}: caliscope's fisheye model is not supported; calibrate with the standard model"
        )
    matrix, (width, height) = np.asarray(table["matrix"], dtype=np.float64), table["size"]
    turn = np.asarray(table["rotation"], dtype=np.float64)
    rotation = turn if turn.shape == (3, 3) else cv2.Rodrigues(turn)[0]
    # OpenCV calibrates with the top-left pixel's centre at (0, 0), half a pixel from ours.
    camera = Camera(
        "", int(width), int(height), float(matrix[0, 0]), float(matrix[1, 1]),
        float(matrix[0, 2]) + 0.5, float(matrix[1, 2]) + 0.5,
        _pose(rotation, table["translation"], f"camera {number}"), _lens(np.ravel(table["distortions"])),
    )  # fmt: skip
    return _View((f"cam_{number}", f"port_{number}", f"cam{number}", str(number)), camera)
