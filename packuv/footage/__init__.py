"""Pictures of a capture: decoded on demand, undistorted and balanced in colour."""

from packuv.footage.lens import LensCamera
from packuv.footage.reader import FrameReader
from packuv.footage.views import Views

__all__ = ["FrameReader", "LensCamera", "Views"]
