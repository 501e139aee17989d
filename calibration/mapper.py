"""COLMAP's incremental mapper in a process of its own: `python -m calibration.mapper SPEC`.

Nothing else may import this module: pycolmap and OpenCV in one process abort when they load in the wrong order.
`calibration.solve` writes the specification and the matches, and reads the model and the result.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap


def main(spec_path: Path) -> None:
    """Map the matches that a specification names; write model/ (COLMAP text), result.json and inliers.npz beside it."""
    spec = json.loads(spec_path.read_text())
    folder = spec_path.parent
    pycolmap.set_random_seed(spec["seed"])
    database_path = folder / "database.db"
    database_path.unlink(missing_ok=True)
    inliers = _fill(database_path, spec, np.load(folder / "matches.npz"))
    np.savez(folder / "inliers.npz", **inliers)  # type: ignore[arg-type]  # keys are no keywords of savez
    (folder / "mapped").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(database_path, folder, folder / "mapped", _mapping_options(spec))
    model = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if model is not None:
        (folder / "model").mkdir(exist_ok=True)
        model.write_text(folder / "model")
    (folder / "result.json").write_text(json.dumps(_result(model, len(models)), indent=1))


def _fill(path: Path, spec: Mapping[str, Any], matches: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Write cameras, images, keypoints and verified pairs; return 'a b' (indices) -> inlier matches [K, 2]."""
    keypoints = [matches[f"keypoints {index}"] for index in range(len(spec["cameras"]))]
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = spec["seed"]
    options.min_num_inliers, options.min_inlier_ratio = spec["min_pair_matches"], spec["min_pair_share"]
    inliers = {}
    with pycolmap.Database.open(path) as database:
        lenses = _write_lenses(database, spec)
        for index, camera in enumerate(spec["cameras"]):
            _write_image(database, index + 1, camera["name"], lenses[index])
            database.write_keypoints(index + 1, keypoints[index].astype(np.float32))
        for pair in (key for key in matches if not key.startswith("keypoints ")):
            a, b = (int(part) for part in pair.split())
            candidates = matches[pair].astype(np.uint32)
            geometry = pycolmap.estimate_two_view_geometry(
                lenses[a], keypoints[a], lenses[b], keypoints[b], candidates, options
            )
            database.write_matches(a + 1, b + 1, candidates)
            database.write_two_view_geometry(a + 1, b + 1, geometry)
            if len(geometry.inlier_matches) >= options.min_num_inliers:
                inliers[pair] = np.asarray(geometry.inlier_matches, dtype=np.int32)
    return inliers


def _write_lenses(database: pycolmap.Database, spec: Mapping[str, Any]) -> list[pycolmap.Camera]:
    """One COLMAP camera for each device, or one for all devices of a picture size."""
    by_size: dict[tuple[int, int], pycolmap.Camera] = {}
    lenses = []
    for number, camera in enumerate(spec["cameras"], start=1):
        size = (camera["width"], camera["height"])
        lens = by_size.get(size) if spec["shared_lens"] and "lens" not in camera else None
        if lens is None:
            lens = _lens(number, camera, spec)
            database.write_camera(lens, use_camera_id=True)
            _write_rig(database, number, lens)
            by_size[size] = lens
        lenses.append(lens)
    return lenses


def _lens(number: int, camera: Mapping[str, Any], spec: Mapping[str, Any]) -> pycolmap.Camera:
    """What is known of it, or a guess."""
    size = (camera["width"], camera["height"])
    if known := camera.get("lens"):
        lens = pycolmap.Camera.create_from_model_name(number, known["model"], max(size), *size)
        lens.params, lens.has_prior_focal_length = known["numbers"], True
        return lens
    return pycolmap.Camera.create_from_model_name(number, spec["lens"], spec["focal_factor"] * max(size), *size)


def _write_rig(database: pycolmap.Database, number: int, lens: pycolmap.Camera) -> None:
    """COLMAP's own rigs hold cameras that move together; ours stand alone, so each gets a rig of one."""
    rig = pycolmap.Rig(rig_id=number)
    rig.add_ref_sensor(lens.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def _write_image(database: pycolmap.Database, number: int, name: str, lens: pycolmap.Camera) -> None:
    image = pycolmap.Image(name=f"{name}.png", camera_id=lens.camera_id, image_id=number)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=number, rig_id=lens.camera_id)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)


def _mapping_options(spec: Mapping[str, Any]) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = min(3, len(spec["cameras"]))
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = spec["seed"]
    options.num_threads = options.mapper.num_threads = spec["threads"]
    options.extract_colors = False
    options.constant_cameras = {number for number, camera in enumerate(spec["cameras"], 1) if "lens" in camera}
    options.mapper.abs_pose_min_num_inliers = 15  # small studio pictures have few features
    return options


def _result(model: pycolmap.Reconstruction | None, models: int) -> dict[str, Any]:
    if model is None:
        return {"models": 0, "registered": [], "points": 0, "reprojection_px": None}
    names = sorted(Path(model.image(number).name).stem for number in model.reg_image_ids())
    error = model.compute_mean_reprojection_error()
    return {"models": models, "registered": names, "points": model.num_points3D(), "reprojection_px": error}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
