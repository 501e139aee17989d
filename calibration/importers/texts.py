"""Files as text, and messages that name the file they are about."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import Any

import cv2

_SHOWN = 1000
"""Characters of a message, which may repeat what a file says."""
_STRANGE = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    RecursionError,
    TokenError,  # of the header of an .npy file
    TypeError,
    cv2.error,
    struct.error,
)
"""What look-ups and arithmetic in a strange file raise."""


class FaultError(ValueError):
    """What is wrong with a file, with its name."""


@contextmanager
def about(file: Path) -> Iterator[None]:
    """Turn whatever a strange file raises into a `FaultError` that names it, unless the message names one already."""
    try:
        yield
    except FaultError:
        raise
    except ValueError as problem:
        raise FaultError(f"{file}: {str(problem)[:_SHOWN]}") from problem
    except _STRANGE as problem:
        said = f"{type(problem).__name__}: {str(problem)[:_SHOWN]}"
        raise FaultError(f"{file} is damaged or not a calibration: {said}") from problem


def read_text(path: Path) -> str:
    """Text in UTF-8 or UTF-16, with or without a byte order mark."""
    data = path.read_bytes()
    encoding = "utf-8-sig"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    elif len(data) > 1 and not (data[0] and data[1]):  # no text begins with NUL; UTF-16 of Latin letters is half NULs
        encoding = "utf-16-le" if data[0] else "utf-16-be"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as problem:
        raise FaultError(
            f"{path} must be text in UTF-8 or UTF-16, but byte {problem.start} fits neither; save it again as UTF-8"
        ) from None


def read_json(path: Path) -> Any:
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as problem:
        raise FaultError(f"{path} is no JSON: {problem.msg}, line {problem.lineno}") from None
    except RecursionError:
        raise FaultError(f"{path} is nested too deep to be a calibration") from None


def first_line(path: Path) -> str:
    """The first line with something in it; empty for what is no text."""
    return next(iter(first_lines(path, 1)), "")


def first_lines(path: Path, count: int) -> list[str]:
    """The first lines with something in them."""
    with path.open("rb") as file:
        start = file.read(8192)
    try:
        text = start.decode("utf-16" if start.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig", errors="ignore")
    except UnicodeDecodeError:
        return []
    return [line for line in text.splitlines() if line.strip()][:count]


def number(value: Any, what: str) -> float:
    """A finite number; raises ValueError that says what it should have been."""
    try:
        found = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} must be a number, but is {_short(value)}") from None
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise ValueError(f"{what} must be a finite number that float64 holds, but is {_short(value)}")
    return found


def whole(value: Any, what: str) -> int:
    """A whole number, also one that is written 1920.0."""
    found = number(value, what)
    if found != int(found):
        raise ValueError(f"{what} must be a whole number, but is {_short(value)}")
    return int(found)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
