"""The fits of a sequence: keyframes, from the backdrop or one from another, segments beside them, keyframes that a
segment turns out to need, and borders between segments that show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from packuv.fit.options import FirstOptions, FrameOptions, NextOptions
from packuv.motion.keyframes import fitting_order, promoted
from pipelines.options import SequenceOptions
from tasks.artefacts.stage import Stage
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.fitting import (
    CutSegment,
    FitFirst,
    FitNext,
    FitSegment,
    MeasureSeam,
    count_pictures,
    read_losses,
    read_seam,
)
from tasks.stages.footage import Take
from tasks.stages.plan import Plan


class Future(Protocol):
    """A stage under way."""

    def result(self) -> Key:
        """Wait for the stage; its artefact, or the exception that it raised."""


class Submit(Protocol):
    """Starts a stage, now or when there is room."""

    def __call__(self, stage: Stage, /) -> Future: ...


@dataclass(frozen=True)
class Span:
    """The instants of a segment."""

    number: int
    """Of the segment, counted from 1; what is cut off it keeps the number"""
    instants: range


Piece = tuple[Key, Future, Span]
"""A keyframe, its segment and the segment's instants"""


@dataclass(frozen=True)
class Epoch:
    """The time between two dates at which something changes for good."""

    start: int
    """Its first instant"""
    background: Key | None
    backdrop: Key | None


@dataclass(frozen=True)
class Chain:
    """What every fit of a sequence reads, and who starts it."""

    workshop: Workshop
    plan: Plan
    options: SequenceOptions
    submit: Submit
    take: Take
    masked: Take
    """The same, with the foreground where masks tell it"""
    epochs: Sequence[Epoch]
    """Ascending, the first from instant 0 on; mostly the only one. No segment lies in two"""
    motion: Key

    def fit(self, spans: Sequence[range]) -> Iterator[tuple[Key, Key]]:
        """A keyframe and its segment for each span in order, and for each piece that a promoted keyframe cuts off.

        Side by side, all keyframes start from the backdrop, and none waits for another. One at a time, all but the
        first of an epoch go on from the end of the segment before, which costs less and shows no border.
        """
        numbered = [Span(number, span) for number, span in enumerate(spans, start=1)]
        pieces = self._pieces(numbered)
        before: Piece | None = None
        for index, span in enumerate(numbered):
            own = pieces.get(index)
            if before and not self._begins_epoch(span) and (own is None or self._shows(before, own)):
                own = self._continue(before, span)
            assert own is not None, "the first span of an epoch has a keyframe of its own"
            for piece in self._promote(*own):
                before = piece
                yield piece[0], piece[1].result()

    def pilot(self, span: range) -> tuple[Key, Key]:
        """A keyframe at the start of the span, as the first one of a sequence is, and its segment."""
        backdrop = self._epoch(span.start).backdrop
        key = self._first(span.start) if backdrop is None else self._next(backdrop, span.start)
        return key.result(), self._segment(key.result(), Span(1, span)).result()

    def _pieces(self, spans: Sequence[Span]) -> dict[int, Piece]:
        """Those whose keyframe goes on from no segment, by place: the first of each epoch, side by side all of them,
        and without a backdrop those up to the one that most cameras filmed."""
        if self.epochs[0].backdrop is None:
            alone = range(len(spans) if self.plan.side_by_side else 1)
            starts = [span.instants.start for span in spans]
            pictures = count_pictures(self.workshop, self.plan, self.take.groups, starts)
            return dict(self._linked(spans, alone, *fitting_order(pictures)))
        keys = {
            index: self._next(backdrop, span.instants.start)
            for index, span in enumerate(spans)
            if (self.plan.side_by_side or self._begins_epoch(span))
            and (backdrop := self._epoch(span.instants.start).backdrop)
        }
        return {index: self._piece(key.result(), spans[index]) for index, key in keys.items()}

    def _epoch(self, instant: int) -> Epoch:
        return next(epoch for epoch in reversed(self.epochs) if epoch.start <= instant)

    def _begins_epoch(self, span: Span) -> bool:
        return self._epoch(span.instants.start).start == span.instants.start

    def _linked(
        self, spans: Sequence[Span], alone: range, anchor: int, steps: Sequence[tuple[int, int]]
    ) -> Iterator[tuple[int, Piece]]:
        """Without a backdrop keyframes are fitted one from another; the next one is submitted before the segment,
        because this chain is the longest way through the work."""
        keys, last = {anchor: self._first(spans[anchor].instants.start).result()}, anchor
        for index, start in steps:
            if index > start and index not in alone:
                continue
            following = self._next(keys[start], spans[index].instants.start)
            yield last, self._piece(keys[last], spans[last])
            keys[index], last = following.result(), index
        yield last, self._piece(keys[last], spans[last])

    def _promote(self, key: Key, segment: Future, span: Span) -> Iterator[Piece]:
        """The segment, cut where the fit of a frame shows that a keyframe is missing."""
        frame = promoted(read_losses(self.workshop.path(segment.result())), self.options.keyframes)
        if frame is None:
            yield key, segment, span
            return
        head, rest = replace(span, instants=span.instants[:frame]), replace(span, instants=span.instants[frame:])
        cut = self.submit(CutSegment(segment=segment.result(), frames=frame))
        yield key, cut, head
        yield from self._promote(*self._continue((key, cut, head), rest))

    def _shows(self, before: Piece, piece: Piece) -> bool:
        """Whether the border between two segments flickers more than the first one does by itself."""
        limit, (key, segment, span) = self.options.keyframes.seam, before
        if not limit or len(span.instants) < 2:
            return False
        measured = self.submit(MeasureSeam(take=self.take, key=key, segment=segment.result(), after=piece[0]))
        ratio = read_seam(self.workshop.path(measured.result()))
        return ratio is not None and ratio > limit

    def _continue(self, before: Piece, span: Span) -> Piece:
        """A segment that goes on from the end of the one before it."""
        key, segment, _ = before
        return self._piece(self._next(key, span.instants.start, segment.result()).result(), span)

    def _piece(self, key: Key, span: Span) -> Piece:
        return key, self._segment(key, span), span

    def _first(self, instant: int) -> Future:
        fit = self.options.fit.part(FirstOptions)
        return self.submit(FitFirst(take=self.take, instant=instant, options=fit))

    def _next(self, key: Key, instant: int, end: Key | None = None) -> Future:
        return self.submit(
            FitNext(
                take=self.masked,
                background=self._epoch(instant).background,
                previous=key,
                end=end,
                instant=instant,
                motion=self.options.motion,
                options=self.options.fit.part(NextOptions),
            )
        )

    def _segment(self, key: Key, span: Span) -> Future:
        instants, fit = (span.instants.start, span.instants.stop), self.options.fit.part(FrameOptions)
        return self.submit(
            FitSegment(take=self.take, motion=self.motion, key=key, span=instants, options=fit, number=span.number)
        )
