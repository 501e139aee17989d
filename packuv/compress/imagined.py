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
CLOSE, WHOLE = OrbitOptions(), OrbitOptions(size=(480, 480), share=0.995)
"""The scene's middle large in the picture, and all of it but strays from further away"""
RINGS = ((-30.0, CLOSE), (0.0, CLOSE), (30.0, CLOSE), (60.0, CLOSE), (-15.0, WHOLE), (45.0, WHOLE))
"""How far above the scene's middle cameras stand, degrees"""
HELD_OUT = (15.0, CLOSE)
"""The ring from which nothing is learned: in the middle between two others, its cameras between theirs"""
FRAMES = 30
"""In which the scene is looked for at most, spread evenly"""
UNTOLD_UP = (0.0, 0.0, 1.0)
"""World, where a scene says nothing of it: the axis of the UV map, and what the viewer takes for it"""


def looked_at(scene: Scene) -> SceneHeader:
    """A scene's header; of one that nobody filmed with imagined cameras, some of them held out, and what they circle.

    Raises ValueError for such a scene that draws nothing.
    """
    header = scene.header
    if header.filmed:
        return header
    shown = (drawn(scene.gaussians(frame)) for frame in range(0, len(scene), -(-len(scene) // FRAMES)))
    spheres = [[middle(g, share=look.share) for look in (CLOSE, WHOLE)] for g in shown if len(g)]
    if not spheres:
        raise ValueError(f"{scene.path} must show something to be compressed, but has no Gaussian that is drawn")
    reach = dict(zip((CLOSE, WHOLE), map(around, zip(*spheres, strict=True)), strict=True))
    up = header.up or (UP if ADOPTED in header.extra else UNTOLD_UP)
    cameras: list[PinholeCamera] = []
    for elevation, look in (*RINGS, HELD_OUT):
        azimuth = 0 if (elevation, look) == HELD_OUT else 180 / look.cameras
        ring = replace(look, elevation_deg=elevation, azimuth_deg=azimuth, up=up)
        cameras += orbit(*reach[look], options=ring, name=IMAGINED, first=len(cameras))
    others = tuple(cameras[-CLOSE.cameras :])
    told = {"up": list(up), "spheres": [[centre.tolist(), radius] for centre, radius in reach.values()]}
    return replace(
        header,
        cameras=tuple(cameras),
        held_out=tuple(camera.name for camera in others),
        extra={"near": near_of(others), **header.extra, IMAGINED: told},
    )
