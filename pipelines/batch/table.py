"""The results of a data set: one Parquet file beside the manifest, a row for each sequence and output folder."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from packuv.files import whole_file
from packuv.tables import column_types

KIND, VERSION = b"packuv_results", b"1"
NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EISDIR, errno.ENOTDIR, errno.ENOENT)


class Status(StrEnum):
    """How the last run of a sequence ended."""

    FINISHED = "finished"
    FAILED = "failed"
    BAD_INPUT = "bad input"
    """The capture cannot be processed as it is"""
    KILLED = "killed"
    """Without a word: its process was killed, or the machine went down"""
    CANCELLED = "cancelled"


@dataclass(frozen=True)
class Result:
    """One row."""

    sequence: str
    out: str
    """Output folder"""
    status: Status
    reused: bool = False
    """It was there already, so that nothing ran"""
    reason: str = ""
    """Why it is not finished"""
    psnr_db: float | None = None
    ssim: float | None = None
    unseen: bool = False
    """Scored on cameras that were never fitted"""
    mb_per_frame: float | None = None
    """Of the scene file"""
    frames: int | None = None
    findings: int | None = None
    """What in the report a person should look at"""
    seconds: float = 0.0
    """That the last run took"""
    hours: float | None = None
    """Of the run that made it"""
    report: str | None = None
    """Path"""
    scene: str | None = None
    """Path"""
    started: str = ""
    """UTC, ISO 8601"""
    finished: str = ""
    """Likewise"""
    preset: str = ""
    packuv: str = ""
    """Version of the package"""
    fingerprint: str = ""
    """Of request, program, capture and result, see `pipelines.batch.plan.Fingerprint`"""


SCHEMA = pa.schema(list(column_types(Result).items()), metadata={KIND: VERSION})
Rows = dict[tuple[str, str], Result]
"""By sequence and output folder"""


class ResultTable:
    """The file; safe to use from several threads and processes."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> Rows:
        """Raises ValueError for a file of another kind."""
        if not self.path.exists():
            return {}
        try:
            table = pq.read_table(self.path, partitioning=None)
        except (pa.ArrowInvalid, IsADirectoryError):
            raise ValueError(f"{self.path} must be a table of results, but is no Parquet file; move it away") from None
        if (table.schema.metadata or {}).get(KIND) != VERSION:
            raise ValueError(f"{self.path} must be a table of results of version 1, but is another; move it away")
        rows = (_row(row) for row in table.to_pylist())
        return {(row.sequence, row.out): row for row in rows}

    def put(self, results: Iterable[Result]) -> None:
        """Add rows in one step, in place of those for the same sequence and output folder."""
        with self._alone():
            rows = self.read() | {(row.sequence, row.out): row for row in results}
            plain: list[Mapping[str, Any]] = [vars(rows[key]) for key in sorted(rows)]
            with whole_file(self.path) as part:
                pq.write_table(pa.Table.from_pylist(plain, schema=SCHEMA), part)

    def check(self) -> None:
        """Raise ValueError where it cannot be written."""
        try:
            self.put(())
        except OSError as error:
            if error.errno not in NOT_WRITABLE:
                raise
            what = f"results must go to {self.path}, which cannot be written ({os.strerror(error.errno)})"
            raise ValueError(f"{what}; copy the manifest to a folder of your own") from None

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        with open(self.path.with_name(f".{self.path.name}.lock"), "ab") as lock:
            fcntl.flock(lock.fileno(), fcntl.LOCK_EX)
            yield


def _row(plain: Mapping[str, Any]) -> Result:
    known = {field.name for field in fields(Result)}
    row = {name: value for name, value in plain.items() if name in known}
    return Result(**{**row, "status": Status(row["status"])})
