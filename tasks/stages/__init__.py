"""The stages of a sequence."""
