"""Where this checkout and recorded data are."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("PACKUV_DATA", ROOT / "../shared/data")).resolve()
"""Recorded captures and splats, see `conftest.data`; often absent"""
