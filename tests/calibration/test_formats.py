"""Formats of data sets and programs: a rig written as they publish it, by writers of our own, is read back equal."""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibration.importers import find_calibration, load_rig
from calibration.rig import Camera, Rig
from tests.support.calibration_scene import arc, look_at

# Poses pass through rotation vectors, quaternions or angles and their inverses, at distances of a few units: a few
# roundings of float64, and as many of what a matrix's own orthogonality lacks.
POSE_TOLERANCE = 1e-9
# Principal points pass through shares of a width, or half a pixel is taken and given.
PIXEL_TOLERANCE = 1e-9

OPENGL = np.diag([1.0, -1.0, -1.0])
CORNER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""Of OpenCV's pixels, whose first has its centre at (0, 0)"""


def quaternion(camera: Camera) -> list[float]:
    return Rotation.from_matrix(camera.camera_from_world[:3, :3]).as_quat()[[3, 0, 1, 2]].tolist()


def turn(camera: Camera) -> np.ndarray:
    return camera.camera_from_world[:3, :3]


def shift(camera: Camera) -> np.ndarray:
    return camera.camera_from_world[:3, 3]


def terms(camera: Camera, count: int) -> list[float]:
    return [*camera.distortion, *(0.0,) * 8][:count]


def numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


# Writers, each by the format as its makers publish it


def write_brics(rig: Rig, folder: Path) -> None:
    names = "cam_id width height fx fy cx cy k1 k2 p1 p2 cam_name qvecw qvecx qvecy qvecz tvecx tvecy tvecz"
    rows = [
        f"{k} {c.width} {c.height} {numbers([c.fx, c.fy, c.cx, c.cy, *terms(c, 4)])} {c.name} "
        f"{numbers([*quaternion(c), *shift(c)])}"
        for k, c in enumerate(rig.cameras, 1)
    ]
    (folder / "params.txt").write_text("\n".join([f"# {names}", *rows]) + "\n")


def write_meta(rig: Rig, folder: Path) -> None:
    """Two cameras are held out; every instant lists all cameras again."""
    for name, cameras in (("test_meta.json", rig.cameras[:2]), ("train_meta.json", rig.cameras[2:])):
        data = {
            "w": rig.cameras[0].width,
            "h": rig.cameras[0].height,
            "k": [[c.matrix.tolist() for c in cameras]] * 3,
            "w2c": [[c.camera_from_world.tolist() for c in cameras]] * 3,
            "fn": [[f"{c.name}/{instant:06d}.jpg" for c in cameras] for instant in range(3)],
            "cam_id": [[int(c.name) for c in cameras]] * 3,
        }
        (folder / name).write_text(json.dumps(data))


def write_toolbox(rig: Rig, folder: Path) -> None:
    cameras = [
        {
            "name": c.name,
            "type": "hd",
            "resolution": [c.width, c.height],
            "K": (c.matrix - CORNER).tolist(),
            "distCoef": terms(c, 5),
            "R": turn(c).tolist(),
            "t": shift(c)[:, None].tolist(),
        }
        for c in rig.cameras
    ]
    (folder / "calibration_160906_band.json").write_text(json.dumps({"calibDataSource": "x", "cameras": cameras}))


def write_technicolor(rig: Rig, folder: Path) -> None:
    rows = [numbers([c.fx, c.cx, c.cy, 1, 0, *quaternion(c), *shift(c)]) for c in rig.cameras]
    (folder / "cameras_parameters.txt").write_text("\n".join(["f cx cy a b qw qx qy qz tx ty tz", *rows]) + "\n")


def write_immersive(rig: Rig, folder: Path) -> None:
    models = [
        {
            "name": c.name,
            "projection_type": "fisheye",
            "width": float(c.width),
            "height": float(c.height),
            "focal_length": c.fx,
            "principal_point": [c.cx, c.cy],
            "radial_distortion": terms(c, 3),
            "orientation": Rotation.from_matrix(turn(c)).as_rotvec().tolist(),
            "position": c.centre.tolist(),
        }
        for c in rig.cameras
    ]
    (folder / "models.json").write_text(json.dumps(models))


def write_actorshq(rig: Rig, folder: Path) -> None:
    rows = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
    for c in rig.cameras:
        vector = Rotation.from_matrix(turn(c).T).as_rotvec()
        inner = (c.fx / c.width, c.fy / c.height, c.cx / c.width, c.cy / c.height)
        rows.append(f"{c.name},{c.width},{c.height},{','.join(numbers([*vector, *c.centre, *inner]).split())}")
    (folder / "calibration.csv").write_text("\r\n".join(rows) + "\r\n")


SCALE = 120 / 65


def write_mvhumannet(rig: Rig, folder: Path) -> None:
    first = rig.cameras[0]
    (folder / "camera_intrinsics.json").write_text(json.dumps({"intrinsics": (first.matrix - CORNER).tolist()}))
    poses = {
        f"{k}_{c.name}.png": {"rotation": turn(c).tolist(), "translation": (shift(c) / SCALE).tolist()}
        for k, c in enumerate(rig.cameras)
    }
    (folder / "camera_extrinsics.json").write_text(json.dumps(poses))
    (folder / "camera_scale.pkl").write_bytes(pickle.dumps(np.float64(SCALE)))


def write_smc(rig: Rig, folder: Path) -> None:
    import h5py

    with h5py.File(folder / "0007_01_annots.smc", "w") as data:
        for c in rig.cameras:
            pose = np.linalg.inv(c.camera_from_world)
            parts = {"K": c.matrix - CORNER, "D": np.array(terms(c, 5)), "RT": pose, "Color_Calibration": np.eye(3)}
            for key, value in parts.items():
                data[f"Camera_Parameter/{c.name}/{key}"] = value


def write_easyvolcap(rig: Rig, folder: Path) -> None:
    """As published, without H and W."""
    intri = ["%YAML:1.0", "---", "names:", *(f'  - "{c.name}"' for c in rig.cameras)]
    extri = ["%YAML:1.0", "---"]

    def matrix(key: str, value: np.ndarray) -> list[str]:
        flat = ", ".join(repr(float(number)) for number in value.ravel())
        head = f"   rows: {value.shape[0]}", f"   cols: {value.shape[1]}", "   dt: d", f"   data: [ {flat} ]"
        return [f"{key}: !!opencv-matrix", *head]

    for c in rig.cameras:
        intri += matrix(f"K_{c.name}", c.matrix - CORNER) + matrix(f"D_{c.name}", np.array(terms(c, 5))[:, None])
        vector = Rotation.from_matrix(turn(c)).as_rotvec()[:, None]
        extri += matrix(f"R_{c.name}", vector) + matrix(f"T_{c.name}", shift(c)[:, None])
    (folder / "intri.yml").write_text("\n".join(intri) + "\n")
    (folder / "extri.yml").write_text("\n".join(extri) + "\n")


def write_anipose(rig: Rig, folder: Path) -> None:
    write_board(rig, folder / "calibration.toml", [f"cam_{k}" for k in range(len(rig.cameras))])


def write_pose2sim(rig: Rig, folder: Path) -> None:
    write_board(rig, folder / "Calib_scene.toml", [f"int_{c.name}_img" for c in rig.cameras])


def write_board(rig: Rig, path: Path, sections: Sequence[str]) -> None:
    text = ""
    for c, section in zip(rig.cameras, sections, strict=True):
        text += (
            f'[{section}]\nname = "{c.name}"\nsize = [ {float(c.width)}, {float(c.height)},]\n'
            f"matrix = {(c.matrix - CORNER).tolist()}\ndistortions = {terms(c, 4 if c.fisheye else 5)}\n"
            f"rotation = {Rotation.from_matrix(turn(c)).as_rotvec().tolist()}\n"
            f"translation = {shift(c).tolist()}\nfisheye = {str(c.fisheye).lower()}\n\n"
        )
    path.write_text(text + "[metadata]\nadjusted = false\nerror = 0.0\n")


def write_qualisys(rig: Rig, folder: Path) -> None:
    """Sensors show a part of 200, 100 pixels on; rows of the rotation are the camera's axes right, up, back."""
    text = '<?xml version="1.0"?>\n<calibration created="2024"><cameras>\n<camera serial="1" model="Miqus M3"/>\n'
    for c in rig.cameras:
        m, (x, y, z) = OPENGL @ turn(c), c.centre
        lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), terms(c, 5), strict=True))
        rotation = " ".join(f'r{i + 1}{j + 1}="{float(m[i, j])!r}"' for i in range(3) for j in range(3))
        text += (
            f'<camera serial="{c.name}" model="Miqus Video" video_resolution="1080p" avg-residual="0.5">\n'
            f'<fov_video left="200" right="{199 + c.width}" top="100" bottom="{99 + c.height}"/>\n'
            f'<transform x="{float(x)!r}" y="{float(y)!r}" z="{float(z)!r}" {rotation}/>\n'
            f'<intrinsic focalLengthU="{64 * c.fx!r}" focalLengthV="{64 * c.fy!r}" '
            f'centerPointU="{64 * (c.cx - 0.5 + 200)!r}" centerPointV="{64 * (c.cy - 0.5 + 100)!r}" skew="0" '
            f'radialDistortion1="{lens["k1"]!r}" radialDistortion2="{lens["k2"]!r}" radialDistortion3="{lens["k3"]!r}" '
            f'tangentalDistortion1="{lens["p1"]!r}" tangentalDistortion2="{lens["p2"]!r}"/>\n</camera>\n'
        )
    (folder / "session.qca.txt").write_text(text + "</cameras></calibration>\n")


def write_metashape(rig: Rig, folder: Path) -> None:
    sensors, cameras = "", ""
    for k, c in enumerate(rig.cameras):
        kind, t = "fisheye" if c.fisheye else "frame", dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
        if c.fisheye:
            t.update(zip(("k1", "k2", "k3", "k4"), c.distortion, strict=True))
        else:  # its p1 is what OpenCV calls p2
            t.update(zip(("k1", "k2", "p2", "p1", "k3"), terms(c, 5), strict=True))
        inner = {"f": c.fy, "b1": c.fx - c.fy, "cx": c.cx - c.width / 2, "cy": c.cy - c.height / 2, **t}
        sides = f'<resolution width="{c.width}" height="{c.height}"/>'
        sensors += (
            f'<sensor id="{k}" label="x" type="{kind}">{sides}'
            f'<calibration type="{kind}" class="initial">{sides}<f>1</f></calibration>'
            f'<calibration type="{kind}" class="adjusted">{sides}'
            f"{''.join(f'<{key}>{value!r}</{key}>' for key, value in inner.items())}</calibration></sensor>\n"
        )
        pose = np.linalg.inv(c.camera_from_world)
        cameras += (
            f'<camera id="{k}" sensor_id="{k}" component_id="0" label="{c.name}">'
            f"<transform>{numbers(pose.ravel())}</transform></camera>\n"
        )
    text = f'<document version="1.5.0"><chunk label="c"><sensors>{sensors}</sensors><cameras>{cameras}'
    text += '<camera id="99" sensor_id="0" label="not aligned"/></cameras></chunk></document>'
    (folder / "cameras.xml").write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n')


def write_realityscan(rig: Rig, folder: Path) -> None:
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for c in rig.cameras:
        # intrinsic turns about z, x, y of a camera with OpenGL's axes; the heading goes clockwise
        z, x, y = Rotation.from_matrix(turn(c).T @ OPENGL).as_euler("ZXY", degrees=True)
        side, (k1, k2, p1, p2, k3) = max(c.width, c.height), terms(c, 5)
        inner = (36 * c.fx / side, (c.cx - c.width / 2) / side, (c.cy - c.height / 2) / side, k1, k2, k3, 0, p1, p2)
        rows.append(f"{c.name}.jpg,{','.join(numbers([*c.centre, -z, x, y, *inner]).split())}")
    (folder / "cams.csv").write_text("\n".join(rows) + "\n")


@dataclass(frozen=True)
class Written:
    """A format, and what it can hold."""

    write: Callable[[Rig, Path], None]
    names: Callable[[int], str] = "cam{:02d}".format
    most_terms: int = 5
    one_focal: bool = False
    fisheye: bool = False
    size: tuple[int, int] = (640, 360)
    metric: bool = False
    shared: bool = False
    """One lens for all, with its centre near the middle"""

    def rig(self, lens: tuple[float, ...] = (0.05, -0.03, 0.002, -0.001, 0.01)) -> Rig:
        """Cameras at several heights, tilted and rolled."""
        terms = (0.05, -0.03, 0.01, 0.0) if self.fisheye else lens[: self.most_terms]
        cameras = []
        for k, camera in enumerate(arc(5, size=self.size, span_deg=200).cameras):
            rolled = np.eye(4)
            rolled[:3, :3] = cv2.Rodrigues(np.array([0.05 * k, 0.1, 0.4 * k - 0.7]))[0]
            own = replace(
                camera,
                name=self.names(k),
                camera_from_world=rolled @ camera.camera_from_world,
                distortion=terms,
                fisheye=self.fisheye,
                fx=camera.fx + (0 if self.shared else k),
                cy=camera.cy + (0 if self.shared else k),
            )
            cameras.append(replace(own, fy=own.fx) if self.one_focal else own)
        return Rig(tuple(cameras), "written")


FORMATS = {
    "brics": Written(write_brics, "rig-00{}_cam0".format, most_terms=4),
    "meta": Written(write_meta, "{}".format, most_terms=0),
    "toolbox": Written(write_toolbox, "00_{:02d}".format, size=(1920, 1080)),
    "technicolor": Written(write_technicolor, "Birthday_cam{:02d}".format, most_terms=0, one_focal=True),
    "immersive": Written(write_immersive, "camera_{:04d}".format, one_focal=True, fisheye=True),
    "actorshq": Written(write_actorshq, "Cam{:03d}".format, most_terms=0, metric=True),
    "mvhumannet": Written(write_mvhumannet, "CC32871A{:03d}".format, most_terms=0, size=(4096, 3000), shared=True),
    "smc": Written(write_smc, "{:02d}".format, size=(2448, 2048)),
    "easyvolcap": Written(write_easyvolcap, "{:02d}".format),
    "anipose": Written(write_anipose, "c{:04d}".format),
    "anipose fisheye": Written(write_anipose, "c{:04d}".format, fisheye=True),
    "pose2sim": Written(write_pose2sim),
    "qualisys": Written(write_qualisys, "2402{}".format),
    "metashape": Written(write_metashape),
    "metashape fisheye": Written(write_metashape, fisheye=True),
    "realityscan": Written(write_realityscan, one_focal=True),
}


def sizes(rig: Rig) -> dict[str, tuple[int, int]]:
    return {camera.name: (camera.width, camera.height) for camera in rig.cameras}


@pytest.mark.parametrize("name", FORMATS)
def test_a_rig_is_read_back(tmp_path, name):
    written = FORMATS[name]
    rig = written.rig()
    written.write(rig, tmp_path)
    for source in (tmp_path, find_calibration(tmp_path).file):
        loaded = load_rig(source, rig.names, sizes(rig))
        assert loaded.metric is written.metric
        check_same(loaded, rig)
    fewer = load_rig(tmp_path, rig.names[1:3], sizes(rig)) if name != "technicolor" else None
    assert fewer is None or fewer.names == rig.names[1:3]
    assert not find_calibration(tmp_path).strays(tmp_path)


def check_same(loaded: Rig, rig: Rig) -> None:
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3)) + np.array([0, 0.2, 3])
    assert loaded.names == rig.names
    for a, b in zip(loaded.cameras, rig.cameras, strict=True):
        assert (a.width, a.height, a.fisheye) == (b.width, b.height, b.fisheye)
        assert np.allclose(a.distortion, b.distortion, atol=1e-15)
        assert np.allclose(a.matrix, b.matrix, rtol=0, atol=PIXEL_TOLERANCE)
        assert np.allclose(a.camera_from_world, b.camera_from_world, rtol=0, atol=POSE_TOLERANCE)
        assert np.allclose(a.project(points)[0], b.project(points)[0], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused(tmp_path, name, data):
    written = FORMATS[name]
    folder = tmp_path / str(len(list(tmp_path.iterdir())))
    folder.mkdir()
    written.write(written.rig(), folder)
    file = data.draw(st.sampled_from(sorted(folder.iterdir())))
    whole = file.read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1))
    end = data.draw(st.sampled_from([at + 1, at + 4, len(whole)]))
    junk = data.draw(
        st.sampled_from([b"", b"nan", b"1e999", b"-", b"\x00", b"\xff\xfe", b"[", b"}", b'"', b"<", b"9" * 400])
    )
    file.write_bytes(whole[:at] + junk + whole[end:])
    with suppress(ValueError, FileNotFoundError):
        load_rig(folder, written.rig().names, sizes(written.rig()))


# What formats mean, with numbers by hand


def test_actorshq_stands_where_it_says_and_looks_ahead(tmp_path):
    (tmp_path / "calibration.csv").write_text(
        "name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py\nCam001,1000,500,0,1.5707963267948966,0,-2,0,0,0.9,1.8,0.5,0.4\n"
    )
    camera = load_rig(tmp_path).cameras[0]
    assert np.allclose(camera.centre, (-2, 0, 0))
    assert np.allclose(camera.forward, (1, 0, 0))  # turned by a quarter about y, which points down
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (900, 900, 500, 200)


def test_immersive_turns_from_the_world(tmp_path):
    model = {
        "name": "camera_0001",
        "projection_type": "fisheye",
        "width": 2560,
        "height": 1920,
        "focal_length": 1260.0,
        "principal_point": [1280.0, 960.0],
        "radial_distortion": [0.0, 0.0, 0.0],
        "orientation": [0.0, 0.1, 0.0],
        "position": [0.2, 0.0, -2.0],
    }
    (tmp_path / "models.json").write_text(json.dumps([model]))
    camera = load_rig(tmp_path).cameras[0]
    assert np.allclose(camera.centre, (0.2, 0, -2))
    pixels, _ = camera.project(np.array([[0.2, 0.0, 0.0]]))  # straight ahead in the world: 0.1 rad to the right
    assert np.allclose(pixels, [[1280 + 1260 * 0.1, 960]])


@pytest.mark.parametrize(
    ("heading", "pitch", "forward"),
    [(0, 0, (0, 0, -1)), (0, 90, (0, 1, 0)), (90, 90, (1, 0, 0)), (180, 90, (0, -1, 0))],
)
def test_realityscan_looks_down_north_east_south(tmp_path, heading, pitch, forward):
    text = f"#name,x,y,alt,heading,pitch,roll,f\na.jpg,1,2,3,{heading},{pitch},0,18\n"
    (tmp_path / "cameras.csv").write_text("#cameras 1\n" + text)
    camera = load_rig(tmp_path, ["a"], {"a": (400, 600)}).cameras[0]
    assert np.allclose(camera.centre, (1, 2, 3))
    assert np.allclose(camera.forward, forward)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (300, 300, 200, 300)  # half the longer side


def test_qualisys_looks_along_its_third_axis_backwards(tmp_path):
    camera = Camera("24020", 640, 360, 500.0, 500.0, 320.0, 180.0, look_at((1000, -500, -3000), (0, 0, 0)))
    write_qualisys(Rig((camera,), ""), tmp_path)
    loaded = load_rig(tmp_path).cameras[0]
    assert np.allclose(loaded.centre, (1000, -500, -3000))
    assert np.allclose(loaded.forward, np.array([-1000, 500, 3000]) / math.sqrt(1e6 + 25e4 + 9e6))
    text = (tmp_path / "session.qca.txt").read_text()
    (tmp_path / "session.qca.txt").write_text(text.replace("1080p", "540p"))
    half = load_rig(tmp_path).cameras[0]
    assert (half.width, half.height, half.fx) == (320, 180, 250)


# Names


def test_sections_of_pose2sim_and_names_of_anipose(tmp_path):
    rig = FORMATS["anipose"].rig()
    write_anipose(rig, tmp_path)
    assert load_rig(tmp_path).names == rig.names
    assert load_rig(tmp_path, ["cam_0", "cam_3"]).names == ("cam_0", "cam_3")  # of tables, where no name fits
    with pytest.raises(ValueError, match=r"videos without one: cam_3; the file's cameras: c0000, c0001"):
        load_rig(tmp_path, ["c0000", "cam_3"])
    (tmp_path / "calibration.toml").write_text('[metadata]\nnote = "a matrix"\n')
    with pytest.raises(ValueError, match=r"has a table for each camera with size, matrix.*\['metadata'\]"):
        load_rig(tmp_path)


def test_a_table_called_like_another_camera_stands_for_none(tmp_path):
    """Pose2Sim counts cameras from 1, aniposelib's tables from 0."""
    written = replace(FORMATS["anipose"], names=lambda k: f"cam_{k + 1}")
    write_anipose(written.rig(), tmp_path)
    check_same(load_rig(tmp_path, [f"cam_{k}" for k in range(1, 6)]), written.rig())
    with pytest.raises(ValueError, match="videos without one: cam_0; the file's cameras: cam_1"):
        load_rig(tmp_path, ["cam_0", "cam_1"])
    text = (tmp_path / "calibration.toml").read_text()
    (tmp_path / "calibration.toml").write_text(text.replace("matrix", "K", 1))
    with pytest.raises(ValueError, match="camera cam_1 needs the key matrix, but has"):
        load_rig(tmp_path)


@pytest.mark.parametrize("names", ["{}", "{:02d}", "cam{:02d}", "cam_{}", "camera_{:04d}"])
def test_numbered_cameras_may_be_called_in_many_ways(tmp_path, names):
    rig = Rig(tuple(replace(c, name=str(k)) for k, c in enumerate(FORMATS["meta"].rig().cameras, 8)), "")
    write_meta(rig, tmp_path)
    videos = [names.format(k) for k in range(8, 13)]
    assert load_rig(tmp_path, videos).names == tuple(videos)


@pytest.mark.parametrize("listed", ["", "names:\n  - 00\n  - 01\n  - 02\n  - 03\n  - 04\n"])
def test_easyvolcaps_names_may_be_missing_or_look_like_numbers(tmp_path, listed):
    rig = FORMATS["easyvolcap"].rig()
    write_easyvolcap(rig, tmp_path)
    head, rest = (tmp_path / "intri.yml").read_text().split("K_", 1)
    (tmp_path / "intri.yml").write_text(f"{head.split('names')[0]}{listed}K_{rest}")
    check_same(load_rig(tmp_path, rig.names, sizes(rig)), rig)


def test_rows_without_names_go_in_natural_order(tmp_path):
    written = replace(FORMATS["technicolor"], names="cam{}".format)
    rig = written.rig()
    ordered = Rig(tuple(replace(c, name=f"cam{k + 7}") for k, c in enumerate(rig.cameras)), "")  # cam7 to cam11
    write_technicolor(ordered, tmp_path)
    check_same(load_rig(tmp_path, ordered.names, sizes(ordered)), ordered)


@pytest.mark.parametrize("name", ["easyvolcap", "realityscan"])
def test_what_gives_no_size_asks_for_the_videos(tmp_path, name):
    rig = FORMATS[name].rig()
    FORMATS[name].write(rig, tmp_path)
    with pytest.raises(ValueError, match="size"):
        load_rig(tmp_path, rig.names)
    if name == "easyvolcap":
        with pytest.raises(ValueError, match="outside its video of 160x90: the file must say at which size"):
            load_rig(tmp_path, rig.names, dict.fromkeys(rig.names, (160, 90)))


def test_technicolor_has_its_published_size_where_videos_are_smaller(tmp_path):
    rig = replace(FORMATS["technicolor"], size=(2048, 1088)).rig()
    write_technicolor(rig, tmp_path)
    assert load_rig(tmp_path, rig.names, dict.fromkeys(rig.names, (1024, 544))).cameras[0].width == 2048


def test_a_pickle_that_would_run_code_is_refused(tmp_path):
    written = FORMATS["mvhumannet"]
    written.write(written.rig(), tmp_path)
    (tmp_path / "camera_scale.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(ValueError, match=r"camera_scale\.pkl must hold a number, but asks for os\.system"):
        load_rig(tmp_path)
    (tmp_path / "camera_scale.pkl").write_bytes(pickle.dumps(SCALE))
    check_same(load_rig(tmp_path, written.rig().names), written.rig())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<k4>0.0", "<k4>0.1"), "frame lens with k4 has no counterpart"),
        (('type="frame"', 'type="spherical"'), "spherical lens has no counterpart"),
        (('component_id="0" label="cam01"', 'component_id="1" label="cam01"'), "aligned in 2 pieces"),
        (("</f>", "</f><b2>50</b2>"), "b2 is 50.0; optimize without b2"),
        (("</f>", "</f><p4>0.01</p4>"), "p3 and p4 have no counterpart"),
    ],
)
def test_metashape_models_without_a_counterpart_are_refused(tmp_path, change, message):
    FORMATS["metashape"].write(FORMATS["metashape"].rig(), tmp_path)
    path = tmp_path / "cameras.xml"
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(ValueError, match=message):
        load_rig(tmp_path)
