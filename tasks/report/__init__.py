"""The report of a run, as numbers and as a page."""
