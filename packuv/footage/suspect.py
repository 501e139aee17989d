"""Whether pictures look like log footage that nobody called so. Nothing in a video tells; its values do.

Log curves put black at 4 to 10 % of the signal and white at about 60 %, so that a scene fills the middle of the range
and is pale. Pictures that were finished for a screen reach black, white or full colours somewhere. Measured on 27 views
of basketball: none as filmed is suspected; recoded as V-Log, C-Log3, LogC3, LogC4 or Log3G10 all are, a stop darker or
brighter, too; as S-Log3 24, and 6 a stop darker. Of 61 photographs of a park, a street and an animal none is.
"""

from __future__ import annotations

import numpy as np

BLACK = 0.06
"""Log's black lies above it, but for that of S-Log3, 0.035, whose dark scenes are missed"""
WHITE = 0.85
"""Lights reach above it only where they are ten times as bright as white"""
SATURATION = 0.22
"""Largest minus smallest channel, in the most colourful hundredth of a picture; photographs recoded as log reach 0.21,
as they are 0.3 and more if they show any colour"""
EDGE = 0.002
"""Share of pixels that may lie beyond: defects, noise, lamps"""


def looks_like_log(picture: np.ndarray) -> bool:
    """Whether a picture, uint8 [H, W, 3] as decoded for a screen, keeps off black, white and full colours."""
    values = picture.reshape(-1, 3)[:: max(1, picture.size // 300_000)].astype(np.float32) / 255  # [n, 3]
    luma = values @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    black, white = np.quantile(luma, [EDGE, 1 - EDGE])
    colour = np.quantile(np.ptp(values, axis=1), 0.99)
    return bool(black > BLACK and white < WHITE and colour < SATURATION)
