"""A smaller scene file of a lossless one: fewer Gaussians, codes in coarser steps, as coarse as pictures bear.

What a step of each code does to the pictures of the scene's cameras, or of imagined ones where nobody filmed it
(`imagined`), is learned from their gradients (`sensitivity`), every kind of code gets steps that add the same noise to
them (`steps`), Gaussians that make up too little of any picture for their bits are left out (`weigh`), the codes of the
others move until pictures are nearest to what was filmed, or to the lossless ones (`filmed`, `targets`, `tune`), and
that noise is chosen by files that are written and pictures that are drawn (`search`). The result is a scene file like
any other. docs/compression.md.
"""

from packuv.compress.search import Compressed, Goal, compress, usual_iterations

__all__ = ["Compressed", "Goal", "compress", "usual_iterations"]
