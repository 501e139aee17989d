"""What a user asks for. Light to import: the command line reads it before anything heavy."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tasks.artefacts.recipe import OptionError

PRESETS = ("draft", "standard", "high")
QUALITIES = ("lossless", "high", "medium", "low")
"""How near the scene file stays to the fit, see `packuv.scene.encoder.TOLERANCES`"""
STAGES = ("sync", "calibrate", "flow", "fit", "encode", "verify", "evaluate", "report")
"""In the order in which a run does them"""


@dataclass(frozen=True)
class RunRequest:
    """One sequence to process. All values are plain, so that a scheduler can hold and show them."""

    capture: str
    """Capture folder"""
    out: str
    """Results go to <out>/<name of the sequence>/"""
    preset: str = "standard"
    quality: str = "lossless"
    """Of the scene file; the fit does not depend on it"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Nested: stage -> option -> value; wins over the preset"""
    frames: tuple[int, int | None] = (0, None)
    """Half-open range of instants"""
    hold_out: tuple[str, ...] | None = None
    """Cameras never to fit; None: those that capture.toml names"""
    stop_after: str = "report"
    device: str = "auto"
    seed: int = 0
    jobs: int | None = None
    """Fits at once; None: from the number of cores"""

    def __post_init__(self) -> None:
        choices_of = {
            "preset": PRESETS,
            "quality": QUALITIES,
            "stop_after": STAGES,
            "device": ("auto", "cpu", "cuda"),
        }
        for name, choices in choices_of.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, but is {getattr(self, name)!r}")


def read_settings(config: Path | None, pairs: Sequence[str]) -> dict[str, Any]:
    """Settings of a TOML file, then those of the command line, "fit.iterations=500"; later ones win.

    Raises FileNotFoundError without the file, ValueError for a file that is no TOML or a pair without '='.
    """
    settings: dict[str, Any] = {}
    if config is not None:
        settings = _read_toml(config)
    for pair in pairs:
        path, equals, value = pair.partition("=")
        if not equals or not path.strip():
            raise OptionError(f"--set needs NAME=VALUE, as fit.iterations=500, but got {pair!r}")
        _put(settings, path.strip().split("."), value.strip())
    return settings


def _read_toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; --config needs a TOML file")
    try:
        return tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{path} is no valid TOML: {error}") from None


def _put(tree: dict[str, Any], names: Sequence[str], value: str) -> None:
    for name in names[:-1]:
        inner = tree.setdefault(name, {})
        if not isinstance(inner, dict):
            raise OptionError(f"{'.'.join(names)}: {name} is set to a value elsewhere, but is a table here")
        tree = inner
    tree[names[-1]] = value
