"""Telling somebody that a batch failed, by a command of theirs."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

PATIENCE_SECONDS = 60.0
"""A command that takes longer is ended: nobody waits for a mail"""
MOST_WORDS = 20
"""Of what a command says that failed"""


def notify(command: str, *, status: str, failed: Sequence[str], summary: str, page: Path) -> str:
    """Run a shell command with the facts in its environment; what went wrong with it, or nothing."""
    facts = {
        "PACKUV_STATUS": status,
        "PACKUV_FAILED": "\n".join(failed),
        "PACKUV_SUMMARY": summary,
        "PACKUV_PAGE": str(page),
    }
    with tempfile.TemporaryFile() as output:  # a pipe would stay open as long as something that it leaves behind
        try:
            code = subprocess.run(
                ["/bin/sh", "-c", command],
                env={**os.environ, **facts},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                timeout=PATIENCE_SECONDS,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            return f"took longer than {PATIENCE_SECONDS:.0f} s, and was ended"
        except OSError as error:
            return f"could not be started: {error.strerror}"
        output.seek(0)
        said = " ".join(output.read().decode(errors="replace").split()[-MOST_WORDS:])
    return f"exit code {code}{f': {said}' if said else ''}" if code else ""
