"""LPIPS against the module that its authors publish, with random weights of the backbone."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from packuv.lpips import Lpips, lacking
from tests.support.networks import published

RNG = np.random.default_rng(3)
TRUTH = RNG.random((3, 72, 96)).astype(np.float32)
NOISY = np.clip(TRUTH + RNG.normal(0, 0.1, TRUTH.shape), 0, 1).astype(np.float32)


@pytest.fixture(scope="module", params=[("alex", "alexnet"), ("vgg", "vgg16")], ids=["alexnet", "vgg16"])
def reference(request, tmp_path_factory) -> tuple[Any, Path]:
    """LPIPS as its authors publish it, and a file of the same backbone's random weights in torchvision's form."""
    net, architecture = request.param
    torchvision = published()
    import lpips  # which imports torchvision, as it can be by now

    torch.manual_seed(1)
    backbone = getattr(torchvision.models, architecture)(weights=None)
    state = {name: value for name, value in backbone.state_dict().items() if name.startswith("features")}
    path = tmp_path_factory.mktemp("weights") / f"{architecture}.pth"
    torch.save(state, path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it calls torchvision in a way of the past
        module = lpips.LPIPS(net=net, pnet_rand=True, verbose=False)
    slices = {f"features.{name.split('.', 1)[1]}": value for name, value in module.net.named_parameters()}
    assert slices.keys() == state.keys()
    for name, value in slices.items():
        value.data.copy_(state[name])
    return module, path


def test_same_figures_as_published(reference):
    module, path = reference
    measure = Lpips(path)
    for picture in (NOISY, TRUTH[:, ::-1].copy(), np.zeros_like(TRUTH)):
        with torch.inference_mode():
            wanted = float(module(torch.from_numpy(picture)[None], torch.from_numpy(TRUTH)[None], normalize=True))
        # Float32 sums in another order.
        assert measure(picture, TRUTH) == pytest.approx(wanted, rel=1e-4)
        assert wanted > 0


def test_laws(reference):
    measure = Lpips(reference[1])
    assert measure(TRUTH, TRUTH) == 0
    assert measure(NOISY, TRUTH) == pytest.approx(measure(TRUTH, NOISY), rel=1e-5)
    assert measure(NOISY, TRUTH) > measure(0.1 * NOISY + 0.9 * TRUTH, TRUTH) > 0
    beyond = TRUTH + np.float32(0.2)
    assert measure(beyond, TRUTH) == measure(beyond.clip(0, 1), TRUTH)  # as a display would


def test_what_is_lacking_is_said(tmp_path):
    assert "evaluate.lpips_weights names no file" in lacking(None)
    assert f"there is no file {tmp_path / 'none.pth'}" in lacking(tmp_path / "none.pth")


@pytest.mark.parametrize(
    "state", [{"conv1.weight": torch.zeros(3)}, {"features.0.weight": torch.zeros(64, 3, 3, 3)}, [1]]
)
def test_another_file_is_refused(tmp_path, state):
    torch.save(state, tmp_path / "other.pth")
    with pytest.raises(ValueError, match="must be a state dict of torchvision's AlexNet or VGG-16"):
        Lpips(tmp_path / "other.pth")
