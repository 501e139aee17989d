"""What may go from stores, and making it go: what the last run did not use, what was left over, and, where a quota asks
for it, intermediates that a run can make again.

A run that has not ended keeps its things: it holds the store (`Store.in_use`), and what a killed one made is newer than
the `run.json` of the last one that ended. Results are never touched: only what is in REMAKEABLE goes for a quota.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from tasks.artefacts.store import GONE, RECEIPT, WORK, Store, find_stores, try_lock

REMAKEABLE = ("motion", "background", "seam", "backdrop", "key", "segment")
"""Stages whose artefacts go for a quota, in this order: the heaviest of which results need the least go first"""
RUN = "run.json"
RESULTS = frozenset({"encode", "verify", "evaluate"})
"""A run that came to all of these came to its end"""
ENGINE, ENGINE_LOCK = ".prefect", "in_use.lock"
DAY_SECONDS = 86_400


class Why(StrEnum):
    """Why something may go."""

    SUPERSEDED = "superseded"
    """The last run, which came to its end, did not use it: of other settings, another capture, an older version"""
    LEFT_OVER = "left over"
    """Of a build that did not end"""
    REMAKEABLE = "over quota"
    """A run makes it again"""
    ENGINE = "workflow engine"
    """A database that no run uses"""


class State(StrEnum):
    """Of a sequence."""

    FINISHED = "finished"
    """Its last run came to its end"""
    UNFINISHED = "unfinished"
    """Nothing in it counts as superseded, since nobody knows what its next run needs"""
    BUSY = "busy"
    """It is being processed, so all is left alone"""


@dataclass(frozen=True)
class Policy:
    """What may go."""

    keep_days: float = 0
    """What was used since then stays, except for the quota's sake"""
    quota_bytes: int | None = None
    """Most that the folder may hold; None for no end"""

    def __post_init__(self) -> None:
        if not self.keep_days >= 0:
            raise ValueError(f"keep_days must be at least 0, but is {self.keep_days}")


@dataclass(frozen=True)
class Item:
    """Something in a store that may go, or may not."""

    name: str
    """Of an artefact, <stage>/<digest>, or of a folder"""
    folder: Path
    bytes: int
    """That removing it frees: a file that has another name elsewhere, as the scene has, frees nothing"""
    last_use: float
    """Seconds since the epoch"""
    why: Why | None = None
    """None if it stays"""

    @property
    def stage(self) -> str:
        return self.name.partition("/")[0]


@dataclass(frozen=True)
class Cleaned:
    """One sequence."""

    folder: Path
    state: State
    gone: tuple[Item, ...]
    kept_bytes: int
    """In the store, of files that have no name elsewhere"""


@dataclass(frozen=True)
class Cleaning:
    """What went from one folder, or would go."""

    folder: Path
    sequences: tuple[Cleaned, ...]
    engine: tuple[Item, ...]
    """Databases of the workflow engine"""
    held_bytes: int
    """In all of the folder before, each file counted once whatever its names"""

    @property
    def kept_bytes(self) -> int:
        return self.held_bytes - self.freed_bytes

    @property
    def gone(self) -> list[Item]:
        return [item for sequence in self.sequences for item in sequence.gone] + list(self.engine)

    @property
    def freed_bytes(self) -> int:
        return sum(item.bytes for item in self.gone)


def clean_folder(folder: Path, policy: Policy, *, dry_run: bool = False) -> Cleaning:
    """Make go what may go from an output folder, a sequence's folder or a store; `dry_run` only tells.

    Raises FileNotFoundError for a folder that holds no store. Readers see an artefact whole or not at all.
    """
    stores = find_stores(folder)
    with contextlib.ExitStack() as stack:
        shelves = [_Shelf(store, stack.enter_context(store.alone()), policy) for store in stores]
        engine = [item for home in _homes(folder) if (item := stack.enter_context(_unused(home, policy)))]
        held = _bytes_in(folder)
        if policy.quota_bytes is not None:
            freed = sum(item.bytes for item in engine) + sum(shelf.freed_bytes for shelf in shelves)
            _relieve(shelves, held - freed - policy.quota_bytes)
        withdrawn = [] if dry_run else [place for shelf in shelves for place in shelf.withdraw()]
        for item in [] if dry_run else engine:
            _empty(item.folder)
    for place in withdrawn:  # nobody sees these any more, so runs need not wait for it
        shutil.rmtree(place, ignore_errors=True)
    return Cleaning(folder, tuple(shelf.cleaned() for shelf in shelves), tuple(engine), held)


class _Shelf:
    """A store while it is looked through."""

    def __init__(self, store: Store, alone: bool, policy: Policy) -> None:
        self.store = store
        used, self.ended = _last_run(store.root.parent / RUN)
        self.state = State.BUSY if not alone else State.FINISHED if self.ended else State.UNFINISHED
        self.items = list(_items(store)) if alone else []
        self.bytes = _own_bytes(store.root)
        old = time.time() - policy.keep_days * DAY_SECONDS
        chosen = ((item, self._why(item, used, policy, old)) for item in self.items)
        self.gone = [replace(item, why=why) for item, why in chosen if why]

    def _why(self, item: Item, used: frozenset[str], policy: Policy, old: float) -> Why | None:
        if item.name.startswith(GONE):
            return Why.LEFT_OVER
        artefact = (item.folder / RECEIPT).exists()
        if item.last_use > old or item.name in used:
            return None
        if self._ended_with(item):
            return Why.SUPERSEDED if artefact else Why.LEFT_OVER
        # Of a run that did not end and may go on: only age tells that it will not.
        return Why.LEFT_OVER if policy.keep_days and not artefact else None

    def _ended_with(self, item: Item) -> bool:
        """Whether no run used it after the last one that ended, and that one came to its end."""
        return self.ended is not None and item.last_use <= self.ended

    @property
    def freed_bytes(self) -> int:
        return sum(item.bytes for item in self.gone)

    def remakeable(self, stage: str) -> list[Item]:
        """What may go for a quota, frees something, and does not go anyway."""
        names = {item.name for item in self.gone}
        able = [item for item in self.items if item.stage == stage and item.bytes and self._ended_with(item)]
        return [item for item in able if item.name not in names]

    def withdraw(self) -> list[Path]:
        """Take away what goes; what is being built after all stays."""
        places = {item.name: self.store.withdraw(item.folder) for item in self.gone}
        self.gone = [item for item in self.gone if places[item.name]]
        return [place for place in places.values() if place]

    def cleaned(self) -> Cleaned:
        return Cleaned(self.store.root.parent, self.state, tuple(self.gone), self.bytes - self.freed_bytes)


def _relieve(shelves: Sequence[_Shelf], excess_bytes: int) -> None:
    """Have intermediates go until so much is freed: stage by stage, of each those first that lay longest."""
    for stage in REMAKEABLE:
        for shelf in sorted(shelves, key=lambda shelf: shelf.ended or 0):
            for item in shelf.remakeable(stage):
                if excess_bytes <= 0:
                    return
                shelf.gone.append(replace(item, why=Why.REMAKEABLE))
                excess_bytes -= item.bytes


def _last_run(path: Path) -> tuple[frozenset[str], float | None]:
    """Artefacts that the last run used, and when it ended; None if it did not come to its end."""
    try:
        run: dict[str, Any] = json.loads(path.read_text())
        used = {item["artefact"] for item in [*run["artefacts"], *run["stages"]] if "artefact" in item}
        failed = any(stage["outcome"] == "failed" for stage in run["stages"])
        ended = path.stat().st_mtime
    except (OSError, ValueError, KeyError, TypeError):
        return frozenset(), None
    whole = not failed and {name.partition("/")[0] for name in used} >= RESULTS
    return frozenset(used), ended if whole else None


def _items(store: Store) -> Iterator[Item]:
    for folder in sorted(store.root.glob("[!.]*/*/")):
        receipt = folder / RECEIPT
        last_use = receipt.stat().st_mtime if receipt.exists() else _newest(folder)
        yield Item(f"{folder.parent.name}/{folder.name}", folder, _own_bytes(folder), last_use)
    for folder in sorted((store.root / WORK).glob("*/")):
        yield Item(folder.name, folder, _own_bytes(folder), _newest(folder))


def _homes(folder: Path) -> list[Path]:
    """Of servers that runs brought along, which are numbered; that of `packuv serve` keeps the history of runs."""
    return sorted(lock.parent for lock in (folder / ENGINE).glob(f"[0-9]*/{ENGINE_LOCK}"))


@contextlib.contextmanager
def _unused(home: Path, policy: Policy) -> Iterator[Item | None]:
    """A database of the workflow engine, which no run takes while the block runs; None if it stays."""
    item = Item(f"{ENGINE}/{home.name}", home, _own_bytes(home), _newest(home), Why.ENGINE)
    with open(home / ENGINE_LOCK, "ab") as lock:
        free = try_lock(lock.fileno()) and item.last_use <= time.time() - policy.keep_days * DAY_SECONDS
        yield item if free and item.bytes else None


def _empty(home: Path) -> None:
    """The lock stays, since a run may be about to ask for it."""
    for path in home.iterdir():
        if path.name != ENGINE_LOCK:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def files_in(folder: Path) -> Iterator[os.stat_result]:
    """What the system says of every file in a folder that is still there, at any depth."""
    for inside, _, names in os.walk(folder):  # which does not mind that a run elsewhere in the folder removes some
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                yield os.lstat(os.path.join(inside, name))


def _own_bytes(folder: Path) -> int:
    return sum(stat.st_size for stat in files_in(folder) if stat.st_nlink == 1)


def _bytes_in(folder: Path) -> int:
    """Of all files, each counted once whatever its names."""
    return sum({(stat.st_dev, stat.st_ino): stat.st_size for stat in files_in(folder)}.values())


def _newest(folder: Path) -> float:
    return max([folder.stat().st_mtime, *(stat.st_mtime for stat in files_in(folder))])
