"""What a user asks for of a data set. Light to import, as `pipelines.request`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pipelines.request import FORM, Device, Fidelity, LastStage, Preset, RunRequest


@dataclass(frozen=True)
class BatchRequest:
    """A data set to process. All values are plain, as those of a RunRequest."""

    __pydantic_config__: ClassVar[dict[str, Any]] = FORM

    manifest: str
    """Parquet file of packuv manifest, or a folder of captures, of which one is made first; an absolute path"""
    out: str
    """Output folder, an absolute path; results go to a folder in it for each sequence, and to index.html"""
    names: tuple[str, ...] = ()
    """Only sequences whose name fits one of these patterns, as dance*; none: all"""
    tags: tuple[str, ...] = ()
    """Only sequences that have all of these tags; none: all"""
    preset: Preset = "standard"
    """Trades time for quality"""
    quality: Fidelity = "lossless"
    """Of the scene files; the fits do not depend on it"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Single settings, which win over the preset: {"fit": {"iterations": 3000}}"""
    frames: str = ":"
    """Instants A:B of each sequence, from A up to B - 1, counted from 0; either end may be missing"""
    max_minutes: float | None = None
    """For each sequence, the finest settings up to `preset` that are forecast to take no longer"""
    target_psnr: float | None = None
    """For each sequence, the fastest settings up to `preset` whose first frames have so many dB on unseen cameras"""
    device: Device = "auto"
    """What fits and renders"""
    seed: int = 0
    """Same seed, same bytes"""
    jobs: int = 1
    """Segments of a sequence at once"""
    memory_gb: float = 2.0
    """Of each job, for pictures and layers of the backdrop, 10^9 bytes; no result depends on it"""
    at_once: int | None = None
    """Sequences at a time, which share the cores evenly; none: from cores and memory, or all that a pool takes"""
    pool: str | None = None
    """Work pool whose workers take the sequences, each with all cores of its machine; none: this process does"""
    stop_after: LastStage = "report"
    """Last stage"""
    notify: str | None = None
    """Shell command that is run at the end if something failed, with PACKUV_SUMMARY and others in its environment"""

    def __post_init__(self) -> None:
        if not Path(self.manifest).is_absolute():
            raise ValueError(f"manifest must be an absolute path, but is {self.manifest!r}")
        if self.at_once is not None and self.at_once < 1:
            raise ValueError(f"at_once must be at least 1, but is {self.at_once}")
        self.of_sequence("any", "/")  # which checks the rest

    def of_sequence(self, name: str, capture: str) -> RunRequest:
        """The request for one of its sequences."""
        return RunRequest(
            capture=capture,
            out=self.out,
            name=name,
            preset=self.preset,
            quality=self.quality,
            settings=self.settings,
            frames=self.frames,
            stop_after=self.stop_after,
            device=self.device,
            seed=self.seed,
            jobs=self.jobs,
            memory_gb=self.memory_gb,
            max_minutes=self.max_minutes,
            target_psnr=self.target_psnr,
        )

    @property
    def table(self) -> Path:
        """Of results, beside the manifest."""
        manifest = Path(self.manifest)
        return manifest.with_name(f"{manifest.stem}.results.parquet")

    @property
    def page(self) -> Path:
        """For people."""
        return Path(self.out) / "index.html"
