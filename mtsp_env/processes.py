"""Processes that are started to work for another one, and end when it does."""

from __future__ import annotations

import multiprocessing
import os
from threading import Thread


def end_with_parent() -> None:
    """From now on, this process of ``multiprocessing`` ends as soon as the one that started it has ended, however.

    Without this, the workers of a pool whose owner was killed wait for work forever. It fits
    ``ProcessPoolExecutor(initializer=end_with_parent)``.
    """
    Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:  # None: nobody has started this process
        parent.join()
        os._exit(1)
