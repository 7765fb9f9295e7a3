"""Fuzz targets, one file for each reader: a broken file gives a ValueError that names it, and nothing else.

A package, because pytest wants module names to differ and ``tests/test_tsplib.py`` exists. ``pytest`` tries 100 cases of
each target, ``make fuzz`` 10,000: the profile in ``tests/conftest.py`` decides, so targets leave out ``max_examples``.
"""
