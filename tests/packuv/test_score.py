"""Scores: one declaration makes the fields and the table's columns."""

from __future__ import annotations

from dataclasses import fields

import pyarrow as pa

from packuv.score import FIGURES, SCHEMA, Score


def test_the_table_has_the_columns_that_stores_hold():
    assert pa.schema(
        [
            ("frame", pa.int32()),
            ("time_ns", pa.int64()),
            ("camera", pa.string()),
            ("held_out", pa.bool_()),
            ("psnr_db", pa.float64()),
            ("ssim", pa.float64()),
            ("psnr_calibrated_db", pa.float64()),
            ("ssim_calibrated", pa.float64()),
            ("psnr_own_db", pa.float64()),
            ("ssim_own", pa.float64()),
            ("flicker", pa.float64()),
        ]
    ).equals(SCHEMA, check_metadata=True)


def test_every_field_is_a_column_and_every_figure_has_a_mean():
    assert SCHEMA.names == [field.name for field in fields(Score)]
    assert FIGURES == ("psnr_db", "ssim", "psnr_calibrated_db", "ssim_calibrated", "psnr_own_db", "ssim_own", "flicker")
