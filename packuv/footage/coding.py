"""How a video codes colour, as its stream says and as we take what it does not say."""

from __future__ import annotations

from dataclasses import dataclass

import av

from packuv.footage.transfer import BT709, BT2020, CAMERA_PRIMARIES, P3, Primaries, Transfer

UNSAID = frozenset({0, 2, 3})
"""Codes of ITU-T H.273 that say nothing; a matrix of 0, RGB, says nothing about planes of luma and chroma"""
WEIGHTS: dict[int, tuple[float, float]] = {
    1: (0.2126, 0.0722),
    4: (0.30, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
}
"""Shares of red and blue in luma by matrix of H.273: BT.709, FCC, BT.601 twice, SMPTE 240M, BT.2020"""
_TRANSFERS = {16: Transfer.PQ, 18: Transfer.HLG}
_PRIMARIES = {1: BT709, 9: BT2020, 12: P3}
_MATRIX_BT709, _MATRIX_BT601, _FULL, _LIMITED = 1, 5, 2, 1


@dataclass(frozen=True)
class Coding:
    """Tags of a video stream, in the codes of ITU-T H.273."""

    format: str
    """FFmpeg's name of the pixel format: yuv422p10le"""
    bits: int
    """Per channel"""
    matrix: int
    transfer: int
    primaries: int
    range: int
    """1: limited, 2: full, 0: not said"""
    width: int
    height: int

    @classmethod
    def of(cls, stream: av.VideoStream) -> Coding:
        """What a stream says; raises ValueError for one whose pixel format FFmpeg cannot tell."""
        context = stream.codec_context
        if context.format is None:
            raise ValueError("FFmpeg cannot tell its pixel format")
        return cls(
            format=context.format.name,
            bits=max(component.bits for component in context.format.components),
            matrix=int(context.colorspace),
            transfer=int(context.color_trc),
            primaries=int(context.color_primaries),
            range=int(context.color_range),
            width=stream.width,
            height=stream.height,
        )

    @classmethod
    def of_frame(cls, frame: av.VideoFrame) -> Coding:
        """What a decoded picture says."""
        return cls(
            format=frame.format.name,
            bits=max(component.bits for component in frame.format.components),
            matrix=int(frame.colorspace),
            transfer=int(frame.color_trc),
            primaries=int(frame.color_primaries),
            range=int(frame.color_range),
            width=frame.width,
            height=frame.height,
        )

    @property
    def floating(self) -> bool:
        """Whether it holds light as floating-point numbers, as EXR does."""
        return "f32" in self.format or "f16" in self.format

    @property
    def in_luma(self) -> bool:
        """Whether the picture is coded as luma and chroma."""
        return self.format.startswith(
            ("yuv", "nv", "p0", "p2", "p4", "y2", "uyvy", "uyyvyy", "yuyv", "yvyu", "ayuv", "xv", "vuy")
        )

    @property
    def full(self) -> bool:
        """Whether black is 0; without a word from the stream only RGB, gray and JPEG are taken for that."""
        return self.range == _FULL or (self.range != _LIMITED and not self.in_luma) or self.format.startswith("yuvj")

    @property
    def weights(self) -> tuple[float, float]:
        """Shares of red and blue in luma.

        Untagged pictures are taken as players take them: BT.709 from high definition on, BT.601 below. Raises
        ValueError for a matrix that is none, such as ICtCp.
        """
        if self.matrix in UNSAID:
            return WEIGHTS[_MATRIX_BT709 if self.high_definition else _MATRIX_BT601]
        if self.matrix not in WEIGHTS:
            raise ValueError(
                f"its colours are coded by matrix {self.matrix} of ITU-T H.273; those that are read are "
                f"{sorted(WEIGHTS)}: encode it again, for instance with ffmpeg -vf zscale=matrix=709"
            )
        return WEIGHTS[self.matrix]

    @property
    def high_definition(self) -> bool:
        return self.width >= 1280 or self.height > 576

    @property
    def coarse(self) -> bool:
        """Whether chroma is interpolated by a general scaler, whose results differ from one version to the next.

        Measured on 751 videos that are `plain`: PyAV's FFmpeg 8.0 and torchcodec on FFmpeg 5.1 make the same bytes of
        all others, of 19 formats and 7 matrices, and 1.1 to 2.2 codes apart of these.
        """
        return self.format.startswith(("yuv410", "yuv411", "yuv440"))

    def curve(self, said: Transfer | None) -> Transfer:
        """What code values mean: what was `said`, else the tag for HLG and PQ, else a finished picture."""
        return said or _TRANSFERS.get(self.transfer, Transfer.SDR)

    def gamut(self, curve: Transfer) -> Primaries:
        """Primaries of the light; untagged ones are those that come with the curve."""
        if curve in CAMERA_PRIMARIES:
            return CAMERA_PRIMARIES[curve]
        return _PRIMARIES.get(self.primaries, BT709 if curve is Transfer.SDR else BT2020)

    def plain(self, said: Transfer | None) -> bool:
        """Whether FFmpeg shows this as it is meant: 8 bits, finished, its matrix named, its range what it assumes.

        Measured with torchcodec and FFmpeg 5.1: it reads untagged pictures as BT.601 whatever their size, passes over a
        full range unless the format is called yuvj, and is up to 4 of 255 codes off for subsampled chroma of 10 bits.
        """
        curve = self.curve(said)
        if self.bits > 8 or curve is not Transfer.SDR or self.gamut(curve) != BT709:
            return False
        if not self.in_luma:
            return True
        named = self.matrix in WEIGHTS or (self.matrix in UNSAID and not self.high_definition)
        return named and (not self.full or self.format.startswith("yuvj"))
