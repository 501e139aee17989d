"""What moves in the pictures: optical flow and masks, the background, keyframes."""

from packuv.motion.background import BackgroundOptions, Still, find_background, load_stills, patched, save_stills
from packuv.motion.cache import MotionCache, measure_motion
from packuv.motion.follow import Change, Follower
from packuv.motion.keyframes import KeyframeOptions
from packuv.motion.patches import Patches, PatchOptions, epochs, find_patches
from packuv.motion.plate import Plate, compare_plate
from packuv.motion.raft import Raft, RaftOptions
from packuv.motion.step import MotionBackend, MotionOptions, changed_between, one_opencv_thread

__all__ = [
    "BackgroundOptions",
    "Change",
    "Follower",
    "KeyframeOptions",
    "MotionBackend",
    "MotionCache",
    "MotionOptions",
    "PatchOptions",
    "Patches",
    "Plate",
    "Raft",
    "RaftOptions",
    "Still",
    "changed_between",
    "compare_plate",
    "epochs",
    "find_background",
    "find_patches",
    "load_stills",
    "measure_motion",
    "one_opencv_thread",
    "patched",
    "save_stills",
]
