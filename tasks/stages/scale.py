"""Scale: the rig in metres, and where up is, by what capture.toml knows of a board, of distances and of up."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from shutil import copyfile
from typing import Any

import numpy as np

from calibration.accept import CheckOptions, check_rig
from calibration.board import Board, find_corners
from calibration.rig import Rig
from calibration.scale import (
    Distance,
    Located,
    Measured,
    ScaleOptions,
    Upward,
    contradictions,
    locate_board,
    measure_board,
    measure_distances,
    scaled,
    up_as_told,
    up_of_board,
    up_of_cameras,
)
from packuv.files import save_json
from sync.capture import SETTINGS, Capture
from tasks.artefacts.stage import Notes, Stage, Work
from tasks.stages.calibrate import CHECK, MATCHES, without_nan
from tasks.stages.footage import RIG, Footage, Take

SCALE = "scale.json"
"""Name of the file of what was measured"""


@dataclass(frozen=True, kw_only=True)
class Known:
    """What capture.toml says of a rig's size and of up."""

    board: Board | None = None
    distances: tuple[Distance, ...] = ()
    up: str | tuple[float, float, float] | None = None

    def __bool__(self) -> bool:
        return bool(self.board or self.distances or self.up)


@dataclass(frozen=True, kw_only=True)
class ScaleRig(Stage):
    """Bring a rig to metres and find up: rig.json, check.json, matches.json as the rig has it, scale.json."""

    name, version = "rig", 1
    take: Take
    """All cameras of the rig, as filmed"""
    first: int
    """Instant from which on the board is looked for"""
    known: Known
    check: CheckOptions
    options: ScaleOptions = field(default_factory=ScaleOptions)

    @property
    def label(self) -> str:
        return "scale"

    def build(self, work: Work) -> Notes:
        rig, known, options = Footage(self.take, work.site).load_rig(), self.known, self.options
        located = self._locate(rig, known.board, work) if known.board else []
        board = measure_board(known.board, located, options=options) if known.board else None
        distance = measure_distances(rig, known.distances, options=options) if known.distances else None
        up, best = self._up(rig, located), board or distance
        odd = {
            "scale": (*contradictions(rig, board, distance, options=options), *(best.doubts if best else ())),
            "up": up.doubts if up else (),
        }
        placed = scaled(rig, best.metres_per_unit) if best else rig
        told = [_told(best)] if best else []
        if up:
            x, y, z = map(float, up.direction)
            placed = replace(placed, up=(x, y, z))
            told.append(f"up by {up.told}")
        placed = replace(placed, source="; ".join([rig.source, *told]))
        self._save(placed, {what: "; ".join(texts) for what, texts in odd.items() if texts}, work)
        measured = {"board": board, "distance": distance}
        figures = {what: _figures(one) for what, one in measured.items() if one}
        save_json(work.out / SCALE, without_nan({**figures, "up": up and {"direction": placed.up, "by": up.told}}))
        return {"metres_per_unit": best.metres_per_unit if best else None, "told": told}

    def _locate(self, rig: Rig, board: Board, work: Work) -> list[Located]:
        """The board at the instants at which two cameras or more locate it; raises ValueError where there is none."""
        footage, options = Footage(self.take, work.site), self.options
        last = len(footage.load_groups().times_ns) - 1
        located, looked, seen, markers = list[Located](), 0, Counter[str](), 0
        for instants in _rounds(self.first, last, options):
            for number, instant in enumerate(instants):
                work.progress(number, len(instants), f"looking for the {board.kind} board")
                pictures = footage.filmed(instant)
                corners = {name: find_corners(board, picture) for name, picture in pictures.items()}
                looked += len(pictures)
                markers = max([markers, *(found.markers for found in corners.values())])
                seen.update(name for name, found in corners.items() if len(found.ids))
                if (found := locate_board(rig, corners, options=options)) is not None:
                    located.append(found)
            if len(located) >= options.enough:
                break
        if not located or measure_board(board, located, options=options) is None:
            raise ValueError(self._missing(board, looked, seen, markers))
        return located

    def _missing(self, board: Board, looked: int, seen: Counter[str], markers: int) -> str:
        """Why the board tells no scale."""
        asked = f"{SETTINGS} describes a {board}, but"
        where = f"in {looked} pictures from instant {self.first} on"
        cure = f"film it before two cameras or more, correct [board], or take it out of {SETTINGS}"
        if seen:
            names = ", ".join(f"{name} in {count}" for name, count in seen.most_common(4))
            return f"{asked} no two cameras locate its corners at one instant: it is seen by {names}, {where}; {cure}"
        if markers:
            return (
                f"{asked} none of its corners is seen, although up to {markers} markers of {board.dictionary} are, "
                f"{where}; columns, rows, marker or legacy are other ones"
            )
        return f"{asked} it is not seen {where}; {cure}"

    def _up(self, rig: Rig, located: list[Located]) -> Upward | None:
        match self.known.up:
            case None:
                return None
            case "board":
                return up_of_board(rig, located, options=self.options)
            case "cameras":
                return up_of_cameras(rig)
            case (x, y, z):
                return up_as_told((float(x), float(y), float(z)))
        raise AssertionError(f"sync.capture lets no {self.known.up!r} pass")

    def _save(self, rig: Rig, odd: dict[str, str], work: Work) -> None:
        """With what was odd about the rig before."""
        assert self.take.rig is not None
        given = work.path(self.take.rig)
        said = json.loads((given / CHECK).read_text())["suspicious"]
        report = check_rig(rig, options=self.check)
        rig.save(work.out / RIG)
        save_json(work.out / CHECK, without_nan(replace(report, suspicious={**said, **odd}).to_json()))
        copyfile(given / MATCHES, work.out / MATCHES)


def known_of(capture: Capture) -> Known:
    """What capture.toml knows; raises ValueError that names the file and the key."""
    settings = capture.settings
    try:
        board = None if settings.board is None else _board(settings.board)
        distances = tuple(map(Distance.from_table, settings.distance))
        for name in (name for distance in distances for name in distance.cameras):
            if name not in capture.cameras:
                raise ValueError(f"distance names {name!r}, which has no video or is ignored")
        if capture.calibration is None and isinstance(settings.up, tuple):
            raise ValueError(
                "up is a direction in the calibration's world, but here COLMAP solves the cameras, whose world lies "
                "anyhow; write up = 'cameras', or lay a board on the floor"
            )
    except ValueError as problem:
        raise ValueError(f"{capture.folder / SETTINGS}: {problem}") from None
    return Known(board=board, distances=distances, up=settings.up)


def _board(table: Any) -> Board:
    try:
        return Board.from_table(dict(table))
    except ValueError as problem:
        raise ValueError(f"[board]: {problem}") from None


def _rounds(first: int, last: int, options: ScaleOptions) -> Iterator[list[int]]:
    """Instants to look at, spread over the recording, twice as many each time and none twice."""
    tried, count = set[int](), options.instants
    while count <= options.most_instants:
        chosen = np.unique(np.linspace(first, last, count).round().astype(int)).tolist()
        fresh = [instant for instant in chosen if instant not in tried]
        if not fresh:
            return
        yield fresh
        tried.update(fresh)
        count *= 2


def _told(measured: Measured) -> str:
    spread = f", lengths differ by {measured.spread:.2%}" if measured.spread else ""
    return f"a unit of it is {measured.metres_per_unit:.5g} m by {measured.told}{spread}"


def _figures(measured: Measured) -> dict[str, Any]:
    plain = {"metres_per_unit": measured.metres_per_unit, "spread": measured.spread, "by": measured.told}
    return {**plain, **measured.figures, "doubts": list(measured.doubts)}
