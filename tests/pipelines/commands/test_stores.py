"""`packuv clean`: what it says, and when it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.cli import FAILED, OK, WRONG, main, parser
from tasks.artefacts.store import Key, Store

STAGES = ("sync", "motion", "encode", "verify", "evaluate")


@pytest.fixture
def runs(tmp_path) -> Path:
    """An output folder of two sequences, one of which is finished and holds a superseded artefact."""
    for name in ("dance", "hall"):
        store = Store(tmp_path / "runs" / name / "store")
        keys = [put(store, stage, 1) for stage in STAGES]
        if name == "dance":
            put(store, "motion", 0)
            stages = [{"stage": key.stage, "outcome": "made", "artefact": str(key)} for key in keys]
            (store.root.parent / "run.json").write_text(json.dumps({"stages": stages, "artefacts": []}))
    return tmp_path / "runs"


def put(store: Store, stage: str, version: int) -> Key:
    def build(building) -> None:
        (building.out / "data").write_bytes(bytes(100_000))

    return store.make(stage, version, None, {}, build)


def test_a_table_tells_first_what_would_go_and_then_what_went(runs, capsys):
    assert main(["clean", str(runs), "--dry-run"]) == OK
    told = capsys.readouterr().out.splitlines()
    assert told[0] == str(runs)
    assert told[1].split() == ["sequence", "superseded", "left", "over", "over", "quota", "kept"]
    assert told[2].split()[:4] == ["dance", "1,", "101", "kB"]
    assert told[3].endswith("its last run did not come to its end")
    assert told[4].startswith("  would free 101 kB, keep 1.01 MB")
    assert main(["clean", str(runs)]) == OK
    assert capsys.readouterr().out.splitlines()[4].startswith("  freed 101 kB, kept 1.01 MB")
    assert main(["clean", str(runs)]) == OK
    assert "freed 0 B" in capsys.readouterr().out


def test_a_quota_that_cannot_be_held_is_told_by_the_exit_code(runs, capsys):
    assert main(["clean", str(runs), "--quota", "950kB", "--json"]) == OK
    (folder,) = json.loads(capsys.readouterr().out)["folders"]
    assert folder["within_quota"]
    assert [item["why"] for item in folder["sequences"][0]["gone"]] == ["superseded", "over quota"]
    assert [sequence["state"] for sequence in folder["sequences"]] == ["finished", "unfinished"]
    assert main(["clean", str(runs), "--quota", "500kB"]) == FAILED
    assert "the quota is exceeded: only motion, background, seam, backdrop, key, segment of" in capsys.readouterr().out


def test_a_sequence_that_is_processed_is_named(runs, capsys):
    with Store(runs / "dance/store").in_use():
        assert main(["clean", str(runs)]) == OK
    assert "is being processed, left alone" in capsys.readouterr().out


def test_a_wrong_folder_is_found_before_anything_goes(runs, tmp_path, capsys):
    assert main(["clean", str(runs), str(tmp_path / "ruins")]) == WRONG
    assert "no folder" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["clean", str(runs), str(tmp_path / "empty")]) == WRONG
    assert "holds no artefact store" in capsys.readouterr().err
    assert len(list(Store(runs / "dance/store").keys())) == len(STAGES) + 1


@pytest.mark.parametrize(
    ("text", "count"), [("200GB", 200 * 10**9), ("1.5TB", 15 * 10**11), ("7 kB", 7000), ("12B", 12), ("3MB", 3 * 10**6)]
)
def test_sizes_have_units(text, count):
    assert parser([]).parse_args(["clean", "runs", "--quota", text]).quota == count


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--quota", "200"], "must be a size with its unit, as 200GB or 1.5TB, but is '200'"),
        (["--keep-days", "-1"], "must be a number of days, but is '-1'"),
        (["--keep-days", "week"], "must be a number of days, but is 'week'"),
    ],
)
def test_wrong_numbers_are_one_sentence(words, message, capsys):
    assert main(["clean", "runs", *words]) == WRONG
    assert message in capsys.readouterr().err


def test_verify_tells_that_inputs_are_gone(tmp_path, capsys):
    store = Store(tmp_path / "store")
    motion = put(store, "motion", 1)
    store.make("segment", 1, None, {"motion": motion}, lambda building: (building.out / "data").touch())
    assert main(["verify", "--store", str(tmp_path)]) == OK
    assert capsys.readouterr().out == "2 artefacts in 1 stores, no damaged files\n"
    assert store.withdraw(store.path(motion))
    assert main(["verify", "--store", str(tmp_path)]) == OK
    assert "1 artefacts that others were made from are gone" in capsys.readouterr().out
