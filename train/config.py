"""Every option of a training run, in one place."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from dan_policy.network import DANConfig
from mtsp_env.instance import check_count, check_distribution

# May differ between a run and its continuation; everything else is part of what is being trained.
FREE_ON_RESUME = ("out", "resume", "steps", "seconds", "threads", "tensorboard", "checkpoint_every", "device")


@dataclass(frozen=True)
class ReinforceConfig:
    """REINFORCE with a greedy rollout baseline (paper, Sec. 5.1).

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/reinforce")
    """Folder for checkpoint, weights and logs."""
    resume: bool = False
    """Go on from the checkpoint in `out`, bit by bit as if the run had never stopped."""
    seed: int = 0
    steps: int = 100_000
    """Optimiser steps in all."""
    seconds: float | None = None
    """Stop (and save) after so many seconds of this process, whatever `steps` says."""

    n_nodes: tuple[int, int] = (20, 100)
    """Range of n, the depot included; drawn once per batch."""
    n_agents: tuple[int, int] = (5, 10)
    """Range of m; drawn once per batch."""
    distribution: str = "uniform"
    speed: float = 0.1
    """Distance per tick, the paper's Delta g."""
    depot: Literal["open", "final"] = "open"
    """Whether an agent that is back at the depot may leave again."""
    batch_size: int = 8
    """Instances per optimiser step."""

    network: DANConfig = field(default_factory=DANConfig.paper)
    init: str | None = None
    """Weights to start from: a file, or the name of a shipped model (its configuration replaces `network`)."""

    learning_rate: float = 1e-5
    decay: float = 0.96
    """Factor on the learning rate every `decay_every` steps."""
    decay_every: int = 1024
    max_grad_norm: float = 1.0

    challenge_every: int = 128
    """Steps between challenges of the baseline."""
    challenge_instances: int = 512
    """Fresh instances that the baseline is tested on."""
    challenge_p: float = 0.05
    """One-sided paired t-test: the policy replaces the baseline below this p."""

    validation_instances: int = 256
    """Held-out instances (the same in every run) for the reported cost and for `best.safetensors`."""
    validate_every: int = 128
    checkpoint_every: int = 128

    chunk: int = 512
    """Decisions whose log-probabilities are recomputed at once: the bound on memory."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 autocast pays on GPUs and on CPUs with AMX."""
    device: str = "cpu"
    threads: int | None = None
    """CPU threads of PyTorch; none: PyTorch's own choice."""
    tensorboard: bool = True
    """TensorBoard logs beside the CSV ones."""

    def __post_init__(self) -> None:
        for name, minimum in (("n_nodes", 2), ("n_agents", 1)):
            low, high = getattr(self, name)
            check_count(f"{name}[0]", low, minimum)
            check_count(f"{name}[1]", high, low)
        for name in (
            "steps",
            "batch_size",
            "chunk",
            "decay_every",
            "challenge_every",
            "validate_every",
            "checkpoint_every",
        ):
            check_count(name, getattr(self, name), 1)
        for name in ("challenge_instances", "validation_instances"):
            check_count(name, getattr(self, name), 2)
        for name in ("learning_rate", "decay", "max_grad_norm", "speed"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)!r}")
        if not 0 < self.challenge_p < 1:
            raise ValueError(f"challenge_p must lie between 0 and 1, got {self.challenge_p!r}")
        check_distribution(self.distribution)

    def to_dict(self) -> dict:
        """The configuration as JSON values."""
        return json.loads(json.dumps(asdict(self), default=str))


def check_same_run(old: dict, config: ReinforceConfig) -> None:
    """Raise ValueError where ``config`` would change what an interrupted run was training."""
    new = config.to_dict()
    changed = [k for k in new if k not in FREE_ON_RESUME and old.get(k) != new[k]]
    if changed:
        said = ", ".join(f"{k} was {old.get(k)!r}, is {new[k]!r}" for k in changed)
        raise ValueError(f"a resumed run keeps its configuration: {said}")


PAPER = ReinforceConfig()
"""The paper's training, stage 1 (Sec. 5.1), with one optimiser step per batch instead of one per agent."""

QUICK = replace(
    PAPER,
    steps=2_000,
    n_nodes=(10, 30),
    n_agents=(2, 5),
    speed=0.1,
    depot="final",
    batch_size=128,
    network=replace(DANConfig.paper(), prune_visited=True),
    learning_rate=3e-4,
    decay=0.97,
    decay_every=50,
    challenge_every=50,
    challenge_instances=512,
    validate_every=50,
    checkpoint_every=50,
)
"""Small instances, the depot rule "final" and a larger step: learns within minutes on two CPU cores."""

PRESETS = {
    "paper": ("the paper's setting: n in [20, 100], m in [5, 10], 8 instances a step, Adam 1e-5", PAPER),
    "quick": ("n in [10, 30], m in [2, 5], 128 instances a step: learns within minutes on a CPU", QUICK),
}
