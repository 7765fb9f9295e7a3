"""``python -m train {recipe, imitate, reinforce, improve, average, validate} [options]``."""

from __future__ import annotations

import os
import sys
from concurrent.futures import BrokenExecutor

from train.interrupts import exit_on_signals

if __name__ == "__main__":
    exit_on_signals()  # before torch is imported, which takes seconds

from dan_policy.arguments import (
    check_docstrings,
    check_working_directory,
    deferred,
    one_line_errors,
    open_streams,
    refuse,
)

if __name__ == "__main__":
    try:  # what follows cannot be imported otherwise
        check_docstrings()
        check_working_directory()
    except (ImportError, OSError) as error:
        refuse(str(error), "train")

# Number of kernels that oneDNN caches; PyTorch reads it when it is loaded. Batches have many shapes, and building a
# kernel takes milliseconds.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "8192")

import torch
import tyro

from mtsp_env.reading import printable
from train.average import average
from train.imitate import imitate
from train.improve import improve
from train.reinforce import reinforce
from train.stages import recipe
from train.validate import validate

app = tyro.extras.SubcommandApp()
for command in (recipe, imitate, reinforce, improve, average, validate):
    app.command(deferred(command))


def main(argv: list[str] | None = None) -> int:
    """Run a command and return 0. Bad input, divergence and a lack of memory print one line to stderr and return 2."""
    open_streams()
    try:
        check_working_directory()
        with one_line_errors("train"):
            chosen = app.cli(prog="python -m train", description="Train networks for the MinMax mTSP.", args=argv)
        chosen()
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        return _refuse(str(error))
    except BrokenExecutor as error:
        return _refuse(f"a process that makes labels has died, perhaps for lack of memory ({error})")
    except (MemoryError, RuntimeError) as error:
        if not _lacks_memory(error):
            raise
        return _refuse(f"out of memory ({error}): choose smaller batches, sets, instances or networks")
    return 0


def _refuse(message: str) -> int:
    print(f"train: error: {printable(' '.join(message.split()))}", file=sys.stderr)
    return 2


def _lacks_memory(error: Exception) -> bool:
    """Whether Python, NumPy, a GPU, or PyTorch on a CPU, which has no error of its own, could not get memory."""
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "DefaultCPUAllocator" in str(error)


if __name__ == "__main__":
    sys.exit(main())
