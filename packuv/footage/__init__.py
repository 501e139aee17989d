"""Pictures of a capture: decoded on demand, undistorted, and what each camera makes of light."""

from packuv.footage.damage import DamageLog, damage_told, without
from packuv.footage.lens import LensCamera
from packuv.footage.light import Light, LightOptions, measure_light
from packuv.footage.masks import MaskReader, Silhouettes, foreground, laid_over
from packuv.footage.planes import as_planes
from packuv.footage.reader import FrameReader
from packuv.footage.response import Response
from packuv.footage.suspect import looks_like_log
from packuv.footage.transfer import Transfer
from packuv.footage.views import Views
from packuv.footage.watching import WatchingReader

__all__ = [
    "DamageLog",
    "FrameReader",
    "LensCamera",
    "Light",
    "LightOptions",
    "MaskReader",
    "Response",
    "Silhouettes",
    "Transfer",
    "Views",
    "WatchingReader",
    "as_planes",
    "damage_told",
    "foreground",
    "laid_over",
    "looks_like_log",
    "measure_light",
    "without",
]
