"""Calibrations made elsewhere, read into a `Rig`; `calibration.exporters` writes them.

Read: COLMAP models (text, binary), transforms.json (nerfstudio, instant-ngp), poses_bounds.npy (LLFF, N3DV), intri.yml
with extri.yml (EasyMocap), caliscope's camera_array.toml, and our own rig.json. What each says about axes, pixel
centres and units is in docs/calibration.md; after loading everything follows `calibration.rig`: OpenCV axes, world to
camera, top-left pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

import json
import math
import re
import struct
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from tokenize import TokenError
from typing import Any

import cv2
import numpy as np

from calibration.rig import Camera, Rig

_PICTURE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".exr"}
_VIDEO_SUFFIXES = {".mp4", ".mov", ".mkv", ".avi", ".webm", ".mxf"}
_MOST_DEPTH = 64
_DEEP_LINE = re.compile(rb"^(?:[ \t]*-[ \t]){64}|^[ \t]{256}", re.MULTILINE)
"""More lists in one another than belong on a line, or as much white space as deep nesting needs"""
_NAMES_SHOWN = 8
_SHOWN = 1000
"""Characters of a message, which may repeat what a file says."""
_STRANGE = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    RecursionError,
    TokenError,  # of the header of an .npy file
    TypeError,
    cv2.error,
    struct.error,
)
"""What look-ups and arithmetic in a strange file raise."""
# COLMAP's model number: name and count of parameters (src/colmap/sensor/models.h).
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
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
    transforms.json, poses_bounds.npy, intri.yml with extri.yml, or one caliscope .toml; the first of these counts.
    Cameras that no video needs are left out. poses_bounds.npy names no cameras: its rows are those of the videos in
    the order of their names, or, for fewer videos than rows, the row of the number at the end of a video's name.
    Raises FileNotFoundError when nothing is there, and ValueError for an unreadable calibration or for videos
    without a camera.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no calibration at {path}")
    file = _find(path) if path.is_dir() else path
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused by the camera it belongs to
            views, metric = _read(file, names)
    except _STRANGE as problem:
        kind = type(problem).__name__
        raise ValueError(f"{file} is damaged or not a calibration: {kind}: {str(problem)[:_SHOWN]}") from problem
    except ValueError as problem:
        raise ValueError(f"{file}: {str(problem)[:_SHOWN]}") from problem
    if not views:
        raise ValueError(f"{file} holds no posed pictures")
    return Rig(tuple(_cameras(views, names, file)), str(file), metric)


def _find(folder: Path) -> Path:
    models = [
        folder / sub / f"cameras.{kind}" for sub in (".", "sparse/0", "sparse", "colmap") for kind in ("bin", "txt")
    ]
    others = (folder / name for name in ("transforms.json", "poses_bounds.npy", "intri.yml"))
    for file in (folder / "rig.json", *models, *others, *sorted(folder.glob("*.toml"))):
        if file.is_file():
            return file
    raise ValueError(
        f"{folder} holds no calibration that we read (rig.json, COLMAP's cameras and images as .bin or .txt, "
        "transforms.json, poses_bounds.npy, intri.yml, camera_array.toml), only "
        f"{sorted(entry.name for entry in folder.iterdir())}"
    )


def _read(file: Path, names: Sequence[str] | None) -> tuple[list[_View], bool]:
    """The posed pictures of a calibration file, and whether its units are metres."""
    if file.suffix == ".npy":
        return _read_poses_bounds(file, names), False
    if file.suffix in (".yml", ".yaml"):
        return _read_easymocap(file.with_name(f"intri{file.suffix}"), file.with_name(f"extri{file.suffix}")), False
    if file.suffix == ".toml":
        return _read_caliscope(tomllib.loads(file.read_text())), True
    if file.suffix == ".bin":
        return _read_colmap_binary(file.parent), False
    if file.suffix == ".txt":
        return _read_colmap_text(file.parent), False
    if file.suffix != ".json":
        raise ValueError("a calibration is a .json, .toml, .txt, .bin, .npy or .yml file, or a folder with one")
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
        f"every video needs a camera of its name in {file}; videos without one: {_some(set(names) - set(schemes[0]))}; "
        f"the file's cameras: {_some(schemes[0])}"
    )


def _some(names: Iterable[str]) -> str:
    """The first names in order, and how many more there are."""
    ordered = sorted(names)
    more = len(ordered) - _NAMES_SHOWN
    return ", ".join(ordered[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


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
    own = picture.stem if picture.suffix.lower() in _PICTURE_SUFFIXES | _VIDEO_SUFFIXES else picture.name
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
        raise ValueError(
            f"{what}: the pose must hold a rotation, but its axes have lengths {np.round(scales, 4)} "
            f"and determinant {np.linalg.det(rotation):.4f}"
        )
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
        name="",
        width=int(width),
        height=int(height),
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]) + 0.5,
        cy=float(matrix[1, 2]) + 0.5,
        camera_from_world=_pose(rotation, table["translation"], f"camera {number}"),
        distortion=_lens(np.ravel(table["distortions"])),
    )
    return _View((f"cam_{number}", f"port_{number}", f"cam{number}", str(number)), camera)


# LLFF and N3DV


def _read_poses_bounds(file: Path, names: Sequence[str] | None) -> list[_View]:
    rows = np.load(file, mmap_mode="r", allow_pickle=False)  # mapped: its shape is held against the file's size
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise ValueError(
            f"poses_bounds.npy must hold a row of 17 finite numbers for each camera, but is {rows.shape}, "
            f"{int((~np.isfinite(rows)).sum())} of them not finite; export it again, or give another calibration"
        )
    of_row = _names_of_rows(len(rows), names)
    return [_View((of_row[number],), _llff_camera(row)) for number, row in enumerate(rows)]


def _names_of_rows(count: int, names: Sequence[str] | None) -> list[str]:
    """The camera of each row: by order where numbers agree, else by the number at the end of the name."""
    if names is None:
        return [f"cam{number:02d}" for number in range(count)]
    if len(names) == count:
        return sorted(names)
    numbers = {int(match[0]): name for name in names if (match := re.search(r"\d+$", name))}
    if len(numbers) != len(names) or max(numbers, default=0) >= count:
        raise ValueError(
            f"it has {count} rows, which belong to the videos in the order of their names, but there are "
            f"{len(names)} videos; add the missing ones, or number all from 0 to {count - 1}"
        )
    return [numbers.get(number, f"row {number}") for number in range(count)]


def _llff_camera(row: np.ndarray) -> Camera:
    """Columns are the axes down, right, back, the centre, and height, width, focal length; near and far are left."""
    pose = row[:15].astype(np.float64).reshape(3, 5)
    down, right, back, centre = pose.T[:4]
    height, width, focal = (float(value) for value in pose[:, 4])
    if height != round(height) or width != round(width):
        raise ValueError(f"pictures are whole pixels in size, but a row says {width} x {height}")
    rotation = np.stack([right, down, -back])
    matrix = _pose(rotation, -rotation @ centre, "poses_bounds.npy")
    return Camera("", int(width), int(height), focal, focal, width / 2, height / 2, matrix)


# EasyMocap


def _read_easymocap(intri: Path, extri: Path) -> list[_View]:
    lenses, poses = _storage(intri), _storage(extri)
    listed = lenses.getNode("names")
    names = [listed.at(index).string() for index in range(listed.size())] if listed.isSeq() else []
    if not names:
        raise ValueError("intri.yml must list its cameras under names")
    return [_easymocap_view(name, lenses, poses) for name in names]


def _storage(path: Path) -> cv2.FileStorage:
    if not path.exists():
        raise FileNotFoundError(f"an EasyMocap calibration is intri.yml and extri.yml side by side, but no {path}")
    _check_nesting(path)
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError):  # OpenCV's bindings wrap the parser's error in a SystemError that says nothing
        storage = None
    if storage is None or not storage.isOpened():
        raise ValueError(f"{path.name} is no YAML file of OpenCV")
    return storage


def _check_nesting(path: Path) -> None:
    """OpenCV's parser goes as deep as a file does, until the stack ends and with it the program."""
    content, depth = path.read_bytes(), 0
    for mark in re.finditer(rb"[][{}]", content):
        depth += 1 if mark[0] in b"[{" else -1
        if depth > _MOST_DEPTH:
            raise ValueError(f"{path.name} may be nested {_MOST_DEPTH} deep at most, but goes deeper")
    if _DEEP_LINE.search(content):
        raise ValueError(f"{path.name} may be nested {_MOST_DEPTH} deep at most, but goes deeper")


def _easymocap_view(name: str, lenses: cv2.FileStorage, poses: cv2.FileStorage) -> _View:
    matrix = _storage_matrix(lenses, f"K_{name}", (3, 3))
    rotation = poses.getNode(f"Rot_{name}").mat()
    if rotation is None:
        rotation = cv2.Rodrigues(_storage_matrix(poses, f"R_{name}", (3, 1)))[0]
    shift = _storage_matrix(poses, f"T_{name}", (3, 1))
    lens = lenses.getNode(f"dist_{name}").mat()
    height, width = (lenses.getNode(f"{axis}_{name}").real() for axis in "HW")
    if not (height >= 1 and width >= 1):
        raise ValueError(f"intri.yml must give camera {name!r} its picture size, as H_{name}: 1080 and W_{name}: 1920")
    # OpenCV calibrates with the top-left pixel's centre at (0, 0), half a pixel from ours.
    camera = Camera(
        name="",
        width=round(width),
        height=round(height),
        fx=matrix[0, 0],
        fy=matrix[1, 1],
        cx=matrix[0, 2] + 0.5,
        cy=matrix[1, 2] + 0.5,
        camera_from_world=_pose(rotation, shift[:, 0], f"camera {name!r}"),
        distortion=_lens(() if lens is None else np.ravel(lens)),
    )
    return _View((name,), camera)


def _storage_matrix(storage: cv2.FileStorage, key: str, shape: tuple[int, int]) -> np.ndarray:
    """float64 of this shape; a row stands for a column too."""
    found = storage.getNode(key).mat()
    if found is None or found.size != shape[0] * shape[1]:
        raise ValueError(f"{key} must be a matrix of {shape[0]} x {shape[1]} numbers")
    return np.asarray(found, dtype=np.float64).reshape(shape)
