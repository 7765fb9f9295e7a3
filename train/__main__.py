"""``python -m train imitate [options]``, ``python -m train reinforce {paper,quick} [options]``."""

from __future__ import annotations

import os
import sys
from typing import Annotated

# Kernels that oneDNN keeps, read when torch is loaded: sizes change all the time, and building one takes milliseconds
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "8192")

import tyro

from train.config import PRESETS, ImitateConfig
from train.imitate import imitate
from train.reinforce import reinforce

Preset = tyro.extras.subcommand_type_from_defaults(
    {name: preset for name, (_, preset) in PRESETS.items()},
    {name: description for name, (description, _) in PRESETS.items()},
)
app = tyro.extras.SubcommandApp()


@app.command(name="reinforce")
def reinforce_command(config: Annotated[Preset, tyro.conf.arg(name="")]) -> None:
    """Train a DAN by REINFORCE with a greedy rollout baseline, from a preset with any option changed."""
    reinforce(config)


@app.command(name="imitate")
def imitate_command(config: Annotated[ImitateConfig, tyro.conf.arg(name="")]) -> None:
    """Train a DAN to choose as the reference solver does: a warm start for `reinforce`."""
    imitate(config)


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and train. Exit code 2 and one line on bad input."""
    try:
        app.cli(prog="python -m train", args=argv)
    except (ValueError, OSError, ImportError) as error:
        print(f"train: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
