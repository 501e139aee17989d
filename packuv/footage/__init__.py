"""Pictures of a capture: decoded on demand, undistorted and balanced in colour."""

from packuv.footage.lens import LensCamera
from packuv.footage.reader import FrameReader
from packuv.footage.suspect import looks_like_log
from packuv.footage.transfer import Transfer
from packuv.footage.views import Views

__all__ = ["FrameReader", "LensCamera", "Transfer", "Views", "looks_like_log"]
