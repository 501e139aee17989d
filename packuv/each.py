"""Many things, of which few are looked at: one at a time, made each time that somebody asks, or some of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Generic, TypeVar, overload

import numpy as np

Item = TypeVar("Item", covariant=True)
One = TypeVar("One")


class Each(Sequence[Item], Generic[Item]):
    """`count` things, made by their index and not kept.

    >>> list(Each(lambda index: index * index, 4))
    [0, 1, 4, 9]
    """

    def __init__(self, make: Callable[[int], Item], count: int) -> None:
        self._make = make
        self._count = count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> Each[Item]: ...
    def __getitem__(self, index: int | slice) -> Item | Each[Item]:
        if isinstance(index, slice):
            return self.chosen(range(self._count)[index])
        return self._make(range(self._count)[index])

    def chosen(self, places: Sequence[int]) -> Each[Item]:
        """Those at some places."""
        return Each(lambda index: self._make(places[index]), len(places))


def packed(mask: np.ndarray) -> Callable[[], np.ndarray]:
    """What unpacks a mask, bool [H, W], from bits."""
    bits, shape = np.packbits(mask), mask.shape
    return lambda: np.unpackbits(bits, count=shape[0] * shape[1]).view(bool).reshape(shape)


def as_bits(masks: Iterable[np.ndarray | None]) -> Each[np.ndarray | None]:
    """Masks, bool [H, W] each, or None where there is none, kept as bits; asks for each of them once."""
    unpack = [None if mask is None else packed(mask) for mask in masks]

    def one(index: int) -> np.ndarray | None:
        read = unpack[index]
        return None if read is None else read()

    return Each(one, len(unpack))


def spread(items: Sequence[One], count: int) -> tuple[One, ...]:
    """`count` of the items at equal distances; all of them if there are fewer.

    >>> spread(["a", "b", "c", "d", "e", "f"], 3)
    ('b', 'd', 'f')
    """
    if count >= len(items):
        return tuple(items)
    return tuple(items[(2 * place + 1) * len(items) // (2 * count)] for place in range(count))
