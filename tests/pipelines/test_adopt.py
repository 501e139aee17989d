"""Published data sets become captures by links; nothing in them changes."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.exporters import write_colmap, write_poses_bounds
from calibration.importers import load_rig
from calibration.rig import Rig
from pipelines.adopt import adopt, find_scenes
from pipelines.cli import main
from sync.capture import find_capture
from tests.support.calibration_scene import ring

MODEL = {
    "projection_type": "fisheye",
    "width": 640,
    "height": 480,
    "focal_length": 315.0,
    "principal_point": [320.0, 240.0],
    "radial_distortion": [0.0, 0.0, 0.0],
    "orientation": [0.0, 0.0, 0.0],
    "position": [0.0, 0.0, 0.0],
}


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")


def n3dv(folder: Path) -> None:
    touch(*(folder / f"cam{k:02d}.mp4" for k in (0, 1, 2, 10)))
    plain = (replace(c, name=f"cam{k:02d}") for k, c in zip((0, 1, 2, 10), ring(4).cameras, strict=True))
    write_poses_bounds(Rig(tuple(plain), ""), folder / "poses_bounds.npy", np.ones((4, 2)))


def immersive(folder: Path) -> None:
    touch(*(folder / f"camera_{k:04d}.mp4" for k in (1, 2, 3)))
    (folder / "models.json").write_text(json.dumps([{"name": f"camera_{k:04d}", **MODEL} for k in (1, 2, 3)]))


def panoptic(folder: Path) -> None:
    for k in range(4):
        touch(folder / f"ims/{k}/000000.jpg", folder / f"seg/{k}/000000.png")
    for name, chosen in (("train", (0, 1, 3)), ("test", (2,))):
        own = [ring(4).cameras[k] for k in chosen]
        data = {"w": 640, "h": 360, "cam_id": [list(chosen)], "fn": [[f"{k}/000000.jpg" for k in chosen]]}
        data |= {"k": [[c.matrix.tolist() for c in own]], "w2c": [[c.camera_from_world.tolist() for c in own]]}
        (folder / f"{name}_meta.json").write_text(json.dumps(data))


def technicolor(folder: Path) -> None:
    touch(*(folder / f"Birthday_undist_{frame:05d}_{k:02d}.png" for frame in (151, 152) for k in range(3)))
    rows = "\n".join("1800 1024 544 1 0 1 0 0 0 0 0 2" for _ in range(3))
    (folder / "cameras_parameters.txt").write_text(f"header\n{rows}\n")


def actorshq(folder: Path) -> None:
    rows = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
    for k in (1, 2):
        touch(
            folder / f"rgbs/Cam{k:03d}/Cam{k:03d}_rgb000000.jpg", folder / f"masks/Cam{k:03d}/Cam{k:03d}_mask000000.png"
        )
        rows.append(f"Cam{k:03d},1028,752,0,0,0,0,0,{k},0.9,1.2,0.5,0.5")
    (folder / "calibration.csv").write_text("\n".join(rows) + "\n")


def brics(folder: Path) -> None:
    header = "# cam_id width height fx fy cx cy k1 k2 p1 p2 cam_name qvecw qvecx qvecy qvecz tvecx tvecy tvecz"
    rows = [f"{k} 64 48 50 50 32 24 0 0 0 0 rev1-00{k}_cam0 1 0 0 0 0 0 {k}" for k in (1, 2)]
    for k in (1, 2):
        stem = f"rev1-00{k}_cam0_1734551081929245"
        touch(folder / f"{stem}.mp4", folder / f"{stem}.txt")
    (folder / "calib").mkdir()
    (folder / "calib/params.txt").write_text("\n".join([header, *rows]) + "\n")


def colmap(folder: Path) -> None:
    touch(*(folder / f"videos/cam{k:02d}.mp4" for k in range(3)))
    write_colmap(ring(3), folder / "sparse/0")


LAYOUTS = {
    "n3dv": (n3dv, ["cam00", "cam01", "cam02", "cam10"], ("cam00",)),
    "immersive": (immersive, ["camera_0001", "camera_0002", "camera_0003"], ("camera_0001",)),
    "panoptic": (panoptic, ["0", "1", "2", "3"], ("2",)),
    "technicolor": (technicolor, ["cam00", "cam01", "cam02"], ()),
    "actorshq": (actorshq, ["Cam001", "Cam002"], ()),
    "brics": (brics, ["rev1-001_cam0", "rev1-002_cam0"], ()),
    "colmap": (colmap, ["cam00", "cam01", "cam02"], ()),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_published_layout_becomes_a_capture_whose_calibration_reads(tmp_path, layout):
    make, cameras, held_out = LAYOUTS[layout]
    make_in = tmp_path / "set" / "day one" / "take#1"
    make_in.mkdir(parents=True)
    make(make_in)
    before = sorted(path for path in (tmp_path / "set").rglob("*"))
    (scene,) = find_scenes(tmp_path / "set")
    assert (scene.name, list(scene.cameras), scene.held_out) == ("day one-take-1", cameras, held_out)
    for _ in range(2):  # again changes nothing
        folder = adopt(scene, tmp_path / "captures")
    assert sorted(path for path in (tmp_path / "set").rglob("*")) == before
    assert sorted(path.stem for path in (folder / "videos").iterdir()) == sorted(cameras)
    assert all(path.resolve().exists() for path in folder.rglob("*"))
    settings = tomllib.loads((folder / "capture.toml").read_text())
    assert settings == {"name": "day one-take-1", **({"held_out": list(held_out)} if held_out else {})}
    sizes = dict.fromkeys(cameras, (2048, 1088))
    assert load_rig(folder / "calibration", cameras, sizes).names == tuple(cameras)
    capture = find_capture(folder)
    assert list(capture.videos) == cameras
    assert capture.settings.held_out == held_out
    assert capture.calibration is not None
    assert len(capture.timecodes) == (2 if layout == "brics" else 0)
    assert len(list((folder / "masks").glob("*"))) == {"panoptic": 4, "actorshq": 2}.get(layout, 0)


def test_the_command_makes_a_capture_of_every_scene(tmp_path, capsys):
    for name in ("coffee", "flame"):
        (tmp_path / "n3dv" / name).mkdir(parents=True)
        n3dv(tmp_path / "n3dv" / name)
    assert main(["adopt", str(tmp_path / "n3dv"), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)["captures"]
    assert [Path(row["capture"]).relative_to(tmp_path).parts for row in made] == [
        ("n3dv-captures", "coffee"),
        ("n3dv-captures", "flame"),
    ]
    assert [(row["cameras"], row["held_out"]) for row in made] == [(4, ["cam00"])] * 2
    assert main(["adopt", str(tmp_path / "n3dv"), "--out", str(tmp_path / "n3dv/inside")]) == 2
    assert "must not lie in the data set" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["adopt", str(tmp_path / "empty")]) == 2
    assert "holds no scene" in capsys.readouterr().err
    assert main(["adopt", str(tmp_path / "n3dv/coffee"), "--out", str(tmp_path / "other")]) == 0


def test_masks_of_none_of_the_cameras_are_named(tmp_path, capsys):
    colmap(tmp_path / "set")
    touch(tmp_path / "set/Mask/cam01.mp4", tmp_path / "set/silhouettes/left/000000.png")
    assert main(["adopt", str(tmp_path / "set"), "--out", str(tmp_path / "out")]) == 0
    assert [path.name for path in (tmp_path / "out/set/masks").iterdir()] == ["cam01.mp4"]
    assert "set: silhouettes seems to hold masks, but of none of its cameras" in capsys.readouterr().out.replace(
        "\n", " "
    )


def test_what_is_in_the_way_stays(tmp_path):
    (tmp_path / "set").mkdir()
    n3dv(tmp_path / "set")
    touch(tmp_path / "out/set/videos/cam01.mp4")
    with pytest.raises(FileExistsError, match=r"cam01\.mp4 is in the way of a link"):
        adopt(find_scenes(tmp_path / "set")[0], tmp_path / "out")
