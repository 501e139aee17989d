"""What a result has to keep to: limits that decide on findings and on the verdict, and on nothing that is made."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """When a figure is bad enough to say so."""

    matched_share: float = 0.90
    """A camera with frames at fewer instants than this share leaves holes in the fit"""
    drop_share: float = 0.02
    """Missing frames as a share of a camera's timecodes: a network or disk that does not keep up"""
    residual_share: float = 0.25
    """95th percentile of the residuals, in frame periods: beyond it, moving things sit visibly elsewhere"""
    gain: float = 1.25
    """A colour gain above this, or below its inverse, is exposure that differs or a camera that sees little"""
    corner: tuple[float, float] = (0.5, 1.1)
    """Light in the corner as a share of that in the middle, least and most: beyond it hardly a lens, rather points that
    say too little, or light that the scene itself lacks there"""
    exposure_jump: float = 1.1
    """A camera's exposure that changes by more than this factor, or its inverse, at once: its automatic may be on"""
    camera_drop_db: float = 6.0
    """A camera this far below the median camera is calibrated, synchronized or balanced worse than the others"""
    frame_drop_db: float = 3.0
    """A frame whose mean is this far below the median frame: motion that the fit could not follow"""
    psnr_db: float = 20.0
    """A mean ratio below this, on unseen cameras where there are any, shows at a glance: not fit for delivery"""
    fitted_gap_db: float = 8.0
    """Fitted cameras this far above unseen ones at the same frames: the fit repeats what it saw, and other views do not
    gain by it; docs/scores.md has what fits that went too far reach"""
    moving_db: float | None = None
    """Likewise, where something moves; none: moving areas block no delivery"""
    flicker: float | None = None
    """A mean flicker above this blocks a delivery; none: no limit"""
    mb_per_30_frames: float | None = None
    """A larger scene file, 10^6 bytes, blocks a delivery; none: no limit"""
    still_fall_db: float = 0.3
    """A greater fall of still areas in 100 frames: frames explain light and shadow in ways that other cameras refute"""
    dynamic_share: float = 0.5
    """More dynamic Gaussians than this: noise passes for motion, and every frame pays for it"""

    def odd_corner(self, light: float) -> bool:
        """Whether this share of light in the corner is beyond the limits."""
        return not self.corner[0] <= light <= self.corner[1]


LIMITS = Limits()
