"""Benchmarks of the MinMax mTSP; run from a checkout as ``python -m benchmarks``."""
