"""What a user asks for. Light to import: the command line reads it before anything heavy."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from tasks.artefacts.recipe import OptionError

Preset = Literal["draft", "standard", "high"]
Fidelity = Literal["lossless", "high", "medium", "low"]
Device = Literal["auto", "cpu", "cuda"]
LastStage = Literal["sync", "calibrate", "flow", "fit", "encode", "verify", "evaluate", "report"]
PRESETS = get_args(Preset)
QUALITIES = get_args(Fidelity)
CLOCKS = ("trusted", "triggered", "content")
"""How near the scene file stays to the fit, see `packuv.scene.encoder.TOLERANCES`"""
STAGES = get_args(LastStage)
"""In the order in which a run does them"""
MOST_DB = 99
"""Pictures of eight bits that differ at all differ by more"""
BAD_INPUT = (ValueError, FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
"""What is raised where the user has to change something, not we"""
FORM: dict[str, Any] = {"use_attribute_docstrings": True, "extra": "forbid"}
"""How the workflow engine makes a form of a request, and what it does with JSON: see pydantic's configuration"""


@dataclass(frozen=True)
class RunRequest:
    """One sequence to process. All values are plain, so that a scheduler can hold, show and ask for them."""

    __pydantic_config__: ClassVar[dict[str, Any]] = FORM

    capture: str
    """Capture folder, an absolute path"""
    out: str
    """Output folder, an absolute path; results go to a folder in it with the name of the sequence"""
    name: str | None = None
    """Of the sequence; none: what capture.toml or the folder says. Needed where two captures bear the same name"""
    preset: Preset = "standard"
    """Trades time for quality"""
    quality: Fidelity = "lossless"
    """Of the scene file; the fit does not depend on it"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Single settings, which win over the preset: {"fit": {"iterations": 3000}}"""
    frames: str = ":"
    """Instants A:B, from A up to B - 1, counted from 0; either end may be missing"""
    hold_out: tuple[str, ...] | None = None
    """Cameras never to fit, to score on; none: those that capture.toml names"""
    stop_after: LastStage = "report"
    """Last stage"""
    device: Device = "auto"
    """What fits and renders"""
    seed: int = 0
    """Same seed, same bytes"""
    jobs: int | None = None
    """Segments at once; none: from the number of cores"""
    max_minutes: float | None = None
    """Take the finest settings up to `preset` that are forecast to take no longer, see docs/pareto.md"""
    target_psnr: float | None = None
    """Take the fastest settings up to `preset` whose first frames have so many dB on cameras that are held out"""
    cores: int | None = None
    """To keep busy; none: all. The results do not depend on it where `jobs` is set"""
    memory_gb: float = 2.0
    """Of each job, for pictures and layers of the backdrop, 10^9 bytes; what does not fit is read or made again each
    time. No result depends on it"""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers make the stages, as tcp://10.0.0.5:8786; none: this machine does.
    Capture and output folder must lie under the same path on all of them. See docs/deployment.md"""

    def __post_init__(self) -> None:
        choices_of = {"preset": PRESETS, "quality": QUALITIES, "stop_after": STAGES, "device": get_args(Device)}
        for name, choices in choices_of.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, but is {getattr(self, name)!r}")
        for name in ("capture", "out"):
            if not Path(getattr(self, name)).is_absolute():
                raise ValueError(f"{name} must be an absolute path, but is {getattr(self, name)!r}")
        for name in ("jobs", "cores"):
            if (count := getattr(self, name)) is not None and count < 1:
                raise ValueError(f"{name} must be at least 1, but is {count}")
        check_memory(self.memory_gb)
        if self.max_minutes is not None and not 0 < self.max_minutes < math.inf:
            raise ValueError(f"max_minutes must be more than 0, but is {self.max_minutes}")
        if self.target_psnr is not None and not 0 < self.target_psnr < MOST_DB:
            raise ValueError(f"target_psnr must lie between 0 and {MOST_DB} dB, but is {self.target_psnr}")
        if self.target_psnr is not None and STAGES.index(self.stop_after) < STAGES.index("evaluate"):
            raise ValueError(f"target_psnr needs the scores, but the run stops after {self.stop_after}")
        parse_range(self.frames)
        if self.cluster is not None:
            check_address(self.cluster)

    @property
    def instants(self) -> tuple[int, int | None]:
        """The range of `frames`."""
        return parse_range(self.frames)


def check_memory(gigabytes: float) -> None:
    """Raises ValueError for less than nothing, or what is no number."""
    if not 0 <= gigabytes < math.inf:
        raise ValueError(f"memory_gb must be 0 or more, 10^9 bytes, but is {gigabytes}")


def check_address(text: str) -> None:
    """Raises ValueError for what is no address of a scheduler."""
    if not re.fullmatch(r"(tcp|tls)://(\[[0-9a-fA-F:.]+\]|[\w.-]+):\d{1,5}", text):
        raise ValueError(f"a cluster is named by its scheduler, as tcp://10.0.0.5:8786, but is {text!r}")


def parse_range(text: str) -> tuple[int, int | None]:
    """A half-open range; either end may be missing. Raises ValueError for what is none.

    >>> parse_range("30:60"), parse_range(":"), parse_range(":8")
    ((30, 60), (0, None), (0, 8))
    """
    match = re.fullmatch(r"(\d{0,15}):(\d{0,15})", text)
    first, stop = (int(part) if part else None for part in match.groups()) if match else (None, None)
    if not match or (stop is not None and stop <= (first or 0)):
        raise ValueError(f"must be A:B with 0 <= A < B, as 0:30 for the first thirty, but is {text!r}")
    return first or 0, stop


def read_settings(config: Path | None, pairs: Sequence[str]) -> dict[str, Any]:
    """Settings of a TOML file, then those of the command line, "fit.iterations=500"; later ones win.

    Raises FileNotFoundError without the file, ValueError for a file that is no TOML or a pair without '='.
    """
    settings: dict[str, Any] = {}
    if config is not None:
        settings = _read_toml(config)
    for pair in pairs:
        path, equals, value = pair.partition("=")
        if not equals or not path.strip():
            raise OptionError(f"--set needs NAME=VALUE, as fit.iterations=500, but got {pair!r}")
        _put(settings, path.strip().split("."), value.strip())
    return settings


def _read_toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; --config needs a TOML file")
    try:
        return tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{path} is no valid TOML: {error}") from None


def _put(tree: dict[str, Any], names: Sequence[str], value: str) -> None:
    for name in names[:-1]:
        inner = tree.setdefault(name, {})
        if not isinstance(inner, dict):
            raise OptionError(f"{'.'.join(names)}: {name} is set to a value elsewhere, but is a table here")
        tree = inner
    tree[names[-1]] = value
