"""The web viewer: a local server that hands out a scene's integers, and the page that draws them."""

from packuv.viewer.folder import WebOptions, WebSummary, write_web
from packuv.viewer.server import ViewerServer, serve
from packuv.viewer.source import SceneSource, SegmentSource, Source
from packuv.viewer.streams import WebCodec

__all__ = [
    "SceneSource",
    "SegmentSource",
    "Source",
    "ViewerServer",
    "WebCodec",
    "WebOptions",
    "WebSummary",
    "serve",
    "write_web",
]
