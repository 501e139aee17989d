"""The ray caster: pictures in linear light, and what each pixel's centre ray meets and where that goes.

The cameras and most of the room stand still, so what a camera sees of the room is worked out once (`Backdrop`), and
each picture traces only what moves, its shadows, and the light it takes from corners.

Pixels, axes: the centre of the top-left pixel is (0.5, 0.5); camera axes are OpenCV's, x right, y down, z forward.
A ray is centre + t * direction with a direction that has length 1 along the camera's z, so t is depth.
"""

from studio.raycast.kernels import BOX, CONE, CYLINDER, ELLIPSOID, Backdrop, Light, Paints, Shapes, View
from studio.raycast.motion import Hits, Motion, cast, follow
from studio.raycast.pictures import look_once, paints, render
from studio.raycast.tree import item_bounds, tree_over

__all__ = [
    "BOX",
    "CONE",
    "CYLINDER",
    "ELLIPSOID",
    "Backdrop",
    "Hits",
    "Light",
    "Motion",
    "Paints",
    "Shapes",
    "View",
    "cast",
    "follow",
    "item_bounds",
    "look_once",
    "paints",
    "render",
    "tree_over",
]
