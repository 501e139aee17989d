"""Synthetic captures with exact ground truth."""
