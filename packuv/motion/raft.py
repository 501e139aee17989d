"""RAFT (Teed and Deng 2020): optical flow by a network that compares every part of a picture with all of the other.

Weights are those of torchvision's raft_large or raft_small, which a user brings as a file, since nothing here
downloads. The network is written here, because torchvision can only be imported beside the one build of torch that it
was made for; tests/packuv/motion/test_raft.py holds it against torchvision's own. Which of the two it is, and how wide
each layer, the weights tell.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from packuv.threads import one_torch_thread

if TYPE_CHECKING:
    from torch import Tensor

STRIDE = 8
"""Pixels of a picture by those of its features"""
LEVELS = 4
"""Of the pyramid of correlations, each of half the size"""
LEAST_PX = 128
"""Smaller sides leave the last level a single value, between which nothing can be interpolated"""
LAYERS = (("layer1", 1), ("layer2", 2), ("layer3", 2))
"""Of an encoder after its first convolution: two blocks each, the first with this stride"""
NORMED_BY_INSTANCE = "feature_encoder"
"""The encoder whose norms have no weights"""
SMALLEST = 1e-5
"""Added to a variance before it divides"""
FIRST = "feature_encoder.convnormrelu.0.weight"
FIRST_SHAPES = ((64, 3, 7, 7), (32, 3, 7, 7))
"""Of raft_large and raft_small"""
HIDDEN = "update_block.recurrent_block.convgru1.convz.weight"
LOOKED_UP = "update_block.motion_encoder.convcorr1.0.weight"
WANTED = "a state dict of torchvision's raft_large or raft_small"


@dataclass(frozen=True)
class RaftOptions:
    """How RAFT estimates optical flow, where `motion.backend` is raft."""

    weights: str | None = None
    """File of torchvision's raft_large or raft_small weights, a state dict; nothing is downloaded"""
    updates: int = 12
    """Rounds in which a flow is mended; torchvision trains and scores with 12. The time grows with them"""
    device: str = "cpu"
    """cpu or cuda; a run sets it to its own"""

    def __post_init__(self) -> None:
        if self.updates < 1:
            raise ValueError(f"RAFT needs at least one update, but updates is {self.updates}")


@contextmanager
def steady() -> Iterator[None]:
    """While threads of ours estimate side by side: the same figures each time, on the CPU and on CUDA."""
    import torch  # takes a second, which only those who estimate by a network should wait

    cudnn: Any = torch.backends.cudnn
    with one_torch_thread(), cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
        yield


class Raft:
    """Estimates optical flow. Safe to use from several threads."""

    def __init__(self, weights: Path, *, updates: int = RaftOptions.updates, device: str = RaftOptions.device) -> None:
        """Raises FileNotFoundError for a missing file, ValueError for one that holds something else."""

        self._path, self._updates, self._device = weights, updates, "cpu"
        self._state = _read(weights)
        self._hidden, self._radius = self._sizes()
        self._try()
        self._device = device
        self._state = {name: value.to(device) for name, value in self._state.items()}

    @cached_property
    def facts(self) -> Mapping[str, Any]:
        """What an estimate depends on beside the pictures, plain values."""
        digest = hashlib.sha256(self._path.read_bytes()).hexdigest()
        return {"sha256": digest, "updates": self._updates, "device": self._device}

    def __call__(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Optical flow between two grey pictures, uint8 [H, W] each: float32 [H, W, 2], x and y, pixels.

        They are padded by their borders to multiples of 8 px, and to 128 px where they are smaller. The correlations
        take 4/3 (H W / 64)^2 float32: 68 MB at 640x360, 5.6 GB at 1920x1080.
        """
        import torch

        height, width = before.shape
        top, bottom = _padding(height)
        left, right = _padding(width)
        both = np.pad(np.stack([before, after]), ((0, 0), (top, bottom), (left, right)), mode="edge")
        with torch.inference_mode():
            # Trained on colours in [-1, 1]; of which grey is one.
            values = torch.from_numpy(both).to(self._device, torch.float32)[:, None].expand(-1, 3, -1, -1)
            flow = self._estimate(values / 127.5 - 1)[0]  # [2, H', W']
            inner = flow[:, top : top + height, left : left + width].permute(1, 2, 0)
            found: np.ndarray = inner.contiguous().cpu().numpy()
        return found

    def _sizes(self) -> tuple[int, int]:
        """Channels of the hidden state, and cells around a place whose correlations are looked up."""
        hidden = len(self._state[HIDDEN])
        looked_up = self._state[LOOKED_UP].shape[1]
        return hidden, round(((looked_up / LEVELS) ** 0.5 - 1) / 2)

    def _try(self) -> None:
        blank = np.zeros((LEAST_PX, LEAST_PX), np.uint8)
        try:
            with steady():
                flow = self(blank, blank)
        except (KeyError, RuntimeError) as error:
            reason = f"lacks layers, or has some of another shape ({error})"
            raise ValueError(f"{self._path} must be {WANTED}, but {reason}") from error
        if not np.isfinite(flow).all():
            raise ValueError(f"{self._path} holds weights that are not finite; copy the file again")

    def _estimate(self, pictures: Tensor) -> Tensor:
        """Of two pictures [2, 3, H, W] in [-1, 1]: [1, 2, H, W], pixels."""
        import torch

        features = self._encoded(pictures, "feature_encoder")  # [2, C, h, w]
        hidden, context = self._encoded(pictures[:1], "context_encoder").tensor_split([self._hidden], dim=1)
        hidden, context = hidden.tanh(), context.relu()
        height, width = features.shape[2:]
        pyramid = _pyramid(features)
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        start = torch.stack([x, y]).to(self._device, torch.float32)[None]  # [1, 2, h, w]
        flow = torch.zeros_like(start)
        for _ in range(self._updates):
            seen = self._seen(_looked_up(pyramid, start + flow, self._radius), flow)
            hidden = self._carried(hidden, torch.cat([context, seen], dim=1))
            raised = self._conv(hidden, "update_block.flow_head.conv1").relu()
            flow = flow + self._conv(raised, "update_block.flow_head.conv2")
        return self._enlarged(flow, hidden)

    def _encoded(self, pictures: Tensor, encoder: str) -> Tensor:
        """Features [N, C, H / 8, W / 8] of pictures [N, 3, H, W]."""
        values = self._normed(pictures, f"{encoder}.convnormrelu", stride=2).relu()
        for layer, stride in LAYERS:
            values = self._block(values, f"{encoder}.{layer}.0", stride)
            values = self._block(values, f"{encoder}.{layer}.1", 1)
        return self._conv(values, f"{encoder}.conv")

    def _block(self, values: Tensor, name: str, stride: int) -> Tensor:
        """Two convolutions, of which the first strides, or three, of which the second does, beside a shortcut."""
        convolutions = 3 if f"{name}.convnormrelu3.0.weight" in self._state else 2
        new = values
        for number in range(1, convolutions + 1):
            here = stride if number == convolutions - 1 else 1
            new = self._normed(new, f"{name}.convnormrelu{number}", stride=here).relu()
        if f"{name}.downsample.0.weight" in self._state:
            values = self._normed(values, f"{name}.downsample", stride=stride)
        return (values + new).relu()

    def _normed(self, values: Tensor, name: str, *, stride: int) -> Tensor:
        """A convolution and what norm follows it."""
        from torch.nn import functional

        values = self._conv(values, f"{name}.0", stride=stride)
        if name.startswith(NORMED_BY_INSTANCE):
            return functional.instance_norm(values, eps=SMALLEST)
        if f"{name}.1.running_mean" not in self._state:
            return values
        mean, variance, weight, bias = (
            self._state[f"{name}.1.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return functional.batch_norm(values, mean, variance, weight, bias, eps=SMALLEST)

    def _seen(self, correlations: Tensor, flow: Tensor) -> Tensor:
        """What correlations and flow tell, with the flow itself at the end: [1, C, h, w]."""
        import torch

        encoder = "update_block.motion_encoder"
        told = self._conv(correlations, f"{encoder}.convcorr1.0").relu()
        if f"{encoder}.convcorr2.0.weight" in self._state:
            told = self._conv(told, f"{encoder}.convcorr2.0").relu()
        moved = self._conv(flow, f"{encoder}.convflow1.0").relu()
        moved = self._conv(moved, f"{encoder}.convflow2.0").relu()
        both = self._conv(torch.cat([told, moved], dim=1), f"{encoder}.conv.0").relu()
        return torch.cat([both, flow], dim=1)

    def _carried(self, hidden: Tensor, told: Tensor) -> Tensor:
        """The hidden state after one gated recurrent unit, or two: along rows, then along columns."""
        import torch

        for unit in ("convgru1", "convgru2"):
            name = f"update_block.recurrent_block.{unit}"
            if f"{name}.convz.weight" not in self._state:
                break
            both = torch.cat([hidden, told], dim=1)
            update, reset = (self._conv(both, f"{name}.{gate}").sigmoid() for gate in ("convz", "convr"))
            new = self._conv(torch.cat([reset * hidden, told], dim=1), f"{name}.convq").tanh()
            hidden = (1 - update) * hidden + update * new
        return hidden

    def _enlarged(self, flow: Tensor, hidden: Tensor) -> Tensor:
        """Flow [1, 2, H, W], pixels, from that of features [1, 2, h, w]; each a mean of the nine around it, whose
        weights raft_large learns."""
        from torch.nn import functional

        flow = STRIDE * flow
        if "mask_predictor.conv.weight" not in self._state:
            return functional.interpolate(flow, scale_factor=STRIDE, mode="bilinear", align_corners=True)
        height, width = flow.shape[2:]
        weights = self._conv(self._conv(hidden, "mask_predictor.convrelu.0").relu(), "mask_predictor.conv") / 4
        weights = weights.view(1, 9, STRIDE, STRIDE, height, width).softmax(dim=1)
        around = functional.unfold(flow, kernel_size=3, padding=1).view(2, 9, 1, 1, height, width)
        mixed = (weights * around).sum(dim=1)  # [2, 8, 8, h, w]
        return mixed.permute(0, 3, 1, 4, 2).reshape(1, 2, STRIDE * height, STRIDE * width)

    def _conv(self, values: Tensor, name: str, *, stride: int = 1) -> Tensor:
        """A convolution that keeps the size, but for its stride."""
        from torch.nn import functional

        weight, bias = self._state[f"{name}.weight"], self._state[f"{name}.bias"]
        padding = (weight.shape[2] // 2, weight.shape[3] // 2)
        return functional.conv2d(values, weight, bias, stride=stride, padding=padding)


def _read(path: Path) -> Mapping[str, Tensor]:
    import torch

    if not path.is_file():
        raise FileNotFoundError(f"raft.weights: there is no file {path}; give {WANTED}")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path} must be {WANTED}, but is no file of weights ({reason})") from error
    shapes = {name: tuple(value.shape) for name, value in state.items()} if _is_state(state) else {}
    if shapes.get(FIRST) not in FIRST_SHAPES or not {HIDDEN, LOOKED_UP} <= shapes.keys():
        raise ValueError(f"{path} must be {WANTED} ({FIRST}, ...), but holds something else")
    return {name: value.to(torch.float32) for name, value in state.items() if value.is_floating_point()}


def _is_state(found: object) -> bool:
    import torch

    return isinstance(found, Mapping) and all(isinstance(value, torch.Tensor) for value in found.values())


def _padding(length: int) -> tuple[int, int]:
    """Pixels before and after, half each."""
    missing = max(LEAST_PX, -(-length // STRIDE) * STRIDE) - length
    return missing // 2, missing - missing // 2


def _pyramid(features: Tensor) -> list[Tensor]:
    """Correlation of each place in the first picture with all of the second, [h w, 1, h, w], and with ever larger
    parts of it."""
    from torch.nn import functional

    channels, height, width = features.shape[1:]
    first, second = features.reshape(2, channels, height * width)
    levels = [(first.T @ second / channels**0.5).view(height * width, 1, height, width)]
    for _ in range(LEVELS - 1):
        levels.append(functional.avg_pool2d(levels[-1], 2))
    return levels


def _looked_up(pyramid: list[Tensor], places: Tensor, radius: int) -> Tensor:
    """Correlations within `radius` cells of a place on each level, [1, C, h, w]; places are [1, 2, h, w], x and y."""
    import torch
    from torch.nn import functional

    height, width = places.shape[2:]
    reach = torch.arange(-radius, radius + 1, dtype=torch.float32, device=places.device)
    # Trained with x and y of the window swapped, which is part of the weights.
    window = torch.stack(torch.meshgrid(reach, reach, indexing="ij"), dim=-1)
    centres = places[0].permute(1, 2, 0).reshape(height * width, 1, 1, 2)
    found = []
    for level in pyramid:
        last = torch.tensor([level.shape[3] - 1, level.shape[2] - 1], device=places.device)
        grid = 2 * (centres + window) / last - 1
        sampled = functional.grid_sample(level, grid, mode="bilinear", align_corners=True)
        found.append(sampled.view(height, width, -1))
        centres = centres / 2
    return torch.cat(found, dim=2).permute(2, 0, 1)[None].contiguous()
