"""Every option of a training run, in one place."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from dan_policy.network import DANConfig
from mtsp_env.checks import check_count
from mtsp_env.distributions import check_distribution

# May differ between a run and its continuation; everything else is part of what is being trained.
FREE_ON_RESUME = (
    "out",
    "resume",
    "steps",
    "seconds",
    "threads",
    "tensorboard",
    "checkpoint_every",
    "device",
    "workers",
)


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What every kind of training has: where it writes, what it trains, on which instances, when it validates.

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/train")
    """Folder for checkpoint, weights and logs."""
    resume: bool = False
    """Go on from the checkpoint in `out`, bit by bit as if the run had never stopped."""
    seed: int = 0
    steps: int = 100_000
    """Optimiser steps in all."""
    seconds: float | None = None
    """Stop (and save) after so many more seconds of training and validation, whatever `steps` says."""

    n_nodes: tuple[int, int] = (20, 100)
    """Range of n, the depot included; drawn once per batch."""
    n_agents: tuple[int, int] = (5, 10)
    """Range of m; drawn once per batch."""
    nodes_per_agent: int = 1
    """At least so many nodes for each agent: the upper end of m's range falls with n."""
    distribution: str = "uniform"
    speed: float = 0.1
    """Distance per tick, the paper's Delta g."""
    depot: Literal["open", "final"] = "open"
    """Whether an agent that is back at the depot may leave again."""

    network: DANConfig = field(default_factory=DANConfig.paper)
    policy: str | None = None
    """A network of your own instead of a DAN: package.module:factory, called without arguments."""
    init: str | None = None
    """Weights to start from: a file, or the name of a shipped model (its configuration replaces `network`)."""
    prune_visited: bool | None = None
    """Whether the DAN of `init` drops visited cities before its encoders from now on, with the same weights. None: as
    its file says."""
    max_grad_norm: float = 1.0
    average: float = 0.0
    """Decay of the running average of the weights, which is what is validated and saved. 0: the weights as they are."""

    validation_instances: int = 256
    """Held-out instances (the same in every run) for the reported cost and for `best.safetensors`."""
    validate_every: int = 128
    checkpoint_every: int = 128

    precision: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 autocast pays on GPUs and on CPUs with AMX or AVX-512 BF16."""
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
        self._check_at_least(1, "steps", "nodes_per_agent", "validate_every", "checkpoint_every")
        self._check_at_least(2, "validation_instances")
        self._check_positive("max_grad_norm", "speed")
        if self.prune_visited is not None and (self.init is None or self.policy is not None):
            raise ValueError(f"prune_visited must be None but for a DAN from init, got {self.prune_visited}")
        if not 0 <= self.average < 1:
            raise ValueError(f"average must be at least 0 and below 1, got {self.average!r}")
        if self.n_agents[0] * self.nodes_per_agent > self.n_nodes[0]:
            raise ValueError(
                f"nodes_per_agent must be at most n_nodes[0] // n_agents[0] = {self.n_nodes[0] // self.n_agents[0]}, "
                f"got {self.nodes_per_agent}"
            )
        check_distribution(self.distribution)

    def _check_at_least(self, minimum: int, *names: str) -> None:
        for name in names:
            check_count(name, getattr(self, name), minimum)

    def _check_positive(self, *names: str) -> None:
        for name in names:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)!r}")

    def to_dict(self) -> dict:
        """The configuration as JSON values."""
        return json.loads(json.dumps(asdict(self), default=str))


@dataclass(frozen=True, kw_only=True)
class ReinforceConfig(RunConfig):
    """REINFORCE with a greedy rollout baseline (paper, Sec. 5.1).

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/reinforce")
    """Folder for checkpoint, weights and logs."""
    batch_size: int = 8
    """Instances per optimiser step, for each process."""
    batch_tokens: int | None = None
    """Instances times nodes per optimiser step, at most: larger instances come in smaller batches. None: no bound."""
    curriculum: tuple[tuple[int, int, int, int, int], ...] = ()
    """Later ranges: from step, least n, greatest n, least m, greatest m. Five numbers for each stage."""

    collector: Literal["here", "ray"] = "here"
    """here: this process plays the episodes. ray: Ray workers do, on this machine or on a cluster (RAY_ADDRESS)."""
    ray_workers: int = 2
    """Ray: how many, each playing `batch_size` instances for every optimiser step."""

    baseline: Literal["rollout", "shared"] = "rollout"
    """rollout: the best policy so far, greedily (the paper). shared: the other samples of the same instance."""
    samples: int = 1
    """Episodes of each instance; for `shared` at least 2, each seen in another rotation or reflection."""
    normalise: bool = False
    """Divide advantages by their standard deviation over the batch."""

    learning_rate: float = 1e-5
    decay: float = 0.96
    """Factor on the learning rate every `decay_every` steps."""
    decay_every: int = 1024

    challenge_every: int = 128
    """Steps between challenges of the baseline."""
    challenge_instances: int = 512
    """Fresh instances that the baseline is tested on."""
    challenge_p: float = 0.05
    """One-sided paired t-test: the policy replaces the baseline below this p."""

    decisions: float = 1.0
    """Share of a batch's decisions that its gradient is estimated from, drawn at random. Fewer make a step shorter, and
    its gradient noisier: the variance is up to one over the share of what all of them would give."""
    chunk: int = 512
    """Decisions whose log-probabilities are recomputed at once: the bound on memory."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_at_least(1, "batch_size", "chunk", "decay_every", "challenge_every", "ray_workers")
        self._check_at_least(2, "challenge_instances")
        self._check_at_least(2 if self.baseline == "shared" else 1, "samples")
        self._check_positive("learning_rate", "decay")
        if self.batch_tokens is not None:
            self._check_at_least(1, "batch_tokens")
        for first, *ranges in self.curriculum:
            check_count("curriculum: from step", first, 0)
            replace(self, curriculum=(), n_nodes=tuple(ranges[:2]), n_agents=tuple(ranges[2:]))
        if not 0 < self.decisions <= 1:
            raise ValueError(f"decisions must be above 0 and at most 1, got {self.decisions!r}")
        if not 0 < self.challenge_p < 1:
            raise ValueError(f"challenge_p must lie between 0 and 1, got {self.challenge_p!r}")

    def at(self, step: int) -> ReinforceConfig:
        """The configuration with the ranges that hold at ``step``."""
        begun = [ranges for first, *ranges in self.curriculum if first <= step]
        if not begun:
            return self
        return replace(self, curriculum=(), n_nodes=tuple(begun[-1][:2]), n_agents=tuple(begun[-1][2:]))


@dataclass(frozen=True, kw_only=True)
class ImitateConfig(RunConfig):
    """Imitation of the reference solver: a warm start for REINFORCE, or a policy of its own.

    A *set* is a batch of instances of one (n, m) with the teacher's tours; a *row* is all of a set's decisions at one
    index, rectangular after pruning. An optimiser step takes `rows` rows of as many sets, chosen at random among
    `buffer` sets, so that it mixes sizes and phases of the game.

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/imitate")
    """Folder for checkpoint, weights and logs."""
    steps: int = 20_000
    """Optimiser steps in all; the learning rate reaches its end with them."""
    n_nodes: tuple[int, int] = (20, 200)
    """Range of n, the depot included; drawn once per set."""
    n_agents: tuple[int, int] = (2, 20)
    """Range of m; drawn once per set."""
    nodes_per_agent: int = 5
    """At least so many nodes for each agent: the upper end of m's range falls with n."""
    speed: float = 0.01
    """Distance per tick, the paper's Delta g (in its tests)."""
    depot: Literal["final"] = "final"
    """Whether an agent that is back at the depot may leave again: the teacher's never do."""
    network: DANConfig = field(default_factory=lambda: DANConfig(prune_visited=True))

    set_tokens: int = 8192
    """Instances times nodes of a set, at most: it has the greatest power of two that allows, between 16 and 256."""
    buffer: int = 16
    """Sets that are learnt from at a time."""
    passes: float = 1.0
    """Share of a set's decision indices that are learnt from before it gives way to a fresh one, at most 1."""
    roll_in: str | None = None
    """Weights of a student, a file or a shipped model's name, that plays the beginning of each game, for a random
    number of decisions; the teacher shows how to go on from there (DAgger), and the next decisions are learnt from, the
    share `passes` of a set's. None: the teacher plays all of it."""
    rows: int = 4
    """Rows per optimiser step."""
    teacher_iterations: int = 80
    """Iterations of the reference solver for each node of an instance."""
    workers: int = 1
    """Processes that make sets while the network learns; 0: the learning process makes them itself, in between."""

    learning_rate: float = 5e-4
    """Peak, after a linear warm-up; falls along half a cosine to `final_rate` of it."""
    final_rate: float = 0.02
    warmup: int = 200
    """Steps of the warm-up."""
    weight_decay: float = 0.01
    """AdamW's."""
    average: float = 0.999
    validate_every: int = 500
    checkpoint_every: int = 500

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_at_least(1, "set_tokens", "buffer", "rows", "teacher_iterations", "warmup")
        self._check_at_least(0, "workers")
        self._check_positive("learning_rate")
        if self.depot != "final":
            raise ValueError(f"depot must be 'final' (the teacher's agents never leave twice), got {self.depot!r}")
        if self.n_nodes[0] <= self.n_agents[0]:
            raise ValueError(f"n_nodes[0] must be above n_agents[0]={self.n_agents[0]}, got {self.n_nodes[0]}")
        if self.rows > self.buffer:
            raise ValueError(f"rows must be at most buffer={self.buffer}, got {self.rows}")
        if not 0 < self.passes <= 1:
            raise ValueError(f"passes must be above 0 and at most 1, got {self.passes!r}")
        if not 0 < self.final_rate <= 1:
            raise ValueError(f"final_rate must be above 0 and at most 1, got {self.final_rate!r}")
        if not self.weight_decay >= 0:
            raise ValueError(f"weight_decay must be at least 0, got {self.weight_decay!r}")


def check_same_run(old: dict, config: RunConfig) -> None:
    """Raise ValueError where ``config`` would change what an interrupted run was training.

    Options that are younger than its checkpoint had their default.
    """
    new, default = config.to_dict(), type(config)().to_dict()
    old = default | old | {"network": asdict(DANConfig()) | old["network"]}
    changed = [k for k in new if k not in FREE_ON_RESUME and old[k] != new[k]]
    if changed:
        said = ", ".join(f"{k} was {old[k]!r}, is {new[k]!r}" for k in changed)
        raise ValueError(f"a resumed run keeps its configuration: {said}")
