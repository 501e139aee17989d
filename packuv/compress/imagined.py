"""Cameras of a scene that nobody filmed: rings about what it draws, as who turns it before his eyes would see it."""

from __future__ import annotations

from dataclasses import replace

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import drawn
from packuv.gaussians.orbit import UP, OrbitOptions, around, middle, near_of, orbit
from packuv.scene import Scene, SceneHeader
from packuv.scene.header import ADOPTED

IMAGINED = "imagined"
"""Name of such cameras, and of what a header says of them"""
RINGS = (-30.0, 0.0, 30.0, 60.0)
"""How far above the scene's middle cameras stand, degrees"""
HELD_OUT = 15.0
"""The ring from which nothing is learned: in the middle between two others, its cameras between theirs"""
UNTOLD_UP = (0.0, 0.0, 1.0)
"""World, where a scene says nothing of it: the axis of the UV map, and what the viewer takes for it"""


def looked_at(scene: Scene) -> SceneHeader:
    """A scene's header; of one that nobody filmed with imagined cameras, some of them held out, and what they circle.

    Raises ValueError for such a scene that draws nothing.
    """
    header = scene.header
    if header.filmed:
        return header
    frames = (drawn(scene.gaussians(frame)) for frame in range(len(scene)))
    spheres = [middle(gaussians, share=OrbitOptions.share) for gaussians in frames if len(gaussians)]
    if not spheres:
        raise ValueError(f"{scene.path} must show something to be compressed, but has no Gaussian that is drawn")
    centre, radius = around(spheres)
    up = header.up or (UP if ADOPTED in header.extra else UNTOLD_UP)
    cameras: list[PinholeCamera] = []
    for elevation in (*RINGS, HELD_OUT):
        azimuth = 0 if elevation == HELD_OUT else 180 / OrbitOptions.cameras
        ring = OrbitOptions(elevation_deg=elevation, azimuth_deg=azimuth, up=up)
        cameras += orbit(centre, radius, options=ring, name=IMAGINED, first=len(cameras))
    others = cameras[-OrbitOptions.cameras :]
    said = {"centre": centre.tolist(), "radius": radius, "up": list(up)}
    return replace(
        header,
        cameras=tuple(cameras),
        held_out=tuple(camera.name for camera in others),
        extra={"near": near_of(tuple(others)), **header.extra, IMAGINED: said},
    )
