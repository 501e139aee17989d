"""Fit Gaussians to pictures of one instant, all from arrays: no capture folder, no store, no workflow engine.

    python examples/fit_one_instant.py OUT.ply

Cameras and pictures are made up here (a cloud of coloured balls, seen from a ring); put your own in their place.
"""

import sys
from pathlib import Path

import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.keyframe import fit_first
from packuv.fit.options import FitOptions
from packuv.fit.start.first import StartOptions, round_gaussians
from packuv.fit.start.shell import ShellOptions
from packuv.footage.lens import LensCamera
from packuv.footage.reader import FrameReader
from packuv.footage.views import Views
from packuv.interchange import write_ply
from packuv.raster import RasterOptions, render


class Arrays(FrameReader):
    def read(self, camera: str, frame: int) -> np.ndarray:  # uint8 [H, W, 3], here from memory, not from a video
        return picture(CAMERAS[camera])


def camera(name: str, a: float) -> PinholeCamera:
    pose = [[np.cos(a), 0, -np.sin(a), 0], [0, 1, 0, 0], [np.sin(a), 0, np.cos(a), 4], [0, 0, 0, 1]]  # from world
    return PinholeCamera(name, 96, 72, fx=110, fy=110, cx=48, cy=36, camera_from_world=np.array(pose))


def picture(camera: PinholeCamera) -> np.ndarray:
    xyz = np.mgrid[-1:2, -1:2, -1:2].reshape(3, -1).T.copy() / 2  # 27 balls
    balls = round_gaussians(xyz, xyz + 0.5, np.full(27, 0.1), opacity=0.9, sh_degree=0)
    colour = render(balls, camera, options=RasterOptions(near=0.1)).colour  # [3, H, W]
    pixels: np.ndarray = np.rint(255 * colour.clip(0, 1)).astype(np.uint8).transpose(1, 2, 0)
    return pixels


if __name__ == "__main__":
    CAMERAS = {f"cam{k}": camera(f"cam{k}", k * np.pi / 4) for k in range(8)}
    nowhere, lenses = dict.fromkeys(CAMERAS, Path()), [LensCamera(camera) for camera in CAMERAS.values()]
    views = Views(nowhere, np.zeros((1, len(lenses)), int), lenses, reader=Arrays(nowhere))
    options = FitOptions(iterations=400, start=StartOptions(count=2000), shell=ShellOptions(enabled=False))
    key = fit_first(views, 0, points=None, options=options)
    print(f"{write_ply(Path(sys.argv[1]), key.gaussians)} Gaussians; {dict(key.figures)}")
