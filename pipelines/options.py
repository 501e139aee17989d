"""Every setting of a sequence, by stage, and the presets that trade time for quality."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from calibration.scale import ScaleOptions
from packuv.fit.options import FitOptions
from packuv.footage import LightOptions, Transfer
from packuv.motion import KeyframeOptions, MotionBackend, MotionOptions, PatchOptions, Raft, RaftOptions
from packuv.motion.raft import WANTED
from packuv.scene import TOLERANCES, EncodeOptions, Quality
from pipelines.ladder import LADDER
from pipelines.request import CLOCKS, QUALITIES
from sync.align import AlignOptions
from sync.capture import TRANSFERS, CaptureSettings
from sync.clock import ClockMode
from sync.content import ContentOptions
from tasks.artefacts.recipe import override
from tasks.report.limits import Limits
from tasks.stages.calibrate import PointOptions, RigOptions
from tasks.stages.evaluate import EvaluateOptions
from tasks.stages.footage import PictureOptions


@dataclass(frozen=True)
class SequenceOptions:
    """Settings by stage; a stage's artefacts depend on its own and on those of the stages before it."""

    pictures: PictureOptions = field(default_factory=PictureOptions)
    sync: AlignOptions = field(default_factory=AlignOptions)
    rig: RigOptions = field(default_factory=RigOptions)
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    light: LightOptions = field(default_factory=LightOptions)
    points: PointOptions = field(default_factory=PointOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    raft: RaftOptions = field(default_factory=RaftOptions)
    content: ContentOptions = field(default_factory=ContentOptions)
    patches: PatchOptions = field(default_factory=PatchOptions)
    keyframes: KeyframeOptions = field(default_factory=KeyframeOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    encode: EncodeOptions = field(default_factory=EncodeOptions)
    evaluate: EvaluateOptions = field(default_factory=EvaluateOptions)
    report: Limits = field(default_factory=Limits)
    """No artefact depends on these"""


assert tuple(Quality) == QUALITIES
assert tuple(ClockMode) == CLOCKS
assert tuple(Transfer) == TRANSFERS


def compose(
    preset: str,
    capture: CaptureSettings,
    settings: Mapping[str, Any],
    *,
    seed: int = 0,
    quality: str = Quality.LOSSLESS,
) -> SequenceOptions:
    """Options of a run: those of the preset, or of another point of the ladder, then what capture.toml says, then the
    user's settings.

    Raises OptionError that names an unknown setting, with the valid names, or a value of the wrong kind.
    """
    options = override(SequenceOptions(), LADDER[preset])
    said = {"sync": {"reference": capture.reference, "clock": capture.clock}}
    options = override(options, {**said, "pictures": {"transfer": capture.transfer}})
    tolerance = asdict(TOLERANCES[Quality(quality)])
    return override(override(options, {"fit": {"seed": seed}, "encode": {"tolerance": tolerance}}), settings)


def check_raft(options: SequenceOptions) -> None:
    """Raise ValueError or FileNotFoundError where motion.backend is raft and raft.weights is no file of such weights,
    or the latter is set without the former."""
    named, backend = options.raft.weights, options.motion.backend
    if backend is not MotionBackend.RAFT:
        if named:
            raise ValueError(
                f"raft.weights names {named}, but motion.backend is {backend}; set motion.backend=raft, too"
            )
    elif named is None:
        raise ValueError(f"motion.backend is raft, but raft.weights names no file; give {WANTED}")
    else:
        Raft(Path(named))
