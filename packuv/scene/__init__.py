"""The scene file: one Matroska file that gives back, frame by frame, the very integers that were fitted.

docs/scene-format.md specifies it. Rows of a scene are in stored order (`packuv.scene.sharing.stored_segments`): the
rows that may change inside a segment come first.

    with packuv.open_scene("scene.mkv") as scene:
        for gaussians in scene:             # float32 arrays, the next frames being decoded meanwhile
            ...
        shown = scene.gaussians(scene.frame_at(time_ns))
        shown = scene.gaussians(7, into=shown)      # in place: what stands still is not written again
"""

from packuv.scene.encoder import TOLERANCES, EncodeOptions, Quality
from packuv.scene.header import SceneHeader
from packuv.scene.reader import Scene, open_scene
from packuv.scene.sound import Sound
from packuv.scene.stream import Tolerance
from packuv.scene.verify import VerifyReport, verify_scene
from packuv.scene.writer import SceneSummary, write_scene

__all__ = [
    "TOLERANCES",
    "EncodeOptions",
    "Quality",
    "Scene",
    "SceneHeader",
    "SceneSummary",
    "Sound",
    "Tolerance",
    "VerifyReport",
    "open_scene",
    "verify_scene",
    "write_scene",
]
