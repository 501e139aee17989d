"""The stages of one sequence, in order.

Written once for both ways to run them: `submit` starts a stage and returns something with a `result()`, be it a
Prefect future or one of Python's. A stage is submitted when its inputs are there: a stage that waits inside a worker
would keep that worker from working.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from packuv.fit.options import FirstOptions, NextOptions
from packuv.lpips import lacking
from packuv.motion import MotionBackend
from packuv.motion.keyframes import fitting_order
from packuv.motion.patches import epochs
from pipelines.chain import Chain, Epoch, Submit
from pipelines.options import SequenceOptions
from pipelines.request import STAGES
from pipelines.space import check_space
from sync.capture import find_capture, find_plate
from sync.clock import ClockMode
from sync.masks import find_masks
from sync.nearby import unread
from tasks.artefacts.jobs import CancelledError
from tasks.artefacts.stage import Files, Stage
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.calibrate import FindPoints, ImportRig, SolveRig, borrow_rig, find_rig, read_names
from tasks.stages.clock import find_starts
from tasks.stages.content import CompareContent
from tasks.stages.encode import Encode, Verify
from tasks.stages.evaluate import Evaluate, cameras_beside, scored_cameras
from tasks.stages.fitting import (
    FitBackdrop,
    PatchBackdrop,
    PatchBackground,
    background_of,
    count_pictures,
    lacks_backdrop,
)
from tasks.stages.footage import MaskedTake, PictureOptions, Take
from tasks.stages.light import MeasureLight, is_steady
from tasks.stages.masks import CheckMasks, CheckUnseenMasks, MatchMasks, believed
from tasks.stages.plan import Plan
from tasks.stages.preview import Preview
from tasks.stages.scale import ScaleRig, known_of
from tasks.stages.synchronize import UNREAD, synchronize
from tasks.stages.track import (
    RAFT,
    ChooseDatedKeyframes,
    ChooseKeyframes,
    DatePatches,
    FindMotion,
    FindMotionByRaft,
    read_patches,
    read_spans,
)


@dataclass
class Made:
    """Artefacts of a run by stage, in the order of the run; keyframes and segments have several each."""

    keys: dict[str, list[Key]] = field(default_factory=dict)

    def add(self, *keys: Key) -> Key:
        """Note artefacts of one stage; returns the last one."""
        for key in keys:
            self.keys.setdefault(key.stage, []).append(key)
        return keys[-1]

    def only(self, stage: str) -> Key:
        """The artefact of a stage that has one; raises KeyError for a stage that did not run."""
        (key,) = self.keys[stage]
        return key

    def get(self, stage: str) -> Key | None:
        """The first artefact of a stage, or None."""
        return self.keys[stage][0] if stage in self.keys else None


@dataclass(frozen=True)
class Sequence:
    """One sequence on its way through the stages."""

    workshop: Workshop
    plan: Plan
    options: SequenceOptions
    submit: Submit
    made: Made
    lender: Sequence | None = None
    """The take whose rig this one uses"""
    watched: bool = False
    """Somebody may look at pictures of what is fitted before all is"""
    judged: PictureOptions | None = None
    """How large the pictures are on which scores are measured; None: as those that are fitted"""
    synchronized: Callable[[Key], object] = lambda groups: None
    """Hears of the groups when they are there"""

    def run(self, stop_after: str) -> None:
        """Have every artefact up to the stage `stop_after`, noting each in `made`.

        Raises what the first failing stage raises, and OSError when the disk cannot hold the results.
        """
        steps = {
            "sync": self._synchronize,
            "calibrate": self._calibrate,
            "flow": self._track,
            "fit": self._fit,
            "encode": self._encode,
            "verify": self._verify,
            "evaluate": self._evaluate,
        }
        for stage in STAGES[: STAGES.index(stop_after) + 1]:
            if stage != "report":  # which is written of whatever there is
                steps[stage]()

    def pilot(self, frames: int) -> Key:
        """Scores of the first frames alone, on the cameras that are held out; what is made for them beside these frames
        is what a whole run needs. For a sequence of its own, whose `made` then has no more than that."""
        self.run("flow")
        spans = self._spans()
        first = range(spans[0].start, min(spans[0].stop, spans[0].start + frames))
        self.made.add(*self._chain(spans).pilot(first))
        scene = self.encoded()
        self._make(replace(scene, take=replace(scene.take, stop=self.plan.first + first.stop)))
        return self.score(self.placed.held_out, self.judged or self.options.pictures)

    def encoded(self) -> Encode:
        """The scene file of the segments that are there."""
        return Encode(
            take=replace(self._take("points"), cameras=tuple(self.placed.videos)),
            held_out=self.placed.held_out,
            key=self.made.keys["key"][0],
            segments=tuple(self.made.keys["segment"]),
            options=self.options.encode,
        )

    @property
    def placed(self) -> Plan:
        """The plan without cameras that a solved rig does without."""
        rig = self.made.get("rig")
        return self.plan if rig is None else self.plan.only(read_names(self.workshop.path(rig)))

    def _make(self, stage: Stage) -> Key:
        return self.made.add(self.submit(stage).result())

    def _take(self, rig: str) -> Take:
        """The pictures that a fit sees, with the rig of that stage."""
        return Take(
            groups=self.made.only("sync"),
            rig=self.made.only(rig),
            light=self._light(),
            cameras=self.placed.fitted,
            first=self.plan.first,
            stop=self.plan.stop,
            pictures=self.options.pictures,
        )

    def matched(self) -> Key:
        """Which frames belong together; raises ValueError or FileNotFoundError for what a run refuses until then."""
        find_plate(find_capture(self.plan.capture))  # whose absence should not show hours later
        for note in unread(self.workshop.capture):
            self.workshop.listener.skipped(UNREAD, note)
        self._match_masks()
        options, starts = self.options, None
        if options.sync.clock is ClockMode.CONTENT:
            starts = self._make(find_starts(self.workshop, options.motion, options.pictures.transfer))
        return self._make(synchronize(self.workshop, options.sync, starts))

    def _match_masks(self) -> None:
        capture, workshop = self.workshop.capture, self.workshop
        if masks := find_masks(capture):
            videos = workshop.files({camera: capture.videos[camera] for camera in masks}, "reading videos")
            # Nothing is made of it: who only looks goes on, and a cancelled run ends where it works next.
            with suppress(CancelledError):
                self._make(MatchMasks(videos=videos, masks=workshop.files(masks, "reading masks")))

    def _synchronize(self) -> None:
        groups = self.matched()
        check_space(self.workshop, self.plan, self.options, groups)
        self.synchronized(groups)

    def _calibrate(self) -> None:
        groups, plan = self.made.only("sync"), self.plan
        rig = self._place()
        pictures = self.options.pictures.as_filmed
        filmed = Take(groups=groups, cameras=tuple(plan.videos), first=plan.first, pictures=pictures)
        if self.options.light.enabled:
            take = replace(filmed, stop=plan.stop)
            self._make(MeasureLight(take=take, fitted=plan.fitted, options=self.options.light))
        else:
            self.workshop.listener.skipped("light", "light.enabled is false")
        take = replace(filmed, cameras=tuple(self.placed.videos), rig=rig, light=self._light())
        self._make(FindPoints(take=take, fitted=self.placed.fitted, options=self.options.points))

    def _light(self) -> Key | None:
        """Light and exposures over time; None where they are steady, so that nothing depends on how that was found."""
        key = self.made.get("light")
        return None if key is None or is_steady(self.workshop.path(key)) else key

    def _place(self) -> Key:
        """The rig: this take's own, or that of the lender, which makes it unless it is there."""
        groups, pictures, options = self.made.only("sync"), self.options.pictures, self.options.rig
        if self.lender is None:
            return self._scale(find_rig(self.workshop, self.plan, groups, pictures, options))
        self.lender.run("sync")
        lent = self.lender._place()
        return self._make(borrow_rig(self.workshop, self.plan, groups, pictures, self.lender.workshop, lent, options))

    def _scale(self, placed: ImportRig | SolveRig) -> Key:
        """The rig as it was placed or, where capture.toml knows its size or up, brought to that."""
        known = known_of(self.workshop.capture)
        if not known:
            return self._make(placed)
        rig, options = self.submit(placed).result(), self.options
        take = replace(placed.take, rig=rig, cameras=read_names(self.workshop.path(rig)))
        return self._make(
            ScaleRig(take=take, first=self.plan.first, known=known, check=options.rig.check, options=options.scale)
        )

    def _track(self) -> None:
        take, options = self._take("rig"), self.options
        motion = self._make(self._motion(take))
        self._compare(take, motion)
        self._check_masks(take, motion)
        if patches := self._patches(take):
            self._make(ChooseDatedKeyframes(motion=motion, patches=patches, options=options.keyframes))
        else:
            self._make(ChooseKeyframes(motion=motion, options=options.keyframes))

    def _motion(self, take: Take) -> FindMotion:
        motion, raft = self.options.motion, self.options.raft
        if motion.backend is not MotionBackend.RAFT or raft.weights is None:
            return FindMotion(take=take, options=motion)
        weights = Path(raft.weights).resolve()
        network, unnamed = self.workshop.files({RAFT: weights}, "motion"), replace(raft, weights=None)
        return FindMotionByRaft(take=take, options=motion, network=network, raft=unnamed, weights=str(weights))

    def _compare(self, take: Take, motion: Key) -> None:
        if not self.options.content.enabled:
            self.workshop.listener.skipped("content", "content.enabled is false")
            return
        unseen, options = self.placed.held_out, self.options
        self._make(
            CompareContent(
                take=take, unseen=unseen, motion=motion, motion_options=options.motion, options=options.content
            )
        )

    def _check_masks(self, take: Take, motion: Key) -> None:
        """Compare masks with what moves, which tells whether they are used."""
        unseen = replace(take, cameras=self.placed.held_out)
        if masks := self._masks(take):
            self._make(CheckMasks(take=take, motion=motion, masks=masks))
        if masks := self._masks(unseen):
            options = self.options.motion
            self._make(CheckUnseenMasks(take=unseen, masks=masks, motion_options=options))

    def _masks(self, take: Take) -> Files | None:
        """Of the take's cameras; None where none has any."""
        found = find_masks(self.workshop.capture)
        masks = {name: path for name, path in found.items() if name in take.cameras}
        return self.workshop.files(masks, "reading masks") if masks else None

    def _masked(self, take: Take) -> Take:
        """The take with masks of those of its cameras whose masks fit what moves; the same where those of none do."""
        notes = [self.workshop.store.receipt(key).notes for key in self.made.keys.get("masks", ())]
        good = {name for part in notes for name in believed(part)}
        masks = self._masks(replace(take, cameras=tuple(name for name in take.cameras if name in good)))
        return MaskedTake(**vars(take), masks=masks) if masks else take

    def _patches(self, take: Take) -> Key | None:
        """What changes for good; None where nothing does, so that nothing depends on how that was found."""
        if not (self.options.patches.enabled and self.options.fit.background.instants):
            off = "patches.enabled is false" if not self.options.patches.enabled else "fit.background.instants is 0"
            self.workshop.listener.skipped("patches", off)
            return None
        self._make(DatePatches(take=take, options=self.options.patches))
        return self._dated()

    def _dated(self) -> Key | None:
        key = self.made.get("patches")
        return key if key and read_patches(self.workshop.path(key)).found else None

    def _fit(self) -> None:
        spans = self._spans()
        previews = []
        for number, (key, segment) in enumerate(self._chain(spans).fit(spans), start=1):
            self.made.add(key, segment)
            if self.watched:
                previews.append(self.submit(self._preview(key, segment, number)))
        for preview in previews:
            self.made.add(preview.result())

    def _chain(self, spans: list[range]) -> Chain:
        take = self._take("points")
        told = replace(take, stop=None)  # a fit is told its instants, whatever comes after them
        parts, motion = self._epochs(take, told, spans), self.made.only("motion")
        masked = self._masked(told)
        return Chain(self.workshop, self.placed, self.options, self.submit, told, masked, parts, motion)

    def _background(self, take: Take) -> Key | None:
        options = self.options.fit.background
        if not options.instants:
            self.workshop.listener.skipped("background", "fit.background.instants is 0")
            return None
        return self._make(background_of(self.workshop, self._masked(take), options))

    def _epochs(self, take: Take, told: Take, spans: list[range]) -> list[Epoch]:
        """The times between the dates at which something changes for good, each with what stands still in it."""
        background, dated = self._background(take), self._dated()
        if background is None or not self._has_backdrop(take, background, spans):
            return [Epoch(0, background, None)]
        fit = self.options.fit
        if dated is None:
            first = FitBackdrop(take=told, background=background, options=fit.part(FirstOptions))
            return [Epoch(0, background, self._make(first))]
        times = epochs(read_patches(self.workshop.path(dated)).dates, spans[-1].stop)
        under_way = [
            self.submit(PatchBackground(take=self._masked(take), background=background, patches=dated, epoch=number,
                                        options=fit.background)) for number in range(len(times))
        ]  # fmt: skip
        stills = [self.made.add(future.result()) for future in under_way]
        longest, steps = fitting_order([len(time) for time in times])
        whole = FitBackdrop(take=told, background=stills[longest], options=fit.part(FirstOptions))
        backdrops = {longest: self._make(whole)}
        for number, beside in steps:
            patch = PatchBackdrop(take=told, previous=backdrops[beside], before=stills[beside], after=stills[number],
                                  options=fit.part(NextOptions), epoch=number)  # fmt: skip
            backdrops[number] = self._make(patch)
        return [Epoch(time.start, stills[number], backdrops[number]) for number, time in enumerate(times)]

    def _has_backdrop(self, take: Take, background: Key, spans: list[range]) -> bool:
        pictures = count_pictures(self.workshop, self.placed, take.groups, [span.start for span in spans])
        if reason := lacks_backdrop(self.workshop, background, max(pictures)):
            self.workshop.listener.skipped("backdrop", reason)
        return reason is None

    def _spans(self) -> list[range]:
        return read_spans(self.workshop.path(self.made.only("keyframes")))

    def _preview(self, key: Key, segment: Key, number: int) -> Preview:
        take = replace(self._take("points"), cameras=scored_cameras(self.placed, self.options.evaluate), stop=None)
        return Preview(take=take, key=key, segment=segment, number=number)

    def _encode(self) -> None:
        self._make(self.encoded())

    def _verify(self) -> None:
        self._make(Verify(scene=self.made.only("encode"), segments=tuple(self.made.keys["segment"])))

    def _evaluate(self) -> None:
        cameras = scored_cameras(self.placed, self.options.evaluate)
        if not self.placed.held_out:
            why = f"no camera is held out; scored on fitted {', '.join(cameras)}"
            self.workshop.listener.skipped("unseen scores", why)
        self.score(cameras, self.judged or self.options.pictures)

    def score(self, cameras: tuple[str, ...], pictures: PictureOptions) -> Key:
        """Scores of the scene on these cameras, against pictures of this size; noted in `made`, as in a run."""
        take = replace(self._take("points"), cameras=cameras, pictures=pictures, stop=None)
        return self._make(self._evaluation(self._masked(take)))

    def _evaluation(self, take: Take) -> Evaluate:
        """With LPIPS, where the file of weights and the package for it are there."""
        scene, named = self.made.only("encode"), self.options.evaluate.lpips_weights
        beside = cameras_beside(self.placed, self.options.evaluate)
        weights = Path(named).resolve() if named else None
        why, device = lacking(weights), self.options.fit.device
        if why or weights is None:
            return Evaluate(take=take, beside=beside, scene=scene, no_lpips=why, device=device)
        backbone = self.workshop.files({"backbone": weights}, "evaluate")
        return Evaluate(take=take, beside=beside, scene=scene, backbone=backbone, weights=str(weights), device=device)
