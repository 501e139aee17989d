"""Options and inputs as plain JSON values, and back; one text per recipe.

The text of a recipe is hashed, so equal recipes must have equal texts and different recipes different ones.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass, replace
from enum import Enum
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from packuv.partial import partial_path
from tasks.artefacts import recipe

T = TypeVar("T")

INTERCHANGEABLE = "in every recipe"
"""Metadata of a dataclass's field: the value that stands in a recipe whatever the field's is, since results are alike
within a tolerance that is checked"""


class OptionError(ValueError):
    """An option has a wrong name or a value of the wrong kind."""


def plain(value: Any, *, where: str = "recipe", decisive: bool = False) -> Any:
    """The value as None, bool, int, float, str, list and dict.

    Dataclasses become dicts, tuples lists, enums their values, fractions "3/2". -0.0 becomes 0.0, since they are
    equal. If `decisive`, fields that are `INTERCHANGEABLE` have the value that stands for all. Raises TypeError that
    names the place for what has no plain form: a path (its content decides, not its name), NaN and infinity, an array.
    """
    match value:
        case Enum():
            return plain(value.value, where=where, decisive=decisive)
        case None | bool() | str():
            return value
        case int():
            return int(value)
        case float() if math.isfinite(value):
            return float(value) + 0.0
        case Fraction():
            return f"{value.numerator}/{value.denominator}"
        case Mapping():
            return {
                _name(key, where): plain(item, where=f"{where}.{key}", decisive=decisive) for key, item in value.items()
            }
        case list() | tuple():
            return [plain(item, where=f"{where}[{index}]", decisive=decisive) for index, item in enumerate(value)]
    if is_dataclass(value) and not isinstance(value, type):
        items = {f.name: getattr(value, f.name) for f in fields(value)}
        if decisive:
            items |= {f.name: f.metadata[INTERCHANGEABLE] for f in fields(value) if INTERCHANGEABLE in f.metadata}
        return plain(items, where=where, decisive=decisive)
    raise TypeError(f"{where}: {value!r} has no place in a recipe; give numbers, text, or the digest of a file")


def _name(key: Any, where: str) -> str:
    if not isinstance(key, str):
        raise TypeError(f"{where}: the key {key!r} is not text")
    return key


def canonical(value: Any) -> str:
    """The one JSON text of a value; the order of dict keys does not matter."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """SHA-256 of the canonical text, 64 hex digits."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()


def restore(kind: Any, value: Any, *, where: str = "options") -> Any:
    """The inverse of `plain` for a declared type; text is read where a number or a choice is declared.

    Raises OptionError that names the path of an unknown key, with the valid names, or of a value of the wrong kind.
    """
    if kind is Any or kind is object:
        return value
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return _restore_union(get_args(kind), value, where)
    if origin is Literal:
        return _restore_choice(get_args(kind), value, where)
    if origin is tuple:
        return _restore_tuple(get_args(kind), value, where)
    if origin in (list, Sequence):
        return [restore(get_args(kind)[0], item, where=where) for item in _items(value, where)]
    if origin in (dict, Mapping):
        return {str(key): restore(get_args(kind)[1], item, where=f"{where}.{key}") for key, item in value.items()}
    if is_dataclass(kind):
        return _restore_dataclass(kind, value, where)
    return _restore_scalar(kind, value, where)


def _restore_dataclass(kind: Any, value: Any, where: str) -> Any:
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise OptionError(f"{where} must be a table of {', '.join(names_of(kind))}, but is {value!r}")
    hints = get_type_hints(kind)
    check_names(kind, value, where)
    given = {name: restore(hints[name], item, where=f"{where}.{name}") for name, item in value.items()}
    missing = [
        f.name for f in fields(kind) if f.name not in given and f.default is MISSING and f.default_factory is MISSING
    ]
    if missing:
        raise OptionError(f"{where} needs {', '.join(missing)}")
    return kind(**given)


def check_names(kind: Any, names: Mapping[str, Any], where: str) -> None:
    """Raise OptionError for a name that the dataclass does not have."""
    for name in names:
        if name not in names_of(kind):
            raise OptionError(f"unknown option {join(where, name)}; valid here: {', '.join(names_of(kind))}")


def join(where: str, name: str) -> str:
    """Path of a field inside a table; the outermost table has no name."""
    return f"{where}.{name}" if where else name


def override(options: T, tree: Mapping[str, Any], *, where: str = "") -> T:
    """A copy of a dataclass with the values of a nested mapping; tables merge, everything else replaces.

    Raises OptionError as `restore` does.
    """
    check_names(type(options), tree, where)
    hints = get_type_hints(type(options))
    changes: dict[str, Any] = {}
    for name, value in tree.items():
        now, path = getattr(options, name), join(where, name)
        nested = is_dataclass(now) and isinstance(value, Mapping)
        changes[name] = override(now, value, where=path) if nested else restore(hints[name], value, where=path)
    try:
        return replace(options, **changes)  # type: ignore[type-var]  # T is a dataclass
    except OptionError:
        raise
    except ValueError as error:
        raise OptionError(f"{where or 'options'}: {error}") from None


def names_of(kind: Any) -> list[str]:
    """Names of a dataclass's fields, in their order."""
    return [f.name for f in fields(kind)]


def _restore_union(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    if type(None) in kinds and (value is None or (isinstance(value, str) and value.lower() == "none")):
        return None
    problem: OptionError | None = None
    for kind in kinds:
        if kind is type(None):
            continue
        try:
            return restore(kind, value, where=where)
        except OptionError as error:
            problem = error
    raise problem or OptionError(f"{where} must be none, but is {value!r}")


def _restore_choice(choices: tuple[Any, ...], value: Any, where: str) -> Any:
    for choice in choices:
        if value == choice or value == str(choice):
            return choice
    raise OptionError(f"{where} must be one of {', '.join(map(str, choices))}, but is {value!r}")


def _items(value: Any, where: str) -> list[Any]:
    if isinstance(value, str):
        return [item.strip() for item in value.split(",") if item.strip()]
    if isinstance(value, (list, tuple)):
        return list(value)
    raise OptionError(f"{where} must be a list, but is {value!r}")


def _restore_tuple(kinds: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    items = _items(value, where)
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        return tuple(restore(kinds[0], item, where=f"{where}[{index}]") for index, item in enumerate(items))
    if len(items) != len(kinds):
        raise OptionError(f"{where} must have {len(kinds)} values, but has {len(items)}: {value!r}")
    return tuple(
        restore(kind, item, where=f"{where}[{index}]")
        for index, (kind, item) in enumerate(zip(kinds, items, strict=True))
    )


def _restore_scalar(kind: Any, value: Any, where: str) -> Any:
    try:
        return _scalar(kind, value)
    except (ValueError, TypeError, ZeroDivisionError, OverflowError):
        raise OptionError(f"{where} must be {_described(kind)}, but is {value!r}") from None


_BOOLEANS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def _scalar(kind: Any, value: Any) -> Any:
    if kind is bool:
        return value if isinstance(value, bool) else _boolean(value)
    if isinstance(value, bool):
        raise TypeError
    if kind is int:
        return _integer(value)
    if kind is float:
        return _finite(float(value))
    if kind is str and not isinstance(value, str):
        raise TypeError
    return kind(value)


def _boolean(value: Any) -> bool:
    if not isinstance(value, str) or value.lower() not in _BOOLEANS:
        raise TypeError
    return _BOOLEANS[value.lower()]


def _integer(value: Any) -> int:
    if isinstance(value, float) and not value.is_integer():
        raise ValueError
    return int(value)


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError
    return value


def _described(kind: Any) -> str:
    if isinstance(kind, type) and issubclass(kind, Enum):
        return "one of " + ", ".join(str(item.value) for item in kind)
    names = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text", Path: "a path"}
    return names.get(kind, getattr(kind, "__name__", str(kind)))


def write_json(path: Path, value: Any) -> None:
    """Replace a JSON file in one step; a reader sees the old text or the new one."""
    part = partial_path(path)
    try:
        with naming(path):
            part.write_text(json.dumps(recipe.plain(value), indent=1))
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Where an error of the system names no file, as one in writing does not, have it name this file or folder."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            error.filename = str(path)
        raise
