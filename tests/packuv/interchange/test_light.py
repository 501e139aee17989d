"""Frames go to other programs as they are seen in their light: formats of splats know none."""

from __future__ import annotations

import numpy as np
import pytest

from packuv.camera import PinholeCamera
from packuv.colour import lit
from packuv.gaussians.floats import lit_gaussians, rows_of
from packuv.interchange import SplatFormat, read_gaussians, write_gaussians
from packuv.metrics import psnr
from packuv.raster import RasterOptions, render
from tests.support.splats import wall

CAMERA = PinholeCamera("a", 96, 64, 70.0, 70.0, 48.0, 32.0, np.eye(4))
LIGHT = np.array([0.4, -0.3, 0.1])
LEAST_DB = {
    SplatFormat.PLY: 120,
    SplatFormat.COMPRESSED_PLY: 45,
    SplatFormat.SPZ: 40,
    SplatFormat.SPZ_3: 40,
    SplatFormat.SOG: 45,
}
"""Of the lit file against the lit picture of the file in steady light: what 8-bit colours and packed SH cost.

Others hold no SH, or are not read."""


@pytest.mark.parametrize("kind", list(LEAST_DB))
def test_a_lit_frame_comes_back_as_the_lit_picture(tmp_path, kind):
    pictures = []
    for number, gaussians in enumerate((wall(1), lit_gaussians(wall(1), LIGHT))):
        path = tmp_path / f"{number}{kind.suffix}"
        write_gaussians(path, gaussians, kind=kind)
        back = rows_of(read_gaussians(path), slice(None))
        pictures.append(render(back, CAMERA, options=RasterOptions(near=0.1)))
    covered = pictures[0].alpha > 0.999
    assert covered.mean() > 0.9
    steady, seen = (picture.colour[:, covered] for picture in pictures)
    print(kind, psnr(seen, lit(steady[..., None], LIGHT)[..., 0]), psnr(seen, steady))
    assert psnr(seen, lit(steady[..., None], LIGHT)[..., 0]) > LEAST_DB[kind]
    assert psnr(seen, steady) < 30
