"""LPIPS (Zhang et al. 2018), version 0.1: how far two pictures lie apart in the features of a network that sees.

The backbone is torchvision's AlexNet or VGG-16, whose trained weights a user brings as a file, since nothing here
downloads; the weights by which features count come with the package `lpips`, of which no code is run: it imports
torchvision, and that only works with the one build of torch that it was made for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from packuv.threads import one_torch_thread

if TYPE_CHECKING:
    from torch import Tensor

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of r g b in [-1, 1], before the first layer"""
SMALLEST = 1e-10
"""Added to a feature's length before it divides"""
INSTALL = "pip install 'packuv[lpips]'"


@dataclass(frozen=True)
class Network:
    """Convolutions with a ReLU each; max pooling between some."""

    heads: str
    """File of the package `lpips` with the weights of its features"""
    first: tuple[int, int, int, int]
    """Shape of the first convolution's weights, by which a state dict is known"""
    convolutions: Sequence[tuple[int, int, int]]
    """Number in the state dict, stride, padding"""
    pool: tuple[int, int]
    """Side and stride of pooling"""
    pooled: frozenset[int]
    """Convolutions with pooling before them"""
    features: frozenset[int]
    """Convolutions after whose ReLU features are taken"""


NETWORKS = (
    Network(
        "alex.pth",
        (64, 3, 11, 11),
        ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)),
        (3, 2),
        frozenset({3, 6}),
        frozenset({0, 3, 6, 8, 10}),
    ),
    Network(
        "vgg.pth",
        (64, 3, 3, 3),
        tuple((number, 1, 1) for number in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)),
        (2, 2),
        frozenset({5, 10, 17, 24}),
        frozenset({2, 7, 14, 21, 28}),
    ),
)


def lacking(weights: Path | None) -> str:
    """Why LPIPS cannot be measured with this file of backbone weights; empty where it can."""
    if weights is None:
        return "evaluate.lpips_weights names no file of torchvision's AlexNet or VGG-16 weights"
    if not weights.is_file():
        return f"evaluate.lpips_weights: there is no file {weights}"
    return "" if _heads_folder() else f"the package lpips is not installed: {INSTALL}"


class Lpips:
    """Measures LPIPS of pictures, on the CPU."""

    def __init__(self, weights: Path) -> None:
        """`weights` is a state dict of torchvision's AlexNet or VGG-16 with its trained values.

        Raises ValueError for a file that holds something else.
        """
        import torch  # takes a second, which only those who measure should wait

        folder = _heads_folder()
        if folder is None:
            raise ValueError(f"the package lpips is not installed: {INSTALL}")
        state = torch.load(weights, map_location="cpu", weights_only=True)
        self._network = _known(state, weights)
        heads = torch.load(folder / self._network.heads, map_location="cpu", weights_only=True)
        self._heads: list[Tensor] = list(heads.values())  # [1, channels, 1, 1] each
        self._layers = [
            (number, state[f"features.{number}.weight"].float(), state[f"features.{number}.bias"].float(), stride, pad)
            for number, stride, pad in self._network.convolutions
        ]

    def __call__(self, picture: np.ndarray, truth: np.ndarray) -> float:
        """LPIPS of two pictures, float32 [3, H, W] in [0, 1], sRGB; 0 where they are equal."""
        import torch

        with one_torch_thread(), torch.inference_mode():
            both = torch.from_numpy(np.stack([picture, truth]).clip(0, 1)).float()  # [2, 3, H, W]
            total = torch.zeros(())
            for head, features in zip(self._heads, self._features(both), strict=True):
                unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + SMALLEST)
                total += torch.nn.functional.conv2d((unit[:1] - unit[1:]).square(), head).mean()
            return float(total)

    def _features(self, pictures: Tensor) -> list[Tensor]:
        """Of pictures [N, 3, H, W] in [0, 1]: [N, channels, h, w] each."""
        import torch
        from torch.nn import functional

        found = []
        values = (2 * pictures - 1 - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
        for number, weight, bias, stride, padding in self._layers:
            if number in self._network.pooled:
                values = functional.max_pool2d(values, *self._network.pool)
            values = functional.conv2d(values, weight, bias, stride=stride, padding=padding).relu_()
            if number in self._network.features:
                found.append(values)
        return found


def _known(state: object, path: Path) -> Network:
    first = state.get("features.0.weight") if isinstance(state, Mapping) else None
    if isinstance(state, Mapping) and first is not None:
        for network in NETWORKS:
            numbers = [number for number, _, _ in network.convolutions]
            names = {f"features.{number}.{part}" for number in numbers for part in ("weight", "bias")}
            if tuple(first.shape) == network.first and names <= state.keys():
                return network
    raise ValueError(f"{path} must be a state dict of torchvision's AlexNet or VGG-16 (features.0.weight, ...)")


def _heads_folder() -> Path | None:
    """Where the package `lpips` keeps the weights of features; None where it is not installed."""
    spec = find_spec("lpips")
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(spec.submodule_search_locations[0]) / "weights" / "v0.1"
    return folder if folder.is_dir() else None
