"""Measurements beyond the paper's tables, one command each."""
