"""What a stage is: one declaration of what it reads, its version and its job.

    @dataclass(frozen=True, kw_only=True)
    class Count(Stage):
        name, version = "count", 1
        groups: Key              # keys of what is read
        options: CountOptions    # and every setting that changes the result

        def build(self, work: Work) -> Notes:
            ...                  # reads work.path(self.groups), fills work.out

The recipe, the call and the arguments of the job follow from the fields. A field is a key, digests of files, or plain
values; so a stage can be pickled, and its job can run on another machine.
"""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from packuv.budget import USUAL_BYTES
from packuv.progress import Progress
from tasks.artefacts.store import Key, Store

if TYPE_CHECKING:
    from packuv.fit.gpu_memory import GpuMemory

BASE_BYTES = 1_000_000_000
"""Of a job beside pictures and layers: the libraries, the Gaussians and what the optimizer keeps of them"""

NO_GPU = "no_gpu"
"""Note of a job that should have used a GPU: why it did not"""
LESS_GPU = "less_gpu"
"""Note of a job that kept less on the GPU than it could have used: why"""

Notes = Mapping[str, Any]
"""What a stage says about its work, for the receipt; plain values"""


@dataclass(frozen=True)
class Files:
    """Raw files that a stage reads: what they are called, and what they hold."""

    sha256: Mapping[str, str]
    """Content digest by name"""


@dataclass(frozen=True)
class Site:
    """Where the artefacts and the capture of a sequence are, as a job finds them."""

    store: Path
    capture: Path
    threads: int
    """That a job may use"""
    memory_bytes: int = USUAL_BYTES
    """For what a job could make again: pictures, layers, maps. No result depends on it"""

    def path(self, key: Key) -> Path:
        """Folder of a complete artefact; raises FileNotFoundError where there is none."""
        return Store(self.store).path(key)


@dataclass(frozen=True)
class Needs:
    """What a job takes of a machine while it runs."""

    cores: int
    memory_bytes: int
    gpus: int = 0

    def __str__(self) -> str:
        gpus = f", {self.gpus} GPU" if self.gpus else ""
        return f"{self.cores} core{'s' * (self.cores != 1)}, {self.memory_bytes / 1e9:.1f} GB{gpus}"

    def fits(self, offer: Needs) -> bool:
        """Whether a machine that has `offer` can ever do it."""
        return self.cores <= offer.cores and self.memory_bytes <= offer.memory_bytes and self.gpus <= offer.gpus


@dataclass(frozen=True)
class Work:
    """What a job is given beside its stage."""

    site: Site
    out: Path
    """Empty folder; its files become the artefact"""
    scratch: Path
    """Folder that is kept from attempt to attempt"""
    progress: Progress

    def path(self, key: Key) -> Path:
        """Folder of a complete artefact; raises FileNotFoundError where there is none."""
        return self.site.path(key)


@dataclass(frozen=True, kw_only=True)
class Stage(ABC):
    """A step of a sequence; see above. Subclasses are frozen dataclasses with keyword-only fields."""

    name: ClassVar[str]
    """Folder of its artefacts; several stages may make the same kind"""
    version: ClassVar[int]
    """Raised with every change that alters what the job makes; tests/tasks/stages/test_golden.py watches"""
    small: ClassVar[bool] = False
    """Uses one core and holds no pictures"""

    @property
    def label(self) -> str:
        """What people are told."""
        return self.name

    @abstractmethod
    def build(self, work: Work) -> Notes:
        """The job: fill `work.out`. ValueError and OSError are for bad input, and reach the user as they are."""

    def needs(self, site: Site) -> Needs:
        """What its job takes there, roughly: the memory is that of the site and what any program takes."""
        if self.small:
            return Needs(1, BASE_BYTES)
        return Needs(site.threads, site.memory_bytes + BASE_BYTES, int(self.on_gpu))

    def gpu_memory(self, work: Work) -> GpuMemory | None:
        """What its job takes of a GPU; None where nobody has counted it."""
        return None

    @property
    def on_gpu(self) -> bool:
        """Whether it or its options say so."""
        return "cuda" in (getattr(value, "device", "cpu") for value in (self, *self.settings.values()))

    @property
    def on_cpu(self) -> Stage:
        """The same without a GPU: it makes the same artefact."""
        mine = {field.name: getattr(self, field.name) for field in fields(self)}
        changes = {name: replace(value, device="cpu") for name, value in mine.items() if hasattr(value, "device")}
        return replace(self, **changes, **({"device": "cpu"} if "device" in mine else {}))

    def spared(self, folder: Path, notes: Notes) -> Iterable[tuple[str, str]]:
        """Work that this sequence did not need, as (what, why), told by the artefact."""
        return ()

    @property
    def sources(self) -> dict[str, Any]:
        """The fields that name artefacts or files."""
        return {name: value for name, value in self._fields.items() if _names_artefacts(value)}

    @property
    def settings(self) -> dict[str, Any]:
        """The other fields."""
        return {name: value for name, value in self._fields.items() if not _names_artefacts(value)}

    @property
    def _fields(self) -> dict[str, Any]:
        """A field declared with `compare=False` only tells people something: it is no part of the recipe."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.compare}


@dataclass(frozen=True)
class StageJob:
    """The job of a stage, see `tasks.artefacts.jobs.Job`, ready to be sent to a process or another machine."""

    stage: Stage
    site: Site
    out: Path
    scratch: Path

    def __str__(self) -> str:
        return self.stage.label

    def __call__(self, progress: Progress) -> Notes:
        work = Work(self.site, self.out, self.scratch, progress)
        if not self.stage.on_gpu:
            return self.stage.build(work)
        try:
            return {**self._on_gpu(work), "device": "cuda"}
        except Exception as error:  # of whichever library asked for the memory
            why = _why_too_little(error)
            if why is None:
                raise
        self._start_over()
        return {**self.stage.on_cpu.build(work), "device": "cpu", NO_GPU: f"{why}, so the CPU did it"}

    def _on_gpu(self, work: Work) -> Notes:
        """With as many layers as there is room for; where the memory is used up nevertheless, once more with none."""
        from packuv.fit.gpu_memory import reserve  # late, for it takes a second to load

        memory = self.stage.gpu_memory(work)
        room = 0 if memory is None else reserve(memory)
        try:
            if memory is None or room == memory.layers_bytes:
                return self.stage.build(work)
            return self._with_less(work, room, f"it has room for {room / 1e9:.1f} GB of them")
        except Exception as error:
            why = _why_too_little(error)
            if why is None or not room:
                raise
        self._start_over()
        return self._with_less(work, 0, why)

    def _with_less(self, work: Work, room: int, why: str) -> Notes:
        """With so many bytes for layers, and so for all that can be made again."""
        site = replace(work.site, memory_bytes=min(work.site.memory_bytes, room))
        told = f"{why}; those that do not stay are composed anew for each picture"
        return {**self.stage.build(replace(work, site=site)), LESS_GPU: told}

    def _start_over(self) -> None:
        """Without what a failed attempt left."""
        from packuv.fit.gpu_memory import let_go

        let_go()
        for left in self.out.iterdir():
            shutil.rmtree(left) if left.is_dir() else left.unlink()


def _why_too_little(error: Exception) -> str | None:
    """What an error says of the GPU's memory; None where it tells of something else."""
    from packuv.fit.device import gpu_is_full
    from packuv.fit.gpu_memory import GpuFullError

    if isinstance(error, GpuFullError):
        return f"it {error}"
    return f"its memory was used up ({str(error).splitlines()[0]})" if gpu_is_full(error) else None


def _names_artefacts(value: Any) -> bool:
    """Whether a key or digests of files are in it, at any depth."""
    match value:
        case Key() | Files():
            return True
        case Mapping():
            return any(map(_names_artefacts, value.values()))
        case list() | tuple():
            return any(map(_names_artefacts, value))
    if is_dataclass(value) and not isinstance(value, type):
        return any(_names_artefacts(getattr(value, field.name)) for field in fields(value))
    return False
