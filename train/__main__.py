"""``python -m train {recipe, imitate, reinforce, improve, average, validate} [options]``."""

from __future__ import annotations

import os
import sys

# Number of kernels that oneDNN caches; PyTorch reads it when it is loaded. Batches have many shapes, and building a
# kernel takes milliseconds.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "8192")

import tyro

from train.average import average
from train.imitate import imitate
from train.improve import improve
from train.reinforce import reinforce
from train.stages import recipe
from train.validate import validate

app = tyro.extras.SubcommandApp()
for command in (recipe, imitate, reinforce, improve, average, validate):
    app.command(command)


def main(argv: list[str] | None = None) -> int:
    """Run a command and return 0. Bad input prints one line to stderr and returns 2."""
    try:
        app.cli(prog="python -m train", description="Train networks for the MinMax mTSP.", args=argv)
    except (ValueError, OSError, ImportError) as error:
        print(f"train: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
