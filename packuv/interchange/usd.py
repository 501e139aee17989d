"""OpenUSD: frames as time samples of one ParticleField3DGaussianSplat, by usd-core 26.3 or later (`packuv[usd]`).

Attributes are float32: positions, unit quaternions, standard deviations, alpha, and SH coefficients as 3D Gaussian
Splatting has them, all of a Gaussian after one another. The stage has y up: frames take half a turn about x, in the
numbers. Samples of different lengths are held; those of kept rows have one length within a segment. One frame alone is
written without samples.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import whole_file
from packuv.gaussians.floats import Gaussians, opacity
from packuv.interchange.clip import Clip
from packuv.interchange.conventions import half_turn, is_drawn, rows_out, unit

PRIM = "/scene/gaussians"
REACH = 3.0
"""Standard deviations that a Gaussian takes up in the extent"""


def write_usd(path: Path, clip: Clip) -> int:
    """Write frames at their times and return the number of drawn Gaussians in all of them.

    .usda is text, .usdc and .usd are binary. Raises ValueError where usd-core is missing.
    """
    pxr = _pxr()
    rate, count = float(clip.rate), 0
    with whole_file(path) as partial:
        stage = pxr.Usd.Stage.CreateNew(str(partial))
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetDefaultPrim(pxr.UsdGeom.Xform.Define(stage, PRIM.rpartition("/")[0]).GetPrim())
        prim = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
        codes = np.round(clip.seconds * rate, 6).tolist()
        stage.SetStartTimeCode(codes[0])
        stage.SetEndTimeCode(codes[-1])
        if len(clip) == 1:  # a still has values, which programs read that know no samples
            codes = [pxr.Usd.TimeCode.Default()]
        for code, gaussians in zip(codes, clip, strict=True):
            mask = is_drawn(gaussians)
            _set(pxr, prim, half_turn(rows_out(gaussians, mask, keep_rows=clip.options.keep_rows)), code)
            count += int(mask.sum())
        stage.GetRootLayer().Save()
    return count


def _pxr() -> Any:
    try:
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.UsdVol
        import pxr.Vt
    except ImportError:
        raise ValueError(
            "USD is written by usd-core 26.3 or later, which is not there; pip install 'packuv[usd]'"
        ) from None
    if not hasattr(pxr.UsdVol, "ParticleField3DGaussianSplat"):
        raise ValueError("USD is written by usd-core 26.3 or later, but an older one is there; pip install -U usd-core")
    return pxr


def _set(pxr: Any, prim: Any, kept: Gaussians, code: Any) -> None:
    """One time sample of every attribute, or its value."""
    vectors, vt = pxr.Vt.Vec3fArray, pxr.Vt
    samples = (
        (prim.CreatePositionsAttr(), vectors, kept.means),
        (prim.CreateOrientationsAttr(), vt.QuatfArray, unit(kept.quaternions)[:, [1, 2, 3, 0]]),  # as it lies in memory
        (prim.CreateScalesAttr(), vectors, np.exp(kept.log_scales)),
        (prim.CreateOpacitiesAttr(), vt.FloatArray, opacity(kept)),
        (prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(), vectors, kept.sh.reshape(-1, 3)),
        (prim.CreateExtentAttr(), vectors, _extent(kept)),
    )
    for attribute, kind, values in samples:
        attribute.Set(kind.FromNumpy(np.ascontiguousarray(values, np.float32)), code)
    prim.CreateRadianceSphericalHarmonicsDegreeAttr().Set(kept.sh_degree)


def _extent(kept: Gaussians) -> np.ndarray:
    """Least and greatest corner, [2, 3]."""
    if not len(kept):
        return np.zeros((2, 3))
    reach = REACH * np.exp(kept.log_scales.max(axis=1, keepdims=True))
    return np.stack([(kept.means - reach).min(axis=0), (kept.means + reach).max(axis=0)])
