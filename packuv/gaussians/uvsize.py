"""Size of the UV map; loads in no time, for the command line shows its defaults."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class UvOptions:
    """Size of the UV map."""

    rows: int = 1024
    """Azimuth texels of layer 0, the paper's M0."""
    columns: int = 1024
    """Polar texels of layer 0, the paper's N0."""
    layers: int = 8
    """The paper's K; layers beyond 8 keep less than 0.5 % more on real scenes."""

    def __post_init__(self) -> None:
        if min(self.rows, self.columns, self.layers) < 1:
            raise ValueError(f"a UV map needs at least one row, column and layer, but has {self}")
        row_step, column_step = 2 ** ((self.layers - 1) // 2), 2 ** (self.layers // 2)
        if self.rows % row_step or self.columns % column_step:
            raise ValueError(
                f"{self.layers} layers halve the map until rows are divided by {row_step} and columns by "
                f"{column_step}, which {self.rows} x {self.columns} does not allow; choose multiples"
            )

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """(rows, columns) of each layer: the recurrence of section 4.1."""
        return tuple((self.rows >> k // 2, self.columns >> (k + 1) // 2) for k in range(self.layers))
