"""The package `torchvision`, against whose networks ours are held."""

from __future__ import annotations

from typing import Any

import torch


def published() -> Any:
    """torchvision; also where it was built for another torch, for its networks need no compiled operators."""
    try:
        import torchvision
    except RuntimeError:  # they do not load, and it only asks for their names
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float threshold) -> Tensor")
        import torchvision
    return torchvision
