"""A data set: every sequence of a manifest processed, some at a time, each on its own."""
