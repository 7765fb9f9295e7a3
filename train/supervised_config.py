"""The options of imitation and self-improvement; each is a field with its documentation below it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from dan_policy.dan import DANConfig
from mtsp_env.checks import check_seconds
from train.config import RunConfig
from train.optimisers import OptimiserName


@dataclass(frozen=True, kw_only=True)
class SupervisedConfig(RunConfig):
    """What imitation and self-improvement share: both learn to choose as given tours do.

    Raises:
        ValueError: a value outside its range.
    """

    n_nodes: tuple[int, int] = (20, 200)
    """Range of n, the depot included. Each set or batch draws one n."""
    n_agents: tuple[int, int] = (2, 20)
    """Range of m. Each set or batch draws one m."""
    nodes_per_agent: int = 5
    """Least number of nodes per agent: it lowers the upper end of m's range for small n."""
    speed: float = 0.01
    """Distance per tick, the paper's Delta g (in its tests)."""
    depot: Literal["final"] = "final"
    """An agent that has returned to the depot has finished: the agents of the tours never leave twice."""
    rotate: bool = False
    """Turn every instance by a random angle, and scale it down if it would leave the unit square."""
    network: DANConfig = field(default_factory=lambda: DANConfig(prune_visited=True))
    """Options of the policy dan."""

    optimiser: OptimiserName = "adamw"
    """adamw for all parameters, or muon for the matrices of the hidden layers and adamw for the others."""
    learning_rate: float = 5e-4
    """Peak learning rate, after a linear warm-up; then it falls along half a cosine."""
    final_rate: float = 0.02
    """Final learning rate as a share of the peak."""
    warmup: int = 200
    """Steps of the warm-up."""
    weight_decay: float = 0.01
    """Weight decay, decoupled from the gradient as in AdamW."""
    anneal_seconds: float | None = None
    """The learning rate reaches its final value after this many seconds of training, even before `steps` are reached.
    Such a run follows the clock, and does not resume bit for bit."""
    next_weight: float = 0.5
    """Weight in the loss of every other agent's next node in the tours. 0: only the deciding agent's. Without effect on
    networks that have no such output (`dense_outputs`), such as DAN."""
    assignment_weight: float = 1.0
    """Weight in the loss of which agent visits each city in the tours. 0: not learnt. Without effect on networks that
    have no such output."""
    plan_matching: Literal["canonical", "invariant"] = "canonical"
    """Which agent takes which tour while several agents have not left the depot: the tours' own order (canonical), or
    the assignment that the network already finds likeliest (invariant), which needs a network with `dense_outputs`."""
    average: float = 0.999
    """Decay of the running average of the weights, which is what is validated and saved. 0 disables averaging."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_at_least(1, "warmup")
        self._check_share("learning_rate", "final_rate")
        if self.depot != "final":
            raise ValueError(f"depot must be 'final' (the tours' agents never leave twice), got {self.depot!r}")
        for name in ("weight_decay", "next_weight", "assignment_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and at least 0, got {getattr(self, name)!r}")
        if self.anneal_seconds is not None:
            check_seconds("anneal_seconds", self.anneal_seconds)


@dataclass(frozen=True, kw_only=True)
class ImitateConfig(SupervisedConfig):
    """Imitation of the reference solver: a warm start for REINFORCE, or a policy in its own right.

    A *set* is a batch of instances of one size (n, m) with the teacher's tours. Its k-th decisions form a rectangular
    batch even if visited cities are dropped. An optimiser step takes such a batch from each of `sets_per_step` sets,
    drawn at random from the `buffer` sets at hand, so that it mixes sizes and phases of the game.

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/imitate")
    """Folder for the checkpoint, weights and logs."""
    steps: int = 20_000
    """Total number of optimiser steps. The learning rate reaches its final value with the last one."""
    set_tokens: int = 8192
    """Upper bound on instances times nodes of a set. The number of instances is a power of two from 16 to 256."""
    buffer: int = 16
    """Number of sets to draw from at a time."""
    passes: float = 1.0
    """Share of a set's decision indices that are used before a fresh set replaces it, at most 1. With `labels` regrets
    or policy, how often each of its decisions is used."""
    roll_in: str | None = None
    """Weights of a student (a file, or a shipped model's name) that plays a random number of decisions at the beginning
    of each game; the teacher shows how to continue (DAgger), and the next decisions are learnt from, a share `passes`
    of the set's. With `labels` regrets or policy, this network plays whole games. None: the teacher plays them."""
    labels: Literal["tours", "regrets", "policy"] = "tours"
    """What is learnt: the teacher's tours; how much each of the student's likely next nodes costs in its own games, as
    the teacher sees it (regrets); or the probabilities of the network in `roll_in` in its own games (policy)."""
    regret_temperature: float = 0.01
    """With `labels` regrets: a node whose makespan exceeds that of the best node by this share should lose a factor of
    e in probability, compared with the best one."""
    sets_per_step: int = 4
    """Number of sets that an optimiser step takes decisions from."""
    teacher_iterations: int = 80
    """Iterations of the reference solver per node of an instance."""
    workers: int = 1
    """Processes that prepare sets while the network learns. 0: the learning process prepares them itself."""

    validate_every: int = 500
    """Steps between validations."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_at_least(1, "set_tokens", "buffer", "sets_per_step", "teacher_iterations")
        self._check_at_least(0, "workers")
        if self.n_nodes[0] <= self.n_agents[0]:
            raise ValueError(f"n_nodes[0] must be above n_agents[0]={self.n_agents[0]}, got {self.n_nodes[0]}")
        if self.sets_per_step > self.buffer:
            raise ValueError(f"sets_per_step must be at most buffer={self.buffer}, got {self.sets_per_step}")
        if self.labels not in ("tours", "regrets", "policy"):
            raise ValueError(f"labels must be 'tours', 'regrets' or 'policy', got {self.labels!r}")
        if not 0 < self.regret_temperature < math.inf:
            raise ValueError(f"regret_temperature must be finite and above 0, got {self.regret_temperature!r}")
        if self.labels == "tours":
            self._check_share("passes")
        elif not 0 < self.passes <= 100:
            raise ValueError(f"passes must be above 0 and at most 100, got {self.passes!r}")
        elif self.roll_in is None or self.scenario != ("plain",) or self.plan_matching != "canonical":
            raise ValueError(
                f"labels={self.labels!r} needs a network in roll_in, scenario ('plain',) and plan_matching "
                f"'canonical', got {self.roll_in!r}, {self.scenario} and {self.plan_matching!r}"
            )
        if self.plan_matching == "invariant" and self.scenario != ("plain",):
            raise ValueError(
                f"plan_matching must be 'canonical' in worlds, where agents may differ, got scenario={self.scenario}"
            )


@dataclass(frozen=True, kw_only=True)
class ImproveConfig(SupervisedConfig):
    """Self-improvement: the policy plays every instance several times, and learns from the best of its own games.

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/improve")
    """Folder for the checkpoint, weights and logs."""
    steps: int = 1_000
    """Total number of optimiser steps. The learning rate reaches its final value with the last one."""
    n_nodes: tuple[int, int] = (20, 100)
    """Range of n, the depot included. Each batch draws one n."""
    n_agents: tuple[int, int] = (2, 15)
    """Range of m. Each batch draws one m."""
    batch_size: int = 32
    """Number of instances per optimiser step."""
    batch_tokens: int | None = 800
    """Upper bound on instances times nodes per optimiser step: larger instances come in smaller batches."""
    samples: int = 16
    """Games per instance, at least 2, with drawn actions, each in another rotation or reflection. The one with the
    smallest makespan is learnt from."""
    chunk: int = 512
    """Number of decisions that are learnt from at once. It bounds the memory."""
    learning_rate: float = 1e-4
    """Peak learning rate, after a linear warm-up; then it falls along half a cosine."""
    warmup: int = 20
    """Steps of the warm-up."""
    average: float = 0.95
    """Decay of the running average of the weights, which is what is validated and saved. 0 disables averaging."""
    validate_every: int = 50
    """Steps between validations."""
    checkpoint_every: int = 50
    """Steps between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_at_least(1, "batch_size", "chunk")
        self._check_at_least(2, "samples")
        if self.scenario != ("plain",):
            raise ValueError(f"scenario must be 'plain', for imitation and reinforce know worlds, got {self.scenario}")
        if self.batch_tokens is not None:
            self._check_at_least(1, "batch_tokens")
