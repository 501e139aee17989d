"""Benchmarks: run time against error, stress tests, what each part of the method is worth; the top layer."""
