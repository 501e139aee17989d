"""Arrow columns of a dataclass: a table's schema is said once, by the fields."""

from __future__ import annotations

from collections.abc import Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pyarrow as pa

TYPES: Mapping[type, pa.DataType] = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}


def column_types(kind: type) -> dict[str, pa.DataType]:
    """Arrow's type of each field, in their order; the one that an `Annotated` field names, else that of its values."""
    return {name: _column_type(annotation) for name, annotation in get_type_hints(kind, include_extras=True).items()}


def optional_fields(kind: type) -> set[str]:
    """Fields that may be None."""
    return {name for name, annotation in get_type_hints(kind).items() if NoneType in get_args(annotation)}


def _column_type(annotation: Any) -> pa.DataType:
    if get_origin(annotation) is Annotated:
        return annotation.__metadata__[0]
    if isinstance(annotation, UnionType):
        (annotation,) = (part for part in get_args(annotation) if part is not NoneType)
    if get_origin(annotation) is tuple:
        return pa.list_(_column_type(get_args(annotation)[0]))
    return pa.string() if issubclass(annotation, str) else TYPES[annotation]
