"""The web viewer: a local server that hands out a scene's integers, and the page that draws them."""

from packuv.viewer.server import ViewerServer, serve
from packuv.viewer.source import SceneSource, SegmentSource, Source

__all__ = ["SceneSource", "SegmentSource", "Source", "ViewerServer", "serve"]
