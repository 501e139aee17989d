"""A smaller scene file of a lossless one: codes in coarser steps, as coarse as pictures bear.

What a step of each code does to the pictures of the scene's cameras is learned from their gradients (`sensitivity`),
every kind of code gets steps that add the same noise to them (`steps`), and that noise is chosen by files that are
written and pictures that are drawn (`search`). The result is a scene file like any other. docs/compression.md.
"""

from packuv.compress.search import Compressed, Goal, compress

__all__ = ["Compressed", "Goal", "compress"]
