"""The dashboard's tables and pictures do not pile up on the server, however many segments a run has."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import pytest

from pipelines.dashboard import LAST_PREVIEWS, Dashboard
from tasks.artefacts.store import Store
from tasks.stages.preview import FIGURES, PICTURE


class Server:
    """Takes artefacts at once; a stand-in for link and client, since a real server tells browsers what it holds."""

    def __init__(self) -> None:
        self.held: dict[Any, Any] = {}

    def post(self, post: Any, *, instead_of: object = None) -> None:
        post(self)

    def create_artifact(self, artefact: Any) -> SimpleNamespace:
        made = SimpleNamespace(id=uuid4())
        self.held[made.id] = artefact
        return made

    def update_artifact(self, identity: Any, change: Any) -> None:
        self.held[identity].data = change.data


def test_previews_of_many_segments_are_one_table_and_one_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.dashboard.get_run_logger", logging.getLogger)
    server = Server()
    dashboard = Dashboard(server, uuid4(), "dance", Store(tmp_path))  # type: ignore[arg-type]  # what it uses of a link
    (tmp_path / PICTURE).write_bytes(b"jpeg")
    for number in range(LAST_PREVIEWS + 20):
        facts = {"frames": [40 * number, 40 * number + 39], "psnr_db": {"cam05": 30.0}}
        (tmp_path / FIGURES).write_text(json.dumps(facts))
        dashboard.preview(tmp_path)
    assert {artefact.key for artefact in server.held.values()} == {"dance-psnr", "dance-preview"}
    assert len(server.held) == 2
    (table,) = (artefact for artefact in server.held.values() if artefact.key == "dance-psnr")
    rows = json.loads(table.data)
    assert [row["frames"] for row in rows[:1] + rows[-1:]] == ["800-839", "2760-2799"]
    assert len(rows) == LAST_PREVIEWS
