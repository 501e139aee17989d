"""The artefact store: what a stage made, found again by its recipe.

An artefact is a folder `<root>/<stage>/<digest>/` whose name is the SHA-256 of the recipe: the stage, its version, the
options it reads and the artefacts and files it reads. A folder with a receipt is complete, whatever was killed when:
it is built elsewhere, written to disk, given its receipt last, and moved here by one rename.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from tasks.artefacts import recipe
from tasks.artefacts.digests import file_digest
from tasks.artefacts.recipe import naming, write_json

RECEIPT = "receipt.json"
WORK = ".work"
BUILT = "built.json"
LOCK_POLL_SECONDS = 0.2


@dataclass(frozen=True)
class Key:
    """Name of an artefact."""

    stage: str
    digest: str
    """SHA-256 of the recipe, 64 hex digits"""
    reused: bool = field(default=False, compare=False)
    """True if the artefact was there already; no part of its identity"""

    def __str__(self) -> str:
        return f"{self.stage}/{self.digest}"


@dataclass(frozen=True)
class Building:
    """Where one artefact is built."""

    out: Path
    """Empty at the start of every attempt; its files become the artefact"""
    scratch: Path
    """Kept from attempt to attempt, also over a kill; gone once the artefact is there"""
    lock: int
    """Descriptor of the lock on this artefact. A process that inherits it keeps others from building"""


@dataclass(frozen=True)
class Receipt:
    """What the store wrote down when an artefact was finished."""

    recipe: Mapping[str, Any]
    outputs: Mapping[str, Mapping[str, Any]]
    """Relative path -> sha256 and bytes"""
    seconds: float
    """Run time of the attempt that succeeded"""
    peak_memory_bytes: int
    host: str
    versions: Mapping[str, str]
    finished: str
    """UTC, ISO 8601"""
    notes: Mapping[str, Any]
    """What the stage said about its work"""
    cpu: str = ""
    """Processor and the instructions that kernels were compiled for; results agree to the bit where these are equal"""

    @property
    def size_bytes(self) -> int:
        """Sum over the outputs."""
        return sum(item["bytes"] for item in self.outputs.values())


@dataclass(frozen=True)
class Damage:
    """A difference between an artefact and its receipt."""

    key: Key
    path: str
    reason: str

    def __str__(self) -> str:
        return f"{self.key}: {self.path} {self.reason}"


Build = Callable[[Building], Mapping[str, Any] | None]
"""Fills `building.out`; returns notes for the receipt, where `peak_memory_bytes` and `cpu` have places of their own"""


class Store:
    """Artefacts under one folder; any number of threads and processes may use it at once.

    A Store holds nothing but its path, so it may be passed to other processes.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)

    def __repr__(self) -> str:
        return f"Store({str(self.root)!r})"

    def key(self, stage: str, version: int, options: Any, inputs: Mapping[str, Any]) -> Key:
        """Name of the artefact that this recipe makes, whether it exists or not.

        Inputs are keys, digests of files, or lists and dicts of them. Raises TypeError for what a recipe cannot hold.
        """
        return Key(stage, recipe.digest(_recipe(stage, version, options, inputs)))

    def find(self, stage: str, version: int, options: Any, inputs: Mapping[str, Any]) -> Key | None:
        """The artefact of this recipe if it is complete, else None."""
        key = self.key(stage, version, options, inputs)
        return Key(key.stage, key.digest, reused=True) if self.holds(key) else None

    def holds(self, key: Key) -> bool:
        """True if the artefact has its receipt and every file its size; `verify` compares contents."""
        folder = self._folder(key)
        try:
            outputs = self.receipt(key).outputs
            return all((folder / name).stat().st_size == item["bytes"] for name, item in outputs.items())
        except FileNotFoundError:
            return False

    def path(self, key: Key) -> Path:
        """Folder of a complete artefact; raises FileNotFoundError where there is none."""
        if not (self._folder(key) / RECEIPT).exists():
            raise FileNotFoundError(f"the store {self.root} has no artefact {key}; run the stage {key.stage!r} first")
        return self._folder(key)

    def receipt(self, key: Key) -> Receipt:
        """Receipt of a complete artefact; raises FileNotFoundError where there is none."""
        return Receipt(**json.loads((self._folder(key) / RECEIPT).read_text()))

    def make(
        self,
        stage: str,
        version: int,
        options: Any,
        inputs: Mapping[str, Any],
        build: Build,
        *,
        waiting: Callable[[], None] = lambda: None,
    ) -> Key:
        """Return the artefact of this recipe; call `build` if it is not there.

        Of several callers with the same recipe one builds and the others wait, calling `waiting` five times a second
        (it may raise to give up). A build that raises publishes nothing and keeps its scratch folder.
        """
        what = _recipe(stage, version, options, inputs)
        key = Key(stage, recipe.digest(what))
        if not self.holds(key):
            with self._locked(key, waiting) as lock, naming(self.work_folder(key)):
                if not self.holds(key):
                    self._build(key, what, build, lock)
                    return key
        self._forget(key)
        return Key(stage, key.digest, reused=True)

    def keys(self) -> Iterator[Key]:
        """Every complete artefact, in the order of their names."""
        for file in sorted(self.root.glob(f"[!.]*/*/{RECEIPT}")):
            yield Key(file.parent.parent.name, file.parent.name)

    def verify(self) -> list[Damage]:
        """Compare every file of every artefact with its receipt; cost: reading them all."""
        return [damage for key in self.keys() for damage in self._audit(key)]

    def work_folder(self, key: Key) -> Path:
        """Folder where this artefact is built; it holds the log of a failed attempt."""
        return self.root / WORK / f"{key.stage}-{key.digest}"

    def _folder(self, key: Key) -> Path:
        return self.root / key.stage / key.digest

    @contextlib.contextmanager
    def _locked(self, key: Key, waiting: Callable[[], None]) -> Iterator[int]:
        path = self.root / WORK / f"{key.stage}-{key.digest}.lock"
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab") as file:  # close-on-exec by default: children do not prolong the lock by accident
            while not try_lock(file.fileno()):
                waiting()
                time.sleep(LOCK_POLL_SECONDS)
            yield file.fileno()

    def _build(self, key: Key, what: Mapping[str, Any], build: Build, lock: int) -> None:
        place = self.work_folder(key)
        out, built = place / "out", place / BUILT
        if not built.exists():  # else killed after the work, while its files were read for the receipt
            shutil.rmtree(out, ignore_errors=True)
            out.mkdir(parents=True)
            (place / "scratch").mkdir(exist_ok=True)
            start = time.monotonic()
            notes = dict(build(Building(out, place / "scratch", lock)) or {})
            facts = {
                "seconds": round(time.monotonic() - start, 3),
                "peak_memory_bytes": int(notes.pop("peak_memory_bytes", 0) or peak_memory_bytes()),
                "cpu": notes.pop("cpu", ""),
                "notes": notes,
            }
            _flush_all(out)
            write_json(built, facts)
        receipt = Receipt(
            recipe=what,
            outputs=_outputs(out),
            host=socket.gethostname(),
            versions=_versions(),
            finished=datetime.now(UTC).isoformat(timespec="seconds"),
            **json.loads(built.read_text()),
        )
        self._publish(key, out, receipt)
        self._forget(key)

    def _publish(self, key: Key, out: Path, receipt: Receipt) -> None:
        (out / RECEIPT).write_text(json.dumps(recipe.plain(receipt), indent=1))
        _flush(out / RECEIPT)
        _flush(out)
        target = self._folder(key)
        target.parent.mkdir(parents=True, exist_ok=True)
        # What stands there has no receipt or lost a file; nobody reads it, since `holds` says no.
        shutil.rmtree(target, ignore_errors=True)
        os.rename(out, target)
        _flush(target.parent)

    def _forget(self, key: Key) -> None:
        """Remove what is left of the building; the lock file stays, since others may wait on it."""
        shutil.rmtree(self.work_folder(key), ignore_errors=True)

    def _audit(self, key: Key) -> Iterator[Damage]:
        folder, receipt = self._folder(key), self.receipt(key)
        if recipe.digest(receipt.recipe) != key.digest:
            yield Damage(key, RECEIPT, "does not hold the recipe that names this folder")
        for name, item in receipt.outputs.items():
            if not (folder / name).is_file():
                yield Damage(key, name, "is missing")
            elif file_digest(folder / name) != item["sha256"]:
                yield Damage(key, name, "differs from what the stage wrote")


def peak_memory_bytes() -> int:
    """Largest resident memory of this process since its program started; 0 where the system does not say."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):  # ru_maxrss would begin with the parent's memory at the fork
                return int(line.split()[1]) * 1024
    return 0


def _recipe(stage: str, version: int, options: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "stage": stage,
        "version": version,
        "options": recipe.plain(options, where="options"),
        "inputs": recipe.plain(named(inputs), where="inputs"),
    }


def named(value: Any) -> Any:
    """Keys as their names, at any depth."""
    match value:
        case Key():
            return str(value)
        case Mapping():
            return {name: named(item) for name, item in value.items()}
        case list() | tuple():
            return [named(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: named(getattr(value, field.name)) for field in fields(value)}
    return value


def try_lock(descriptor: int) -> bool:
    """Lock an open file for this process, unless another has it; the kernel frees it when the last holder ends."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _outputs(folder: Path) -> dict[str, dict[str, Any]]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / RECEIPT)
    return {
        str(path.relative_to(folder)): {"sha256": file_digest(path), "bytes": path.stat().st_size} for path in files
    }


def _flush_all(folder: Path) -> None:
    """Have the disk hold a folder and all that is in it."""
    for path in [*folder.rglob("*"), folder]:
        _flush(path)


def _flush(path: Path) -> None:
    """Have the disk hold this file or folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _versions() -> dict[str, str]:
    names = ("packuv", "numpy", "numba", "torch", "av", "torchcodec", "opencv-contrib-python-headless", "pycolmap")
    found = {"python": platform.python_version()}
    for name in names:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found
