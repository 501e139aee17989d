"""What a worker is sent, and how it does it: by the store that all machines share and a process of its own.

An order and its answer are plain values and one pickle, so that a worker of another version can read who asks before it
reads what for. What a worker made, the store says; the answer only tells how it went.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import packuv
from packuv.progress import Progress, no_progress
from tasks.artefacts.digests import Signature
from tasks.artefacts.jobs import JobDiedError, JobError, Jobs, raised, told
from tasks.artefacts.presence import look_afresh
from tasks.artefacts.stage import Needs, Site, Stage
from tasks.artefacts.store import Key, Store
from tasks.artefacts.workshop import make_by_job

ROOMS = ("calibration", "packuv", "sync", "tasks")
"""Packages whose code decides what a stage makes"""

Order = dict[str, Any]
Answer = dict[str, Any]


def order(stage: Stage, site: Site, seen: Mapping[str, Signature], present: Path) -> Order:
    """To make the artefact of a stage. `seen` tells of the capture's files what they are, by their place in it;
    `present` is a file that everybody sees who sees the store."""
    return {
        "version": packuv.__version__,
        "code": code_digest(),
        "stage": pickle.dumps(stage),
        "site": pickle.dumps(site),
        "capture": str(site.capture),
        "seen": {name: list(signature) for name, signature in seen.items()},
        "present": str(present),
    }


def fulfil(asked: Order, progress: Progress = no_progress, check: Callable[[], None] = lambda: None) -> Answer:
    """Make what is asked for unless it is there. What goes wrong, other than in this very code, is told in the answer.

    `check` is called twice a second; what it raises ends the work.
    """
    try:
        _check_same(asked)
        _check_shared(Path(asked["present"]))
        stage: Stage = pickle.loads(asked["stage"])
        site: Site = pickle.loads(asked["site"])
        needs = stage.needs(site)
        jobs = Jobs(threads=needs.cores, memory_bytes=site.memory_bytes)
        files = Seen(Path(asked["capture"]), asked["seen"])
        with Store(site.store).in_use():
            key = make_by_job(
                stage,
                site,
                jobs,
                originals=files.look,
                progress=progress,
                waiting=lambda: progress(0, 0, "waiting for another machine that makes the same"),
                check=check,
            )
        return {"host": socket.gethostname(), "reused": key.reused}
    except (JobError, ValueError, OSError, MemoryError) as error:
        log = getattr(error, "log", None)
        return {"host": socket.gethostname(), "error": told(error), "log": str(log) if log else None}


def read(answer: Answer, key: Key, log: Path) -> Key:
    """The key, as the worker found or made it; raises what it met, as a job here would. `log`: where to look."""
    if "error" not in answer:
        return Key(key.stage, key.digest, reused=answer["reused"])
    kinds, message = answer["error"]["kinds"], answer["error"]["message"]
    for kind in (JobDiedError, JobError):
        if kind.__name__ in kinds:
            raise kind(message, Path(answer["log"] or log))
    raise raised(answer["error"], log)


@dataclass(frozen=True)
class Seen:
    """The raw files of a capture as whoever compared their contents saw them."""

    capture: Path
    files: Mapping[str, Signature]
    """By place in the capture"""

    def look(self) -> dict[str, Signature]:
        """What moves when a file does, as this machine sees it; raises ValueError where size or time are others."""
        return {place: self._look(place, signature) for place, signature in self.files.items()}

    def _look(self, place: str, signature: Signature) -> Signature:
        path = self.capture / place
        try:
            with open(path, "rb") as file:  # which has a network file system ask for what is true now
                stat = os.fstat(file.fileno())
        except OSError as error:
            raise ValueError(
                f"{socket.gethostname()} cannot read {path} ({error.strerror}); workers need the capture under the "
                "same path as the machine that runs packuv"
            ) from None
        if [stat.st_size, stat.st_mtime_ns] != list(signature[:2]):
            raise ValueError(
                f"{path} is another file on {socket.gethostname()}, or was written to since the run looked at it; "
                "share one capture folder, and let nothing change it during a run"
            )
        return [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]


def code_digest() -> str:
    """Of the source of all that decides what a stage makes, as it lies on this machine's disk now."""
    digest, top = hashlib.sha256(), Path(__file__).parents[2]
    for room in ROOMS:
        for path in sorted((top / room).rglob("*.py")):
            digest.update(f"{path.relative_to(top)}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _check_same(asked: Order) -> None:
    if (asked["version"], asked["code"]) != (packuv.__version__, code_digest()):
        kind = "the same version, but other code" if asked["version"] == packuv.__version__ else packuv.__version__
        raise ValueError(
            f"{socket.gethostname()} has {kind}, and whoever asks has PackUV {asked['version']}; what they make "
            "would not fit together: install the same on all machines, and start the workers again"
        )


def _check_shared(present: Path) -> None:
    look_afresh(present.parent)
    if not present.exists():
        raise ValueError(
            f"{socket.gethostname()} does not see {present.parents[1]} as the machine that runs packuv does; "
            "--out must be a folder that all of them share, under the same path"
        )


def resources(needs: Needs) -> dict[str, float]:
    """In Dask's terms."""
    named = {"cores": needs.cores, "memory": needs.memory_bytes, "gpus": needs.gpus}
    return {name: float(amount) for name, amount in named.items() if amount}


def offered(found: Mapping[str, float]) -> Needs:
    """Of a worker's resources."""
    return Needs(int(found.get("cores", 0)), int(found.get("memory", 0)), int(found.get("gpus", 0)))
