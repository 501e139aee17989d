"""How the terminal puts a run: lengths of time, outcomes, states of what is under way."""

from __future__ import annotations

from pipelines.events import Event, Forecast

LABEL_WIDTH = 30


def ending(event: Event) -> str:
    """The line that remains of a stage."""
    return f"{event.label:<{LABEL_WIDTH}} {outcome(event)}"


def outcome(event: Event) -> str:
    """How the stage ended."""
    match event.outcome:
        case "made":
            return duration(event.seconds)
        case "reused":
            return "there already"
        case "skipped":
            return f"skipped: {event.reason}"
    return "stopped" if event.stopped else "failed"


def state(forecast: Forecast) -> str:
    """All that is known of a stage under way."""
    return ", ".join(part for part in (percent(forecast), left(forecast), forecast.note) if part) or "under way"


def percent(forecast: Forecast) -> str:
    return f"{100 * forecast.done / forecast.total:3.0f} %" if forecast.total > 0 else ""


def left(forecast: Forecast) -> str:
    remaining = forecast.remaining_seconds()
    return "" if remaining is None else f"{duration(remaining)} left"


def counted(number: int, what: str) -> str:
    """So many of something.

    >>> counted(1, "frame"), counted(54000, "frame")
    ('1 frame', '54,000 frames')
    """
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def duration(seconds: float) -> str:
    """A length of time for people.

    >>> [duration(s) for s in (0.04, 9.96, 75, 3720)]
    ['0.0 s', '10.0 s', '1 min 15 s', '1 h 02 min']
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
