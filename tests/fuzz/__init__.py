"""Fuzz targets, one file for each reader: a broken file gives a ValueError that names it, and nothing else.

The tests try 100 cases of each target, ``make fuzz`` 10,000. The profile in ``tests/conftest.py`` decides, so that
targets leave out ``max_examples``. This is a package because ``tests/test_tsplib.py`` has a namesake here, and pytest
wants module names to differ.
"""
