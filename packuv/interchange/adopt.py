"""Splat files of other programs become a scene file, and the loss is told.

One file is a still scene, several are the frames of a sequence. Post-hoc UV mapping drops Gaussians, as the paper
warns: a map that was not trained for them has too few texels where they crowd.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from packuv.bounds import MOST_NUMBER
from packuv.files import check_apart, check_place
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, SCALE, Codes, Quantizer, attribute_values
from packuv.gaussians.floats import DRAWN_LOGIT, SH_C0, Gaussians, drawn, opacity, rows_of, with_canonical_axes
from packuv.gaussians.orbit import OrbitOptions, around, middle, near_of, orbit
from packuv.gaussians.rows import first_appearance, with_rows
from packuv.gaussians.segment import Segment
from packuv.gaussians.uvmap import assign_slots, choose_centre
from packuv.gaussians.uvsize import UvOptions
from packuv.interchange import antialiased, is_splats, read_gaussians
from packuv.interchange.clip import ANTIALIASED
from packuv.interchange.joined import equal_codes, segments_of
from packuv.interchange.likeness import likeness
from packuv.progress import Progress, no_progress, part_of
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.scene.header import ADOPTED

TAILS = (5e-5, 5e-4, 5e-3, 0.01, 0.02)
"""Shares of the values at either end of a column that its range need not hold; one stray value would coarsen all. The
first, unless the column has more strays: with ten times as much, pictures of a fitted scene came 6 to 20 dB worse."""
STRAY_GAIN = 4.0
"""A wider tail must make the squared error of a column so many times smaller"""
SEEN = 1 / SH_C0
"""The most that a value beyond the range of its code is wrong to the eye: of SH, from black to white"""
SEEN_LOG_SCALE = 1.0
"""The same of a log scale"""
MOST_VALUE = MOST_NUMBER / 10
"""Of a sound Gaussian: the ranges of codes, which reach a little farther, end at MOST_NUMBER"""
LEAST_TURN = 1e-10
"""Of the largest component of a quaternion that still tells a rotation: shorter ones are not brought to length 1"""
ROTATION_REACH = 0.7072
"""x, y and z of a canonical rotation are at most the square root of one half."""


@dataclass(frozen=True)
class AdoptOptions:
    """How splat files become a scene."""

    uv: UvOptions | None = field(default_factory=UvOptions)
    """The UV map that bounds the number of Gaussians; None keeps them all, which the compact layout allows"""
    rate: Fraction = Fraction(30)
    """Frames per second of a sequence"""
    segment_frames: int = 30
    """Longest segment; memory grows with it"""
    sh_degree: int | None = None
    """Highest SH degree to keep; None keeps what the files have"""
    orbit: OrbitOptions = field(default_factory=OrbitOptions)
    """Views from which the loss is measured; they become the scene's cameras"""
    compared_frames: int = 3
    """Frames of a sequence whose pictures are compared, evenly spread; 0 to compare none"""

    def __post_init__(self) -> None:
        if self.segment_frames < 1 or self.orbit.cameras < 1 or not self.rate > 0:
            raise ValueError(f"a scene needs frames in its segments, a camera and a rate above 0, but has {self}")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= 3:
            raise ValueError(f"a scene holds SH of degree 0 to 3, but {self.sh_degree} is asked for")


@dataclass(frozen=True)
class AdoptReport:
    """What came over, and what was lost."""

    frames: int
    segments: int
    bytes: int
    """Size of the scene file"""
    gaussians: int
    """Of all frames together, in the files"""
    broken: int
    """Of these, without a place, size, colour or rotation: what is not finite, or absurd; they are lost"""
    faint: int
    """Of these, fainter than any renderer draws"""
    pruned: int
    """Of the rest, for which the UV map had no texel"""
    kept_share: float
    """Share of all but the faint ones that the scene holds"""
    kept_alpha_share: float
    """The same, each counted by its alpha, and by 1 where that is unknown"""
    antialiased: bool
    """Whether the files ask for the opacities of Mip-Splatting, which are kept as a mark and not drawn"""
    empty: int
    """Frames without any Gaussian that is drawn"""
    saturated: int
    """Values of the first frame beyond the range of their codes"""
    psnr_pruned_db: tuple[float, ...]
    """Of every view of the frames compared, before the codes: the cost of pruning alone; infinite if none"""
    psnr_db: tuple[float, ...]
    """The same of the finished file"""

    def to_json(self) -> dict[str, Any]:
        """PSNR of equal pictures is null."""
        decibels = {key: [v if np.isfinite(v) else None for v in getattr(self, key)] for key in _PSNR}
        return {**vars(self), **decibels}


_PSNR = ("psnr_pruned_db", "psnr_db")


def find_frames(inputs: Sequence[Path]) -> list[Path]:
    """The splat files that are meant, one a frame: files as named, folders by their files in natural order.

    Raises FileNotFoundError, or ValueError for a folder without splat files or with several kinds.
    """
    found: list[Path] = []
    for path in map(Path, inputs):
        if not path.exists():
            raise FileNotFoundError(f"no splat file or folder {path}")
        found += [path] if is_splats(path) or not path.is_dir() else _in_folder(path)
    return found


def _in_folder(folder: Path) -> list[Path]:
    files = sorted((path for path in folder.iterdir() if is_splats(path)), key=_natural)
    kinds = sorted({path.suffix.lower() for path in files})
    if len(kinds) != 1:
        raise ValueError(f"a folder of frames holds splat files of one kind, but {folder} has {kinds or 'none'}")
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    """Numbers in names count as numbers: frame 9 comes before frame 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def adopt(frames: Sequence[Path], out: Path, *, options: AdoptOptions, progress: Progress = no_progress) -> AdoptReport:
    """Write a scene file of splat files, one a frame, and tell what was lost.

    Every file is read twice, at most one segment is in memory. A frame may be empty. Raises ValueError for files
    without any drawn Gaussian or of different SH degrees, or for an `out` that is one of them, FileNotFoundError for
    missing ones.
    """
    check_place(out)
    check_apart(out, frames)
    count, steps = len(frames), 4 * len(frames)  # survey, map, encode, verify
    survey = _Survey(options)
    for done, path in enumerate(frames, start=1):
        survey.add(path)
        progress(done, steps)
    if not survey.spheres:
        raise ValueError(f"{frames[0]} holds no Gaussians that can be drawn, nor does any other file of {len(frames)}")
    header = _header(survey, frames, options)
    mapper = _Mapper(header.quantizer, options)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.stem}.") as folder:
        coded = _coded(frames, header.quantizer, options, lambda done: progress(count + done, steps))
        parts: list[Path] = []
        for segment in segments_of(coded, longest=options.segment_frames):
            parts.append(Path(folder, f"{len(parts):05d}.npz"))
            mapper.keep(segment).save(parts[-1])
        summary = write_scene(out, parts, header, progress=part_of(progress, 2 * count, steps))
    pruned, finished = _compare(frames, out, options)
    wanted = survey.count - survey.faint
    return AdoptReport(
        frames=count,
        segments=len(parts),
        bytes=summary.bytes,
        gaussians=survey.count,
        broken=survey.broken,
        faint=survey.faint,
        pruned=wanted - survey.broken - mapper.kept,
        kept_share=mapper.kept / wanted,
        kept_alpha_share=min(1.0, mapper.kept_alpha / (mapper.alpha + survey.broken_alpha)),
        antialiased=survey.antialiased,
        empty=survey.empty,
        saturated=header.quantizer.saturation(survey.first),
        psnr_pruned_db=tuple(pruned),
        psnr_db=tuple(finished),
    )


def _header(survey: _Survey, frames: Sequence[Path], options: AdoptOptions) -> SceneHeader:
    """Ranges of all frames, regular times, and the cameras of the orbit."""
    cameras = orbit(*around(survey.spheres), options=options.orbit)
    times = np.array([round(index * 10**9 / options.rate) for index in range(len(frames))], dtype=np.int64)
    source = {"files": len(frames), "first": frames[0].name, "uv": None if options.uv is None else vars(options.uv)}
    extra = {"near": near_of(cameras), ADOPTED: source}
    if survey.antialiased:
        extra[ANTIALIASED] = True
    return SceneHeader(survey.quantizer(), times, options.rate, cameras, extra=extra)


@dataclass(frozen=True)
class Frame:
    """What a file holds."""

    gaussians: Gaussians
    """Those that a renderer draws, in canonical form"""
    broken: int
    broken_alpha: float
    """Sum of the alphas of what is broken, 1 where it is unknown"""
    faint: int


@np.errstate(invalid="ignore", over="ignore")  # broken values are counted, not computed with
def read_frame(path: Path, *, sh_degree: int | None) -> Frame:
    """The Gaussians of a file, and the number of those that are not drawn."""
    whole = read_gaussians(path, sh_degree=sh_degree)
    values = (whole.means, np.exp(whole.log_scales), whole.quaternions, whole.sh)
    sound = np.logical_and.reduce([(np.abs(v) < MOST_VALUE).all(axis=tuple(range(1, v.ndim))) for v in values])
    sound &= (np.abs(whole.quaternions) > LEAST_TURN).any(axis=1) & ~np.isnan(whole.opacity_logits)
    kept, lost = drawn(rows_of(whole, sound)), rows_of(whole, ~sound)
    seen = np.isnan(lost.opacity_logits) | (lost.opacity_logits >= DRAWN_LOGIT)  # what is faint is not missed
    alpha = np.nan_to_num(opacity(lost)[seen], nan=1.0)
    broken = int(seen.sum())
    return Frame(with_canonical_axes(kept), broken, float(alpha.sum()), len(whole) - len(kept) - broken)


class _Survey:
    """First pass: ranges of all values over all frames."""

    def __init__(self, options: AdoptOptions) -> None:
        self._options = options
        self.first: Gaussians
        self.spheres: list[tuple[np.ndarray, float]] = []
        """Centre and radius of what each frame draws"""
        self.count = self.broken = self.faint = self.empty = 0
        self.broken_alpha = 0.0
        self.antialiased = False
        self._low = self._high = np.empty(0)
        self._least = self._most = np.empty(0)

    def add(self, path: Path) -> None:
        found = read_frame(path, sh_degree=self._options.sh_degree)
        frame = found.gaussians
        self.count += len(frame) + found.broken + found.faint
        self.broken, self.faint = self.broken + found.broken, self.faint + found.faint
        self.broken_alpha += found.broken_alpha
        self.antialiased |= antialiased(path)
        if not len(frame):
            self.empty += 1
            return
        values = attribute_values(frame)
        low, high = _range(values)
        high[SCALE] = values[:, SCALE].max(axis=0)  # the few largest Gaussians cover much of the picture
        least, most = frame.means.min(axis=0), frame.means.max(axis=0)
        if not self.spheres:
            self.first, self._low, self._high, self._least, self._most = frame, low, high, least, most
        elif len(low) != len(self._low):
            raise ValueError(
                f"{path} has SH of degree {frame.sh_degree}, the first file {self.first.sh_degree}; "
                "frames need one degree, choose it with --sh-degree"
            )
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)
        self._least, self._most = np.minimum(self._least, least), np.maximum(self._most, most)
        self.spheres.append(middle(frame, share=self._options.orbit.share))

    def quantizer(self) -> Quantizer:
        """Ranges that hold all but strays; the axes of the scale share one, the colours of an SH coefficient too."""
        low, high = self._low.astype(np.float64), self._high.astype(np.float64)
        for group in (slice(0, 3), *(slice(k, k + 3) for k in range(OPACITY + 1, len(low), 3))):
            low[group], high[group] = low[group].min(), high[group].max()
        high = np.maximum(high, low + 1e-3)
        low[3:6], high[3:6] = -ROTATION_REACH, ROTATION_REACH
        low[OPACITY], high[OPACITY] = OPACITY_RANGE
        centre = self._centre()
        distance = np.maximum(np.abs(self._least - centre), np.abs(self._most - centre)).astype(np.float64)
        typical = float(np.median(np.linalg.norm(self.first.means - centre, axis=1)))
        unit = 0.5 * max(typical, 1e-6)
        return Quantizer(centre, unit, 1.001 * np.maximum(distance, unit), low, high, self.first.sh_degree)

    def _centre(self) -> np.ndarray:
        alpha = 1 / (1 + np.exp(-self.first.opacity_logits))
        return choose_centre(self.first.means, alpha, options=self._options.uv or UvOptions())


def _range(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the range of each column [A] of values [n, A]: all but a tail, a longer one where strays are in it.

    An end is the one of `TAILS` whose codes have the least squared error, counted up to what can be seen.
    """
    reach = np.full(values.shape[1], SEEN)
    reach[SCALE] = SEEN_LOG_SCALE
    ends = np.quantile(values, [*TAILS, *(1 - tail for tail in TAILS)], axis=0)  # [2 T, A]
    lows, highs = ends[: len(TAILS)], ends[len(TAILS) :]
    beyond = [
        np.stack([np.square(np.clip(side * (end - values), 0, reach)).mean(axis=0) for end in tail])
        for side, tail in ((1, lows), (-1, highs))
    ]
    steps = np.square(highs[None] - lows[:, None]) / (255**2 * 12)  # [T, T, A]: low, high
    errors = (steps + beyond[0][:, None] + beyond[1][None]).reshape(-1, values.shape[1])
    best = np.where(errors.min(axis=0) * STRAY_GAIN < errors[0], errors.argmin(axis=0), 0)
    low, high = np.divmod(best, len(TAILS))
    columns = np.arange(values.shape[1])
    return lows[low, columns], highs[high, columns]


def _coded(
    frames: Sequence[Path], quantizer: Quantizer, options: AdoptOptions, progress: Callable[[int], None]
) -> Iterator[Codes]:
    """Second pass: the codes of every frame. A drawn Gaussian never gets opacity code 0, which means absent.

    An empty frame is one absent Gaussian.
    """
    for done, path in enumerate(frames, start=1):
        codes = _drawn_codes(quantizer, read_frame(path, sh_degree=options.sh_degree).gaussians)
        yield codes if len(codes) else Codes(np.zeros((1, 3), np.uint16), np.zeros((1, len(quantizer.low)), np.uint8))
        progress(done)


def _drawn_codes(quantizer: Quantizer, gaussians: Gaussians) -> Codes:
    codes = quantizer.encode(gaussians)
    codes.attributes[:, OPACITY] = np.maximum(codes.attributes[:, OPACITY], 1)
    return codes


class _Mapper:
    """Gives the rows of segments slots in the UV map, and counts what finds none."""

    def __init__(self, quantizer: Quantizer, options: AdoptOptions) -> None:
        self._quantizer, self._uv = quantizer, options.uv
        logits = quantizer.attribute_table[OPACITY].astype(np.float64)
        self._alpha = np.where(np.arange(256) > 0, 1 / (1 + np.exp(-logits)), 0.0)  # [256]
        self.kept = 0
        self.kept_alpha = self.alpha = 0.0

    def keep(self, segment: Segment) -> Segment:
        """The segment without the rows that the map has no texel for, seen where and as opaque as they first appear."""
        rows = np.ones(len(segment.key), bool)
        codes = first_appearance(segment)
        if self._uv is not None:
            points = self._quantizer.decode(codes).means
            opacity = codes.attributes[:, OPACITY]
            rows = assign_slots(points, opacity, self._quantizer.centre, options=self._uv).kept
        self._count(segment, rows)
        return with_rows(segment, rows)

    def _count(self, segment: Segment, rows: np.ndarray) -> None:
        """Every drawn Gaussian of every frame counts."""
        still, moving = rows[~segment.dynamic], rows[segment.dynamic]
        base = segment.key.attributes[~segment.dynamic, OPACITY]
        changing = segment.key.attributes[None, segment.dynamic, OPACITY]
        for codes, kept, times in (
            (base[None], still, len(segment)),
            (np.concatenate([changing, segment.attributes[:, :, OPACITY]]), moving, 1),
        ):
            alpha = self._alpha[codes]
            self.kept += times * int((codes[:, kept] > 0).sum())
            self.kept_alpha += times * float(alpha[:, kept].sum())
            self.alpha += times * float(alpha.sum())


def _compare(frames: Sequence[Path], out: Path, options: AdoptOptions) -> tuple[list[float], list[float]]:
    """PSNR of what pruning left, and of the finished file, over frames and views."""
    pruned: list[float] = []
    finished: list[float] = []
    if not options.compared_frames:
        return pruned, finished
    with open_scene(out) as scene:
        near = scene.header.near
        for frame in np.unique(np.linspace(0, len(frames) - 1, options.compared_frames).round().astype(int)):
            truth = read_frame(frames[frame], sh_degree=options.sh_degree).gaussians
            stored = scene.codes(int(frame))
            stored = stored[stored.attributes[:, OPACITY] > 0]
            quantizer, cameras = scene.header.quantizer, scene.header.cameras
            pruned += likeness(truth, _left_of(truth, stored, quantizer), cameras, near=near)
            finished += likeness(truth, quantizer.decode(stored), cameras, near=near)
    return pruned, finished


def _left_of(truth: Gaussians, stored: Codes, quantizer: Quantizer) -> Gaussians:
    """The Gaussians whose codes are stored, with the values that they had before."""
    return rows_of(truth, np.flatnonzero(equal_codes(_drawn_codes(quantizer, truth), stored) >= 0))
