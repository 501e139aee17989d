"""A room with sounds that several cameras record."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from sync.content.sound import RATE

SECONDS = 20


def room(seed: int = 0) -> np.ndarray:
    """Bursts of noise of any loudness and length, float [n] at RATE, and silence between them."""
    rng = np.random.default_rng(seed)
    sound = np.zeros((SECONDS + 12) * RATE)
    for start in rng.uniform(0, SECONDS + 11, 90):
        length = int(rng.uniform(0.02, 0.3) * RATE)
        first = int(start * RATE)
        sound[first : first + length] += rng.normal(0, rng.uniform(0.05, 0.5), length)
    return sound


def recorded(sound: np.ndarray, start_s: float, seed: int, noise: float = 0.02) -> np.ndarray:
    first = round(start_s * RATE)
    own = sound[first : first + SECONDS * RATE]
    return own * np.random.default_rng(seed).uniform(0.2, 2) + np.random.default_rng(seed).normal(0, noise, len(own))


def write_video(path: Path, *tracks: np.ndarray | None, rate: int = RATE) -> None:
    """A grey video of two seconds at 10 frames a second, with sound, float [n] or [channels, n] a track."""
    with av.open(str(path), "w") as container:
        picture = container.add_stream("ffv1", rate=10)
        picture.width, picture.height, picture.pix_fmt = 32, 32, "bgr0"
        sounds = [np.atleast_2d(samples) for samples in tracks if samples is not None]
        layouts = ["mono" if len(sound) == 1 else "stereo" for sound in sounds]
        voices = [container.add_stream("pcm_f32le", rate=rate, layout=layout) for layout in layouts]
        for _ in range(20):
            grey = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 90, np.uint8), format="rgb24")
            container.mux(picture.encode(grey))
        container.mux(picture.encode())
        for sound, voice, layout in zip(sounds, voices, layouts, strict=True):
            whole = np.ascontiguousarray(sound.T, np.float32).reshape(1, -1)
            for start in range(0, sound.shape[1], 1000):
                samples = whole[:, start * len(sound) : (start + 1000) * len(sound)]
                part = av.AudioFrame.from_ndarray(samples, format="flt", layout=layout)
                part.rate, part.pts = rate, start
                container.mux(voice.encode(part))
            container.mux(voice.encode())
