"""Decode a scene file to torch tensors: one frame by its time, then all of them in order.

    python examples/decode_to_tensors.py SCENE.mkv

Frames come as float32 arrays in the conventions of 3D Gaussian Splatting; `torch.from_numpy` shares their memory. They
are those of steady light: `packuv.gaussians.floats.lit_gaussians` with `scene.light(number)` shows them as filmed.
"""

import sys
from dataclasses import fields
from pathlib import Path

import torch

import packuv
from packuv.gaussians.floats import Gaussians


def tensors_of(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    """means [N, 3], log_scales [N, 3], quaternions [N, 4], opacity_logits [N], sh [N, bands, 3]."""
    return {field.name: torch.from_numpy(getattr(gaussians, field.name)) for field in fields(gaussians)}


def main(path: Path) -> None:
    with packuv.open_scene(path) as scene:
        header = scene.header
        middle = int(header.times_ns[len(scene) // 2])
        frame = scene.frame_at(middle)
        for name, tensor in tensors_of(scene.gaussians(frame)).items():
            print(f"frame {frame}  {name:14} {tensor.dtype}  {list(tensor.shape)}")

        centres = []
        shown = None
        for number in range(len(scene)):
            # `into` writes only what moves; clone what is to outlive the next call.
            shown = scene.gaussians(number, into=shown)
            centres.append(tensors_of(shown)["means"].mean(dim=0))
        path_length = torch.stack(centres).diff(dim=0).norm(dim=1).sum()
        print(f"{len(scene)} frames at {float(header.rate):.4g} a second; their centre moves {path_length:.3g} units")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
