"""The fits of a sequence: a chain of keyframes, segments beside it, and keyframes that a segment turns out to need."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from packuv.keyframes import fitting_order, promoted
from pipelines.options import SequenceOptions
from tasks.plan import Plan
from tasks.splat import count_pictures, cut_segment, fit_first, fit_next, fit_segment, read_losses
from tasks.store import Key
from tasks.workshop import Workshop


class Future(Protocol):
    """A stage under way."""

    def result(self) -> Any:
        """Wait for the stage; its artefact, or the exception that it raised."""


Submit = Callable[..., Future]


@dataclass(frozen=True)
class Chain:
    """What every fit of a sequence reads, and who starts it."""

    workshop: Workshop
    plan: Plan
    options: SequenceOptions
    submit: Submit
    groups: Key
    points: Key
    background: Key | None
    motion: Key

    def fit(self, spans: Sequence[range]) -> Iterator[tuple[Key, Key]]:
        """A keyframe and its segment for each span in order, and for each piece that a promoted keyframe cuts off.

        The next keyframe is submitted before the segment, because the chain is the longest way through the work.
        """
        instants = [span.start for span in spans]
        anchor, steps = fitting_order(count_pictures(self.workshop, self.plan, self.groups, instants))
        keys, segments = {anchor: self._first(instants[anchor]).result()}, {}
        last = anchor
        for index, start in steps:
            following = self._next(keys[start], (instants[start], instants[index]))
            segments[last] = self._segment(keys[last], spans[last])
            keys[index], last = following.result(), index
        segments[last] = self._segment(keys[last], spans[last])
        for index, span in enumerate(spans):
            yield from self._promote(keys[index], segments[index].result(), span)

    def _promote(self, key: Key, segment: Key, span: range) -> list[tuple[Key, Key]]:
        """The segment, cut where the fit of a frame shows that a keyframe is missing."""
        frame = promoted(read_losses(self.workshop, segment), self.options.keyframes)
        if frame is None:
            return [(key, segment)]
        rest = range(span.start + frame, span.stop)
        after = self._next(key, (span.start, rest.start)).result()
        head = self.submit(cut_segment, self.workshop, segment, frame).result()
        return [(key, head), *self._promote(after, self._segment(after, rest).result(), rest)]

    def _first(self, instant: int) -> Future:
        sources, options = (self.workshop, self.plan, self.groups, self.points, self.background), self.options
        return self.submit(fit_first, *sources, instant, options.pictures, options.motion, options.fit)

    def _next(self, key: Key, step: tuple[int, int]) -> Future:
        sources, options = (self.workshop, self.plan, self.groups, self.points, self.background), self.options
        return self.submit(fit_next, *sources, key, step, options.pictures, options.motion, options.fit)

    def _segment(self, key: Key, span: range) -> Future:
        sources, options = (self.workshop, self.plan, self.groups, self.points, self.motion), self.options
        return self.submit(fit_segment, *sources, key, span, options.pictures, options.fit)
