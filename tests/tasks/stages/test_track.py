"""What the artefact of motion by RAFT depends on."""

from __future__ import annotations

import hashlib

import pytest
import torch

from packuv.motion import MotionBackend, MotionOptions, RaftOptions
from tasks.artefacts.recipe import digest
from tasks.artefacts.stage import Files
from tasks.artefacts.store import Key
from tasks.stages.footage import Take
from tasks.stages.track import RAFT, FindMotionByRaft
from tests.support.networks import published


def test_weights_count_by_what_they_hold(tmp_path):
    path = tmp_path / "raft.pth"
    torch.save(published().models.optical_flow.raft_small(weights=None).state_dict(), path)
    found = hashlib.sha256(path.read_bytes()).hexdigest()

    def stage(weights: str, sha256: str = found, updates: int = 12) -> FindMotionByRaft:
        return FindMotionByRaft(
            take=Take(groups=Key("sync", "0" * 64), cameras=("a",)),
            options=MotionOptions(backend=MotionBackend.RAFT),
            network=Files({RAFT: sha256}),
            raft=RaftOptions(updates=updates),
            weights=weights,
        )

    def recipe(one: FindMotionByRaft) -> str:
        return digest([one.settings, str(one.sources)])

    assert recipe(stage("here")) == recipe(stage("there"))
    assert len({recipe(one) for one in (stage(""), stage("", "0" * 64), stage("", updates=4))}) == 3
    assert stage(str(path)).raft_model().facts["sha256"] == found
    with pytest.raises(ValueError, match=r"raft\.pth changed since it was first read"):
        stage(str(path), "0" * 64).raft_model()
