"""`packuv clean`: what goes from stores, told as a table."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pipelines.commands.terminal import print_facts
from pipelines.disk import size_text
from tasks.artefacts.retention import REMAKEABLE, Cleaned, Cleaning, Item, Policy, State, Why, clean_folder
from tasks.artefacts.store import find_stores

REASONS = (Why.SUPERSEDED, Why.LEFT_OVER, Why.REMAKEABLE)


def clean(arguments: argparse.Namespace) -> int:
    """Exit code 1 if a folder holds more than the quota all the same."""
    for folder in arguments.folders:
        find_stores(folder)  # a name that is wrong is found before anything goes
    policy = Policy(arguments.keep_days, arguments.quota)
    done = [clean_folder(folder, policy, dry_run=arguments.dry_run) for folder in arguments.folders]
    facts = {"dry_run": arguments.dry_run, "folders": [_facts(item, policy.quota_bytes) for item in done]}
    print_facts(facts, arguments.json, _text)
    return 0 if all(folder["within_quota"] for folder in facts["folders"]) else 1


def _facts(cleaning: Cleaning, quota_bytes: int | None) -> dict[str, Any]:
    return {
        "folder": str(cleaning.folder),
        "freed_bytes": cleaning.freed_bytes,
        "kept_bytes": cleaning.kept_bytes,
        "quota_bytes": quota_bytes,
        "within_quota": quota_bytes is None or cleaning.kept_bytes <= quota_bytes,
        "sequences": [_sequence_facts(sequence) for sequence in cleaning.sequences],
        "engine": _gone_facts(cleaning.engine),
    }


def _sequence_facts(sequence: Cleaned) -> dict[str, Any]:
    return {
        "sequence": sequence.folder.resolve().name,
        "state": str(sequence.state),
        "kept_bytes": sequence.kept_bytes,
        "gone": _gone_facts(sequence.gone),
    }


def _gone_facts(items: Sequence[Item]) -> list[dict[str, Any]]:
    return [{"name": item.name, "why": str(item.why), "bytes": item.bytes} for item in items]


def _text(facts: Mapping[str, Any]) -> str:
    return "\n".join(line for folder in facts["folders"] for line in _lines(folder, facts["dry_run"]))


def _lines(folder: Mapping[str, Any], dry_run: bool) -> Iterator[str]:
    width = max(len("sequence"), *(len(sequence["sequence"]) for sequence in folder["sequences"]))
    yield f"{folder['folder']}"
    yield f"  {'sequence':<{width}}" + "".join(f"{reason:>20}" for reason in REASONS) + f"{'kept':>12}"
    for sequence in folder["sequences"]:
        cells = "".join(f"{_cell(sequence['gone'], reason):>20}" for reason in REASONS)
        note = {
            State.BUSY: "  is being processed, left alone",
            State.UNFINISHED: "  its last run did not come to its end",
        }
        yield f"  {sequence['sequence']:<{width}}{cells}{size_text(sequence['kept_bytes']):>12}" + note.get(
            sequence["state"], ""
        )
    if folder["engine"]:
        yield f"  databases of the workflow engine: {_cell(folder['engine'], Why.ENGINE)}"
    freed, kept = size_text(folder["freed_bytes"]), size_text(folder["kept_bytes"])
    quota = f" of {size_text(folder['quota_bytes'])}" if folder["quota_bytes"] is not None else ""
    yield f"  {f'would free {freed}, keep' if dry_run else f'freed {freed}, kept'} {kept}{quota}"
    if not folder["within_quota"]:
        yield (
            f"  the quota is exceeded: only {', '.join(REMAKEABLE)} of finished sequences go for it, results never; "
            "move whole sequences elsewhere"
        )


def _cell(gone: Sequence[Mapping[str, Any]], reason: Why) -> str:
    sizes = [item["bytes"] for item in gone if item["why"] == reason]
    return f"{len(sizes)}, {size_text(sum(sizes))}" if sizes else "-"
