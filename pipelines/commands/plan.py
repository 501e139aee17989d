"""`packuv plan`: what a run or a batch would do, and what it takes, before anything is done."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from pipelines.commands.output import answer
from pipelines.commands.run import asked_for
from pipelines.commands.terminal import print_table, shown
from pipelines.dataset import holds_capture
from pipelines.disk import free_bytes, size_text
from pipelines.request import RunRequest
from pipelines.words import counted

if TYPE_CHECKING:
    from pipelines.ahead import Ahead
    from pipelines.batch.ahead import Whole
    from pipelines.batch.plan import Step


def command(arguments: argparse.Namespace) -> int:
    """Raises OSError where the disk cannot hold what would be written, after all has been told."""
    return _one(arguments) if holds_capture(arguments.source) else _many(arguments)


def _one(arguments: argparse.Namespace) -> int:
    from pipelines.ahead import look_ahead  # takes seconds, which a misspelt option need not wait for

    if arguments.names or arguments.tags or arguments.at_once:
        raise ValueError("--names, --tags and --at-once choose among sequences, but this is one capture")
    request = RunRequest(
        capture=os.path.abspath(arguments.source),
        out=os.path.abspath(arguments.out),
        hold_out=arguments.hold_out,
        stop_after=arguments.stop_after,
        jobs=arguments.jobs,
        **asked_for(arguments),
    )
    with shown(arguments, "look") as progress:
        ahead = look_ahead(request, progress=progress)
    if arguments.json:
        answer(json.dumps(to_json(ahead), indent=1))
    else:
        print_table(_stages(ahead))
        print("\n".join(_lines(ahead)))
    ahead.check_room()
    return 0


def to_json(ahead: Ahead) -> dict[str, Any]:
    """For `packuv plan --json`: minutes, bytes; lists of [least, most] where a figure has an interval."""
    from pipelines.forecast import SIZE_WITHIN, TIME_WITHIN

    expected = ahead.forecast
    return {
        "sequence": ahead.name,
        "preset": ahead.preset,
        "frames": ahead.size.frames,
        "cameras": {"fitted": len(ahead.size.fitted), "held_out": len(ahead.size.held_out)},
        "stages": [{"stage": step.stage, "does": step.does, "minutes": round(step.minutes, 3)} for step in ahead.steps],
        "minutes_left": _within(ahead.minutes, TIME_WITHIN),
        "minutes_in_all": _within(expected.minutes, TIME_WITHIN),
        "memory_bytes": round(expected.memory_bytes),
        "gpu_memory_bytes": round(ahead.gpu_bytes),
        "disk_bytes": {"store": round(expected.disk_bytes), "to_write": round(ahead.missing_bytes)},
        "disk_free_bytes": ahead.free_bytes,
        "mb_per_frame": _within(expected.mb_per_frame, SIZE_WITHIN),
        "moving_share": ahead.moving,
        "spared": [{"what": what, "why": why} for what, why in ahead.spared],
        "not_in_the_forecast": list(ahead.unknown),
    }


def _within(value: float, factor: float) -> list[float]:
    return [round(value / factor, 4), round(value * factor, 4)]


def _stages(ahead: Ahead) -> Table:
    from pipelines.forecast import minutes_text

    table = Table("stage", "does", "time")
    for step in ahead.steps:
        time = minutes_text(step.minutes) if step.minutes else ""
        table.add_row(step.stage, step.does, time, style="" if step.minutes else "dim")
    return table


def _lines(ahead: Ahead) -> Iterator[str]:
    from pipelines.forecast import SIZE_WITHIN, TIME_WITHIN, minutes_text

    expected, size = ahead.forecast, ahead.size
    held_out = f", {len(size.held_out)} held out" if size.held_out else ""
    fitted = f"{counted(len(size.fitted), 'camera')} fitted{held_out}"
    yield f"sequence   {ahead.name}: {counted(size.frames, 'frame')}, {fitted}; {ahead.preset}"
    least, most = (minutes_text(ahead.minutes * factor) for factor in (1 / TIME_WITHIN, TIME_WITHIN))
    yield f"time       {least} to {most}" if ahead.minutes else "time       none: all is there"
    yield f"memory     {size_text(expected.memory_bytes)} for the largest job"
    if ahead.gpu_bytes:
        yield _gpu_line(ahead.gpu_bytes)
    yield f"disk       {size_text(ahead.missing_bytes)} more at most, {size_text(ahead.free_bytes)} are free"
    if expected.scene_bytes:
        mb, least_mb, most_mb = (expected.mb_per_frame * factor for factor in (1, 1 / SIZE_WITHIN, SIZE_WITHIN))
        yield f"scene      {size_text(expected.scene_bytes)}: {mb:.3f} MB a frame ({least_mb:.3f} to {most_mb:.3f})"
    if ahead.moving is not None:
        yield f"moves      {100 * ahead.moving:.0f} % of the pictures, as a few of them tell"
    yield from (f"spared     {what}: {why}" for what, why in ahead.spared)
    yield from (f"left out   {what}" for what in ahead.unknown)


def _gpu_line(needed: float) -> str:
    from packuv.fit.gpu_memory import memory_of_gpu

    free, total = memory_of_gpu()
    less = "; the CPU does what does not fit" if needed > free else ""
    return f"GPU        {size_text(needed)} for the largest fit, {size_text(free)} of {size_text(total)} are free{less}"


def _many(arguments: argparse.Namespace) -> int:
    from pipelines.batch.ahead import look_over  # takes seconds, as above
    from pipelines.batch.request import BatchRequest
    from pipelines.space import check_free

    if arguments.hold_out is not None:
        raise ValueError("cameras to hold out differ from capture to capture: name them in each capture.toml")
    request = BatchRequest(
        manifest=os.path.abspath(arguments.source),
        out=os.path.abspath(arguments.out),
        names=arguments.names,
        tags=arguments.tags,
        jobs=arguments.jobs or 1,
        at_once=arguments.at_once,
        stop_after=arguments.stop_after,
        **asked_for(arguments),
    )
    with shown(arguments, "look") as progress:
        whole = look_over(request, progress=progress)
    if arguments.json:
        rows = [_row_json(step, ahead) for step, ahead in whole.rows]
        facts = {"minutes": round(whole.minutes, 2), "disk_bytes": round(whole.missing_bytes), "at_once": whole.at_once}
        answer(json.dumps({"sequences": rows, **facts}, indent=1))
    else:
        print_table(_sequences(whole))
        print("\n".join(_totals(whole)))
    check_free(whole.out, whole.missing_bytes)
    return 0


def _row_json(step: Step, ahead: Ahead | None) -> dict[str, Any]:
    return {"sequence": step.name, "does": step.does, "why": step.why, "plan": ahead and to_json(ahead)}


def _sequences(whole: Whole) -> Table:
    from pipelines.forecast import minutes_text

    table = Table("sequence", "frames", "does", "why", "time", "disk", "scene")
    for step, ahead in whole.rows:
        cells = [step.name, str(step.frames), step.does, step.why]
        if ahead is not None:
            scene = ahead.forecast.scene_bytes
            cells += [minutes_text(ahead.minutes), size_text(ahead.missing_bytes), size_text(scene) if scene else ""]
        style = "yellow" if step.problem else "" if step.runs else "dim"
        table.add_row(*(Text(cell) for cell in cells), style=style)
    return table


def _totals(whole: Whole) -> Iterator[str]:
    from pipelines.forecast import TIME_WITHIN, minutes_text

    least, most = (minutes_text(whole.minutes * factor) for factor in (1 / TIME_WITHIN, TIME_WITHIN))
    run = sum(step.runs for step, _ in whole.rows)
    yield f"sequences  {run} of {len(whole.rows)} would run, {whole.at_once} at a time"
    yield f"time       {least} to {most}" if run else "time       none: all is there"
    yield f"memory     {size_text(whole.memory_bytes)} for the jobs that run at a time"
    yield f"disk       {size_text(whole.missing_bytes)} more at most, {size_text(free_bytes(whole.out))} are free"
