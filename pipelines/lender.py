"""The take whose rig another one uses, as far as its rig goes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipelines.chain import Submit
from pipelines.folder import claim
from pipelines.options import compose
from pipelines.request import RunRequest
from pipelines.stages import Made, Sequence
from sync.capture import Capture, find_lender
from tasks.artefacts.originals import Originals
from tasks.artefacts.stage import Stage
from tasks.artefacts.store import Key, Store
from tasks.artefacts.workshop import Listener, Workshop
from tasks.stages.calibrate import store_of
from tasks.stages.plan import Plan


def lender_of(
    request: RunRequest,
    capture: Capture,
    workshop: Workshop,
    engine: Callable[[Callable[[Stage], Key]], Submit],
) -> Sequence | None:
    """The sequence that `rig_from` in capture.toml leads to, with a store of its own; None without the key.

    Its rig has the recipe that a run of that take gives it, so whoever comes first makes it for all. Raises as
    `find_lender` does.
    """
    lender = find_lender(capture)
    if lender is None:
        return None
    options = compose(request.preset, lender.settings, request.settings, seed=request.seed, quality=request.quality)
    # Of its instants a rig needs none in particular; one is the least to find room for.
    plan = Plan(lender.folder.absolute(), lender.videos, (), 0, 1, "cpu", side_by_side=False)
    store = Store(store_of(workshop.store.root, lender.name))
    claim(store.root.parent, lender)
    originals = Originals(lender, store.root.parent / "file_digests.json")
    own = Workshop(store, originals, workshop.jobs, Elsewhere(workshop.listener, lender.name), workshop.maker)
    return Sequence(own, plan, options, engine(own.make), Made())


@dataclass(frozen=True)
class Elsewhere:
    """A `Listener` that tells another one in which take something happens."""

    listener: Listener
    take: str

    def started(self, label: str) -> None:
        self.listener.started(self._named(label))

    def moved(self, label: str, done: float, total: float, note: str = "") -> None:
        self.listener.moved(self._named(label), done, total, note)

    def waiting(self, label: str) -> None:
        self.listener.waiting(self._named(label))

    def finished(self, label: str, key: Key, seconds: float) -> None:
        self.listener.finished(self._named(label), key, seconds)

    def failed(self, label: str, error: BaseException) -> None:
        self.listener.failed(self._named(label), error)

    def skipped(self, label: str, reason: str) -> None:
        self.listener.skipped(self._named(label), reason)

    def _named(self, label: str) -> str:
        return f"{self.take}: {label}"
