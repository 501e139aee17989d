"""Pictures in linear light: the standing room once per camera, then what moves in each picture."""

from __future__ import annotations

import numpy as np

from studio.raycast.kernels import Backdrop, Light, Paints, Shapes, View, fill_backdrop, fill_picture
from studio.srgb import LINEAR
from studio.textures import Textures


def paints(textures: Textures) -> Paints:
    """The part of the textures that the kernels need."""
    return Paints(textures.texels, textures.start, textures.size, LINEAR)


def look_once(view: View, standing: Shapes, light: Light, colours: Paints, *, samples: int) -> Backdrop:
    """What a camera sees of the standing room, with samples x samples rays per pixel on a fixed grid."""
    shape = (view.height, view.width, samples * samples)
    backdrop = Backdrop(
        np.empty(shape, np.float32),
        np.empty((*shape, 3), np.float32),
        np.empty((*shape, 3), np.float32),
        np.empty((*shape, 3), np.float32),
        np.empty(shape[:2]),
        np.empty(shape[:2], np.uint8),
    )
    fill_backdrop(view, standing, light, colours, samples, backdrop)
    return backdrop


def render(
    view: View,
    backdrop: Backdrop,
    standing: Shapes,
    movers: Shapes,
    blockers: np.ndarray,  # float64 [B, 4], balls x y z radius that stand for the movers in ambient light
    light: Light,
    colours: Paints,
) -> np.ndarray:
    """A picture in linear light, float32 [H, W, 3], with the backdrop's samples per pixel.

    Shading: Lambert from the key light with shadows, ambient light with contact occlusion, and a mirror lobe on
    glossy surfaces. Polished ones mirror what stands still, but nothing that moves.
    """
    out = np.empty((view.height, view.width, 3), np.float32)
    fill_picture(view, backdrop, standing, movers, blockers, light, colours, out)
    return out
