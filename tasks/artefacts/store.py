"""The artefact store: what a stage made, found again by its recipe.

An artefact is a folder `<root>/<stage>/<digest>/` whose name is the SHA-256 of the recipe: the stage, its version, the
options it reads and the artefacts and files it reads. A folder with a receipt is complete, whatever was killed when:
it is built elsewhere, written to disk, given its receipt last, and moved here by one rename.

Several machines may share the folder, as over NFS. Each attempt to build has a folder that nobody else writes to,
`<root>/.work/<stage>-<digest>/<who>/`, and the first one that is whole is published; the others find it there. Locks
and the names of attempts (`tasks.artefacts.presence`) keep two from doing the same work, but nothing breaks where they
fail: work that is done twice is waste, never harm.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import platform
import random
import re
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO

from tasks.artefacts import recipe
from tasks.artefacts.digests import file_digest
from tasks.artefacts.presence import Beat, LostError, is_alive, is_ended, is_name, look_afresh, own_name
from tasks.artefacts.recipe import naming, write_json

RECEIPT = "receipt.json"
WORK, OUT, SCRATCH = ".work", "out", "scratch"
BUILT, BEGUN = "built.json", "begun.json"
IN_USE, GONE = "in_use.lock", "gone-"
PRESENT, RUNS, CLEANS = ".in_use", "run-", "clean-"
RELEASED, OVERTAKEN = "released", "over-"
ATTEMPTS = 2
"""Times that a build is tried whose raw files moved under it"""
LOCK_POLL_SECONDS = 0.2
CLAIM_POLL_SECONDS = 1.0
"""Between two looks at whether somebody on another machine goes on building; each asks the file server"""
NO_LOCKS = frozenset({errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS})
"""What a file system without locks answers"""


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
    """Descriptor of the lock on this artefact. A process that inherits it keeps others on this machine from building"""
    check: Callable[[], None]
    """Raises LostError once somebody else builds it, since this process was silent for too long"""


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
    cpu_seconds: float | None = None
    """Of all threads and processes of the attempt that succeeded; None: nobody measured it"""

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
"""Fills `building.out`; returns notes for the receipt, where `peak_memory_bytes`, `cpu_seconds` and `cpu` have
places of their own"""

Originals = Callable[[], Mapping[str, Any]]
"""What a build reads beside artefacts: by name, something that moves when it does. Raises ValueError if one is not what
the recipe says"""


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
        return _is_whole(self._folder(key))

    def path(self, key: Key) -> Path:
        """Folder of a complete artefact; raises FileNotFoundError where there is none."""
        if not (self._folder(key) / RECEIPT).exists() and not self.appeared(key):
            raise FileNotFoundError(f"the store {self.root} has no artefact {key}; run the stage {key.stage!r} first")
        return self._folder(key)

    def receipt(self, key: Key) -> Receipt:
        """Receipt of a complete artefact.

        Raises FileNotFoundError where there is none, ValueError for a damaged one.
        """
        return _receipt(self._folder(key))

    def make(
        self,
        stage: str,
        version: int,
        options: Any,
        inputs: Mapping[str, Any],
        build: Build,
        *,
        originals: Originals = dict,
        waiting: Callable[[], None] = lambda: None,
    ) -> Key:
        """Return the artefact of this recipe; call `build` if it is not there.

        Of several callers with the same recipe one builds and the others wait, calling `waiting` five times a second
        (it may raise to give up). A build that raises publishes nothing and keeps its scratch folder.

        `originals` are looked at before a build and before its result is published. If they moved in between, nobody
        knows what was read: all is thrown away and built once more; ValueError if they move again. Scratch that was
        begun with others is thrown away, too.
        """
        what = _recipe(stage, version, options, inputs)
        key = Key(stage, recipe.digest(what))
        while not self.holds(key):
            with self._locked(key, waiting) as lock, naming(self.work_folder(key)):
                if self.appeared(key):
                    break
                place = self._claim(key)
                if self.appeared(key):  # somebody came to an end just before the claim
                    break
                if place is not None:
                    with contextlib.suppress(LostError):
                        self._build(key, place, what, build, originals, lock)
                        return key
            if place is None:
                waiting()
                time.sleep(CLAIM_POLL_SECONDS * random.uniform(0.5, 1))
        return self.reuse(key)

    def reuse(self, key: Key) -> Key:
        """A complete artefact, marked as used now, with nothing left of its building."""
        self._forget(key)
        with contextlib.suppress(OSError):  # only for who cleans up: the receipt's time tells the last use
            os.utime(self._folder(key) / RECEIPT)
        return replace(key, reused=True)

    def appeared(self, key: Key) -> bool:
        """As `holds`, but asks the file server where the system would tell what it knew a while ago."""
        look_afresh(self.root / key.stage)
        return self.holds(key)

    def keys(self) -> Iterator[Key]:
        """Every complete artefact, in the order of their names."""
        for file in sorted(self.root.glob(f"[!.]*/*/{RECEIPT}")):
            yield Key(file.parent.parent.name, file.parent.name)

    def verify(self) -> list[Damage]:
        """Compare every file of every artefact with its receipt; cost: reading them all."""
        return [damage for key in self.keys() for damage in self._audit(key)]

    def absent(self) -> set[str]:
        """Names of artefacts that others were made from and that are not here any more, as after `packuv clean`."""
        present, wanted = {str(key) for key in self.keys()}, set[str]()
        for key in self.keys():
            with contextlib.suppress(ValueError):  # damaged, as `verify` tells
                wanted.update(_names(self.receipt(key).recipe.get("inputs")))
        return wanted - present

    @contextlib.contextmanager
    def in_use(self) -> Iterator[Path]:
        """Keep everybody from cleaning up here while the block runs; waits for who does so now.

        Yields a file that is there as long as the block runs.
        """
        with self._open_lock(IN_USE) as file:
            with contextlib.suppress(OSError):  # no locks here
                fcntl.flock(file.fileno(), fcntl.LOCK_SH)
            with self._present(RUNS) as own:
                while self._around(CLEANS):
                    time.sleep(LOCK_POLL_SECONDS)
                yield own

    @contextlib.contextmanager
    def alone(self) -> Iterator[bool]:
        """Keep runs from beginning here while the block runs; False if one is going on, or somebody else cleans up."""
        with self._open_lock(IN_USE) as file:
            if not try_lock(file.fileno()):
                yield False
                return
            # Who comes first tells of itself and then looks, so of two at least one sees the other.
            with self._present(CLEANS):
                yield not self._around(RUNS)

    def withdraw(self, folder: Path) -> Path | None:
        """Take an artefact, or what is left of its building, away in one step; for those who are `alone` here.

        Returns where it is now, to be removed at leisure; None if somebody builds it.
        """
        name = folder.name if folder.parent.name == WORK else f"{folder.parent.name}-{folder.name}"
        if name.startswith(GONE):
            return folder
        with self._open_lock(f"{name}.lock") as file:
            if not try_lock(file.fileno()) or any(map(_goes_on, _attempts(self.root / WORK / name))):
                return None
            gone = self.root / WORK / f"{GONE}{name}-{time.time_ns()}"
            os.rename(folder, gone)
            return gone

    def work_folder(self, key: Key) -> Path:
        """Folder where this artefact is built, each attempt in one of its own; it holds the log of a failed one."""
        return self.root / WORK / f"{key.stage}-{key.digest}"

    def _folder(self, key: Key) -> Path:
        return self.root / key.stage / key.digest

    @contextlib.contextmanager
    def _present(self, kind: str) -> Iterator[Path]:
        """Have a file here that tells of this process while the block runs."""
        own = self.root / PRESENT / f"{kind}{own_name()}"
        own.parent.mkdir(parents=True, exist_ok=True)
        own.touch()
        try:
            with Beat(own, again=True):
                yield own
        finally:
            own.unlink(missing_ok=True)

    def _around(self, kind: str) -> bool:
        """Whether others of this kind are at work here, on any machine; what is left of those that ended goes."""
        look_afresh(self.root / PRESENT)
        found = list((self.root / PRESENT).glob(f"{kind}*"))
        alive = [path for path in found if is_alive(path)]
        for path in set(found) - set(alive):
            path.unlink(missing_ok=True)
        return bool(alive)

    def _claim(self, key: Key) -> Path | None:
        """A folder to build in, with what an attempt left that does not go on; None while another one does."""
        shelf = self.work_folder(key)
        if any(map(_goes_on, _attempts(shelf))):
            return None
        own = shelf / own_name()
        try:
            own.mkdir(parents=True)
        except FileNotFoundError:  # somebody came to an end, and removed the shelf
            return None
        look_afresh(shelf)
        others = [other for other in _attempts(shelf) if other != own]
        if any(map(_goes_on, others)):  # both came at once: who looked last sees the other
            own.rmdir()
            return None
        _take_over([other for other in others if not _goes_on(other)], own)
        return own

    @contextlib.contextmanager
    def _locked(self, key: Key, waiting: Callable[[], None]) -> Iterator[int]:
        with self._open_lock(f"{key.stage}-{key.digest}.lock") as file:
            while not try_lock(file.fileno()):
                waiting()
                time.sleep(LOCK_POLL_SECONDS)
            yield file.fileno()

    def _open_lock(self, name: str) -> BinaryIO:
        """Close-on-exec by default: children do not prolong a lock by accident."""
        path = self.root / WORK / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return open(path, "ab")

    def _build(
        self, key: Key, place: Path, what: Mapping[str, Any], build: Build, originals: Originals, lock: int
    ) -> None:
        """Raises LostError if somebody else took over."""
        with Beat(place) as beat:
            try:
                self._try(key, place, what, lambda: _attempt(place, build, lock, beat.check), originals, beat)
            except BaseException as error:
                if beat.lost:
                    if isinstance(error, Exception):
                        raise LostError(str(error)) from error
                    raise
                with contextlib.suppress(OSError):
                    (place / RELEASED).touch()
                raise

    def _try(
        self,
        key: Key,
        place: Path,
        what: Mapping[str, Any],
        attempt: Callable[[], None],
        originals: Originals,
        beat: Beat,
    ) -> None:
        for _ in range(ATTEMPTS):
            begun, failure = _begin(place, originals), None
            try:
                attempt()
            except LostError:
                raise
            except Exception as error:  # perhaps because of what was in a raw file's place for a while
                failure = error
            moved = _moved(begun, originals)
            if not moved:
                if failure:
                    raise failure
                return self._publish(key, place, what, beat)
        raise ValueError(
            f"{', '.join(moved)} moved twice while {key.stage!r} read the capture (written to, replaced or touched); "
            "let nothing change the capture during a run, and run the same command again"
        ) from failure

    def _publish(self, key: Key, place: Path, what: Mapping[str, Any], beat: Beat) -> None:
        out = place / OUT
        receipt = Receipt(
            recipe=what,
            outputs=_outputs(out),
            host=socket.gethostname(),
            versions=_versions(),
            finished=datetime.now(UTC).isoformat(timespec="seconds"),
            **json.loads((place / BUILT).read_text()),
        )
        (out / RECEIPT).write_text(json.dumps(recipe.plain(receipt), indent=1))
        _flush(out / RECEIPT)
        _flush(out)
        if beat.lost:  # what was taken over may have been removed while it was listed
            raise LostError(f"{place} was taken over by somebody else")
        self._place(out, key)
        _flush(self._folder(key).parent)
        self._forget(key)

    def _place(self, out: Path, key: Key) -> None:
        """Give a finished folder its name, unless another one has it; raises LostError then."""
        target = self._folder(key)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.rename(out, target)
            return
        except FileNotFoundError:  # a server that answers late does what it is asked for twice
            if self.appeared(key):
                return
            raise
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        if self.appeared(key):
            raise LostError(f"{key} was made by somebody else")
        # What stands there has no receipt or lost a file; nobody reads it, since `holds` says no.
        gone = self.root / WORK / f"{GONE}{key.stage}-{key.digest}-{own_name()}"
        os.rename(target, gone)
        if _is_whole(gone):  # it came just now
            os.rename(gone, target)
            raise LostError(f"{key} was made by somebody else")
        os.rename(out, target)
        shutil.rmtree(gone, ignore_errors=True)

    def _forget(self, key: Key) -> None:
        """Remove what is left of the building; the lock file stays, since others may wait on it."""
        shutil.rmtree(self.work_folder(key), ignore_errors=True)

    def _audit(self, key: Key) -> Iterator[Damage]:
        folder = self._folder(key)
        try:
            receipt = self.receipt(key)
        except ValueError:
            yield Damage(key, RECEIPT, "is none that a store writes")
            return
        if recipe.digest(receipt.recipe) != key.digest:
            yield Damage(key, RECEIPT, "does not hold the recipe that names this folder")
        for name, item in receipt.outputs.items():
            if not (folder / name).is_file():
                yield Damage(key, name, "is missing")
            elif file_digest(folder / name) != item["sha256"]:
                yield Damage(key, name, "differs from what the stage wrote")


def _receipt(folder: Path) -> Receipt:
    """Raises FileNotFoundError, or ValueError for what is no receipt."""
    text = (folder / RECEIPT).read_bytes()
    try:
        receipt = Receipt(**json.loads(text))
        outputs = {name: {"sha256": item["sha256"], "bytes": item["bytes"]} for name, item in receipt.outputs.items()}
        return replace(receipt, recipe=dict(receipt.recipe), outputs=outputs)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(
            f"{folder / RECEIPT} must be a receipt as a store writes it, but is damaged ({error}); delete {folder} and "
            "run again"
        ) from None


def _is_whole(folder: Path) -> bool:
    """Where the receipt is damaged nobody knows what else is, so the artefact is made again."""
    try:
        outputs = _receipt(folder).outputs
        return all((folder / name).stat().st_size == item["bytes"] for name, item in outputs.items())
    except (FileNotFoundError, ValueError):
        return False


def _attempts(shelf: Path) -> list[Path]:
    """Folders in which an artefact is or was built, those of which nobody took anything yet."""
    return [place for place in shelf.glob("[!.]*/") if is_name(place.name) and not place.name.startswith(OVERTAKEN)]


def _goes_on(place: Path) -> bool:
    """Whether somebody builds here."""
    return not (place / RELEASED).exists() and is_alive(place)


def _take_over(left: Sequence[Path], own: Path) -> None:
    """Have in `own` what the latest of these attempts left; of several who take over, one gets it."""
    for place in sorted(left, key=_last_sign, reverse=True):
        surely_over = is_ended(place.name) or (place / RELEASED).exists()
        aside = own if surely_over else own.with_name(f"{OVERTAKEN}{own_name()}")
        with contextlib.suppress(FileNotFoundError):
            os.rename(place, aside)
            # Whoever was silent may wake up and write on to what it holds open: go on with a copy, and let it have its
            # own until the artefact is there.
            if not surely_over and not _copied(aside, own):
                _empty(own)
            (own / RELEASED).unlink(missing_ok=True)
            os.utime(own)
            return


def _copied(source: Path, target: Path) -> bool:
    """Copy a folder into another; whether nothing moved meanwhile, so that the copy is of one moment."""
    before = _marks(source)
    try:
        shutil.copytree(source, target, dirs_exist_ok=True)
    except OSError:  # shutil.Error is one
        return False
    return _marks(source) == before


def _marks(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file."""
    found = {}
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            stat = path.stat()
            found[str(path)] = (stat.st_size, stat.st_mtime_ns)
    return found


def _last_sign(place: Path) -> float:
    try:
        return place.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _begin(place: Path, originals: Originals) -> dict[str, Any]:
    """Have a folder to build in; what is there goes if it was begun when the raw files were others."""
    begun: dict[str, Any] = recipe.plain(originals())
    if _read(place / BEGUN) != begun:
        _empty(place)
        write_json(place / BEGUN, begun)
    return begun


def _empty(place: Path) -> None:
    """The folder stays: it tells that somebody is at work."""
    for path in place.iterdir():
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _attempt(place: Path, build: Build, lock: int, check: Callable[[], None]) -> None:
    """Do the work, unless it was done and the run killed while its files were read for the receipt."""
    out, scratch = place / OUT, place / SCRATCH
    if (place / BUILT).exists():
        return
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    scratch.mkdir(exist_ok=True)
    start = time.monotonic()
    notes = dict(build(Building(out, scratch, lock, check)) or {})
    facts = {
        "seconds": round(time.monotonic() - start, 3),
        "peak_memory_bytes": int(notes.pop("peak_memory_bytes", 0) or peak_memory_bytes()),
        "cpu": notes.pop("cpu", ""),
        "cpu_seconds": notes.pop("cpu_seconds", None),
        "notes": notes,
    }
    _flush_all(out)
    write_json(place / BUILT, facts)


def _moved(begun: Mapping[str, Any], originals: Originals) -> list[str]:
    """Names of the raw files that were touched since."""
    now: dict[str, Any] = recipe.plain(originals())
    return sorted(name for name in begun.keys() | now.keys() if begun.get(name) != now.get(name))


def _read(path: Path) -> Any:
    """What a JSON file holds; None if it is missing, or was cut short when the power went."""
    with contextlib.suppress(OSError, ValueError):
        return json.loads(path.read_text())
    return None


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
        "options": recipe.plain(options, where="options", decisive=True),
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


def _names(inputs: Any) -> Iterator[str]:
    """Artefacts in the inputs of a recipe, at any depth."""
    match inputs:
        case str() if re.fullmatch(r"\w+/[0-9a-f]{64}", inputs):
            yield inputs
        case dict() | list():
            for item in inputs.values() if isinstance(inputs, dict) else inputs:
                yield from _names(item)


def find_stores(folder: Path) -> list[Store]:
    """The store itself, the store of a sequence, or the stores of all sequences of an output folder."""
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}")
    for found in ([folder] if folder.name == "store" else [], [folder / "store"], sorted(folder.glob("*/store"))):
        if present := [Store(path) for path in found if path.is_dir()]:
            return present
    raise FileNotFoundError(f"{folder} holds no artefact store; name the folder that `packuv run --out` wrote")


def try_lock(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open file for this process, unless another has it; the kernel frees it when the last holder ends.

    Who only wants to know whether it is locked takes it shared, so that two who ask at once see no lock. Where a file
    system has no locks it is as if nobody had it: see `tasks.artefacts.presence`.
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
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
