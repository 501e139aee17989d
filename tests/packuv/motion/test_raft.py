"""RAFT against torchvision's own, with random weights, and with trained ones where a file of them is given."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from packuv.camera import PinholeCamera
from packuv.footage import LensCamera, Views
from packuv.motion import MotionBackend, MotionOptions, Raft, measure_motion
from packuv.motion.raft import steady
from tests.support.needs import needs
from tests.support.networks import published

UPDATES = 3
SMALL, LARGE = "raft_small", "raft_large"
TRAINED = os.environ.get("PACKUV_RAFT_WEIGHTS")
"""Path of torchvision's raft_small or raft_large weights"""


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    with steady():
        yield


def textured(seed: int, height: int, width: int) -> np.ndarray:
    """uint8 [H, W]."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module", params=[SMALL, LARGE])
def reference(request, tmp_path_factory) -> tuple[Any, Path]:
    """torchvision's network with random weights, and a file of them."""
    torch.manual_seed(1)
    network = getattr(published().models.optical_flow, request.param)(weights=None).eval()
    for name, value in network.state_dict().items():
        if "running_" in name:  # which are all 0 or 1 until something is learnt
            value.copy_(0.5 + torch.rand_like(value))
    path = tmp_path_factory.mktemp("weights") / f"{request.param}.pth"
    torch.save(network.state_dict(), path)
    return network, path


@pytest.mark.parametrize("size", [(136, 168), (140, 150), (90, 131)], ids=["whole", "padded", "small"])
def test_same_flow_as_torchvision(reference, size):
    network, path = reference
    before, after = textured(1, *size), textured(2, *size)
    found = Raft(path, updates=UPDATES)(before, after)
    height, width = (max(128, -(-side // 8) * 8) for side in size)
    top, left = (height - size[0]) // 2, (width - size[1]) // 2
    edges = ((0, 0), (top, height - size[0] - top), (left, width - size[1] - left))
    both = torch.from_numpy(np.pad(np.stack([before, after]), edges, mode="edge")).float()
    pictures = both[:, None].repeat(1, 3, 1, 1) / 127.5 - 1
    with torch.inference_mode():
        wanted = network(pictures[:1], pictures[1:], num_flow_updates=UPDATES)[-1][0].numpy().transpose(1, 2, 0)
    wanted = wanted[top : top + size[0], left : left + size[1]]
    assert found.shape == (*size, 2)
    assert found.dtype == np.float32
    # Float32 sums in another order; measured 4e-6 of the largest flow.
    assert np.abs(found - wanted).max() < 1e-4 * np.abs(wanted).max()
    assert np.abs(wanted).max() > 0.1


def test_same_bytes_each_time_and_another_flow_for_more_updates(reference):
    before, after = textured(1, 128, 128), textured(2, 128, 128)
    first, again = (Raft(reference[1], updates=2)(before, after) for _ in range(2))
    more = Raft(reference[1], updates=3)(before, after)
    assert np.array_equal(first, again)
    assert not np.allclose(first, more, atol=1e-3)


def still_views(folder: Path) -> Views:
    """One camera of three numbered pictures."""
    pictures = folder / "a"
    pictures.mkdir()
    for number in range(3):
        assert cv2.imwrite(str(pictures / f"{number:04d}.png"), np.roll(textured(1, 128, 160), 2 * number, axis=1))
    lens = LensCamera(PinholeCamera("a", 160, 128, 200, 200, 80, 64, np.eye(4)))
    return Views({"a": pictures}, np.arange(3)[:, None], [lens])


def test_the_cache_holds_its_flow_and_knows_whose_it_is(reference, tmp_path):
    raft, views = Raft(reference[1], updates=2), still_views(tmp_path)
    options = MotionOptions(backend=MotionBackend.RAFT)
    cache = measure_motion(views, tmp_path / "motion", options, raft=raft)
    pictures = [cv2.cvtColor(views.steady(0, t), cv2.COLOR_RGB2GRAY) for t in range(2)]
    wanted = raft(*pictures).astype(np.float16).astype(np.float32)
    assert np.array_equal(cache.optical_flow(0, 1), wanted)
    with pytest.raises(ValueError, match="other raft; delete it first"):
        measure_motion(views, tmp_path / "motion", options, raft=Raft(reference[1], updates=3))
    with pytest.raises(ValueError, match="if and only if the backend is raft"):
        measure_motion(views, tmp_path / "other", options)
    with pytest.raises(ValueError, match="if and only if the backend is raft"):
        measure_motion(views, tmp_path / "other", MotionOptions(), raft=raft)


def state_of(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)


def test_another_file_is_refused(reference, tmp_path):
    path = tmp_path / "other.pth"
    with pytest.raises(FileNotFoundError, match=f"there is no file {path}"):
        Raft(path)
    path.write_bytes(b"no weights")
    with pytest.raises(ValueError, match=r"must be a state dict of torchvision's raft_large or raft_small"):
        Raft(path)
    torch.save({"module.fnet.conv1.weight": torch.zeros(64, 3, 7, 7)}, path)
    with pytest.raises(ValueError, match="but holds something else"):
        Raft(path)
    state = state_of(reference[1])
    torch.save({name: value for name, value in state.items() if "flow_head.conv2" not in name}, path)
    with pytest.raises(ValueError, match=r"lacks layers.*flow_head\.conv2"):
        Raft(path)
    state["update_block.flow_head.conv2.bias"][:] = torch.nan
    torch.save(state, path)
    with pytest.raises(ValueError, match="not finite"):
        Raft(path)


@needs("weights", TRAINED, "PACKUV_RAFT_WEIGHTS names no file of torchvision's RAFT weights")
def test_trained_weights_follow_a_shift():
    before = textured(3, 240, 320)
    flow = Raft(Path(str(TRAINED)))(before, np.roll(before, (3, 7), axis=(0, 1)))
    assert np.linalg.norm(np.median(flow[40:-40, 40:-40], axis=(0, 1)) - [7, 3]) < 0.3
