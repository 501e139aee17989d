"""The UV atlas as pictures and video, for people and other programs (paper, preliminaries), and back."""

from packuv.atlas.picture import sheet, write_png
from packuv.atlas.restore import AtlasImportReport, import_atlas
from packuv.atlas.video import AtlasCodec, AtlasVideo, AtlasVideoOptions, AtlasVideoSummary, export_atlas

__all__ = [
    "AtlasCodec",
    "AtlasImportReport",
    "AtlasVideo",
    "AtlasVideoOptions",
    "AtlasVideoSummary",
    "export_atlas",
    "import_atlas",
    "sheet",
    "write_png",
]
