"""Every option of a training run, in one place."""

from __future__ import annotations

import json
import math
import pkgutil
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from dan_policy.dan import DANConfig
from dan_policy.joint import JointConfig
from dan_policy.registry import NETWORKS
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.distributions import Generator, check_distribution


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What every kind of training has: where it writes, what it trains, on which instances, when it validates.

    The options of a registered network stand in a field of their own whose type is the network's configuration
    (``network`` for "dan"); to add another network's, add one field.

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/train")
    """Folder for the checkpoint, weights and logs."""
    resume: bool = False
    """Continue from the checkpoint in `out`, bit for bit as if the run had never stopped."""
    seed: int = 0
    """Seed of the weights, the instances and the sampled actions."""
    steps: int = 100_000
    """Total number of optimiser steps."""
    seconds: float | None = None
    """Stop and save after this many more seconds of training and validation, even before `steps` are reached."""

    n_nodes: tuple[int, int] = (20, 100)
    """Range of n, the depot included. Each batch draws one n."""
    n_agents: tuple[int, int] = (5, 10)
    """Range of m. Each batch draws one m."""
    nodes_per_agent: int = 1
    """Least number of nodes per agent: it lowers the upper end of m's range for small n."""
    distribution: str = "uniform"
    """How instances are drawn: uniform, clustered, or package.module:function for a generator of your own."""
    speed: float = 0.1
    """Distance per tick, the paper's Delta g."""
    depot: Literal["open", "final"] = "open"
    """Whether an agent that has returned to the depot may leave it again (open) or has finished (final)."""

    policy: str = "dan"
    """The network to train: a registered name, or package.module:factory. The working directory is importable."""
    policy_options: dict[str, int | float | bool | str] = field(default_factory=dict, hash=False)
    """Keyword arguments of the factory: NAME VALUE NAME VALUE ..."""
    network: DANConfig = field(default_factory=DANConfig.paper)
    """Options of the policy dan."""
    joint: JointConfig = field(default_factory=JointConfig)
    """Options of the policy joint."""
    init: str | None = None
    """Weights to start from: a file, or the name of a shipped model. A registered network takes its options from it."""
    prune_visited: bool | None = None
    """With `init`: override whether the network drops visited cities before its encoders. Its weights stay the same."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this norm if theirs is larger."""
    average: float = 0.0
    """Decay of the running average of the weights, which is what is validated and saved. 0 disables averaging."""

    validation_instances: int = 256
    """Number of held-out instances (the same in every run) for the reported cost and for `best.safetensors`."""
    validate_every: int = 128
    """Steps between validations."""
    checkpoint_every: int = 128
    """Steps between checkpoints."""

    precision: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 autocast is faster on GPUs and on CPUs with AMX or AVX-512 BF16."""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""
    threads: int | None = None
    """Number of CPU threads that PyTorch uses. None: PyTorch's default."""
    tensorboard: bool = True
    """Write TensorBoard logs as well as CSV files."""

    def __post_init__(self) -> None:
        for name, minimum in (("n_nodes", 2), ("n_agents", 1)):
            low, high = getattr(self, name)
            check_count(f"{name}[0]", low, minimum)
            check_count(f"{name}[1]", high, low)
        self._check_at_least(1, "steps", "nodes_per_agent", "validate_every", "checkpoint_every")
        self._check_at_least(2, "validation_instances")
        self._check_positive("max_grad_norm", "speed")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"seed must be at least 0 and below 2^63, got {self.seed!r}")
        if self.threads is not None and not 1 <= self.threads <= 1024:  # far more would crash PyTorch
            raise ValueError(f"threads must be None or from 1 to 1024, got {self.threads!r}")
        if self.seconds is not None:
            check_seconds("seconds", self.seconds)
        self._check_policy()
        if not 0 <= self.average < 1:
            raise ValueError(f"average must be at least 0 and below 1, got {self.average!r}")
        if self.n_agents[0] * self.nodes_per_agent > self.n_nodes[0]:
            raise ValueError(
                f"nodes_per_agent must be at most n_nodes[0] // n_agents[0] = {self.n_nodes[0] // self.n_agents[0]}, "
                f"got {self.nodes_per_agent}"
            )
        check_distribution(self.generator())

    def _check_policy(self) -> None:
        if not self.registered and ":" not in self.policy:
            raise ValueError(f"policy must be package.module:factory or one of {sorted(NETWORKS)}, got {self.policy!r}")
        if self.registered and self.policy_options:
            raise ValueError(f"policy_options must be empty for the policy {self.policy!r}, got {self.policy_options}")
        if self.prune_visited is not None and (self.init is None or not self.registered):
            raise ValueError(
                f"prune_visited must be None unless a registered policy starts from init, got {self.prune_visited}"
            )

    def _check_at_least(self, minimum: int, *names: str) -> None:
        for name in names:
            check_count(name, getattr(self, name), minimum)

    def _check_positive(self, *names: str) -> None:
        for name in names:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)!r}")

    def _check_share(self, *names: str) -> None:
        for name in names:
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} must be above 0 and at most 1, got {getattr(self, name)!r}")

    @property
    def registered(self) -> bool:
        """Whether ``policy`` is a registered name rather than a factory."""
        return self.policy in NETWORKS

    def network_options(self) -> dict[str, Any]:
        """The registered network's configuration, or the factory's keyword arguments."""
        if not self.registered:
            return dict(self.policy_options)
        options = {type(value): value for value in vars(self).values()}
        return asdict(options[NETWORKS[self.policy].config])

    def generator(self) -> str | Generator:
        """The name of a distribution, or the function that ``package.module:function`` names.

        Raises:
            ValueError: there is no such function.
        """
        if ":" not in self.distribution:
            return self.distribution
        try:
            return pkgutil.resolve_name(self.distribution)
        except (ImportError, AttributeError, ValueError) as error:
            raise ValueError(f"distribution={self.distribution!r} cannot be imported ({error})") from error

    def to_dict(self) -> dict[str, Any]:
        """The configuration as JSON values."""
        return json.loads(json.dumps(asdict(self), default=str))


@dataclass(frozen=True, kw_only=True)
class ReinforceConfig(RunConfig):
    """REINFORCE with a greedy rollout baseline (paper, Sec. 5.1).

    Raises:
        ValueError: a value outside its range.
    """

    out: Path = Path("runs/reinforce")
    """Folder for the checkpoint, weights and logs."""
    batch_size: int = 8
    """Number of instances per optimiser step and process."""
    batch_tokens: int | None = None
    """Upper bound on instances times nodes per optimiser step: larger instances come in smaller batches."""
    curriculum: tuple[tuple[int, int, int, int, int], ...] = ()
    """Later ranges, five numbers per stage: first step, least n, greatest n, least m, greatest m."""

    collector: Literal["here", "ray"] = "here"
    """Who plays the episodes: this process (here), or Ray workers on this machine or a cluster (RAY_ADDRESS)."""
    ray_workers: int = 2
    """Number of Ray workers. Each plays `batch_size` instances per optimiser step."""

    baseline: Literal["rollout", "shared"] = "rollout"
    """rollout: the best policy so far, played greedily (the paper). shared: the other samples of the same instance."""
    samples: int = 1
    """Episodes per instance, each in another rotation or reflection. `shared` needs at least 2."""
    normalise: bool = False
    """Divide advantages by their standard deviation over the batch."""

    learning_rate: float = 1e-5
    """Adam's, at the beginning."""
    decay: float = 0.96
    """Factor on the learning rate every `decay_every` steps."""
    decay_every: int = 1024
    """Steps between two decays of the learning rate."""

    challenge_every: int = 128
    """Steps between challenges of the baseline."""
    challenge_instances: int = 512
    """Number of fresh instances on which a challenge compares the policy with the baseline."""
    challenge_p: float = 0.05
    """The policy replaces the baseline if a one-sided paired t-test gives a p below this."""

    decisions: float = 1.0
    """Share of a batch's decisions, drawn at random, that the gradient is estimated from. A smaller share makes steps
    shorter and gradients noisier: their variance grows at most in inverse proportion to the share."""
    chunk: int = 512
    """Number of decisions whose log-probabilities are computed at once. It bounds the memory."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_at_least(1, "batch_size", "chunk", "decay_every", "challenge_every", "ray_workers")
        self._check_at_least(2, "challenge_instances")
        self._check_at_least(2 if self.baseline == "shared" else 1, "samples")
        self._check_share("learning_rate", "decay")
        if self.batch_tokens is not None:
            self._check_at_least(1, "batch_tokens")
        for stage in self.curriculum:
            check_count("curriculum: first step", stage[0], 0)
            self._at_stage(stage)  # which checks the ranges
        self._check_share("decisions")
        if self.normalise:
            self._check_normalised()
        if not 0 < self.challenge_p < 1:
            raise ValueError(f"challenge_p must lie between 0 and 1, got {self.challenge_p!r}")

    def _check_normalised(self) -> None:
        """A single episode has no standard deviation."""
        greatest_n = max([self.n_nodes[1], *(stage[2] for stage in self.curriculum)])
        least_batch = min(self.batch_size, (self.batch_tokens or self.batch_size * greatest_n) // greatest_n)
        if max(1, least_batch) * self.samples < 2:
            raise ValueError(
                f"normalise needs at least 2 episodes per step: raise batch_size={self.batch_size}, "
                f"batch_tokens={self.batch_tokens} or samples={self.samples}"
            )

    def at(self, step: int) -> ReinforceConfig:
        """The configuration with the ranges of the curriculum's stage at ``step``."""
        begun = [stage for stage in self.curriculum if stage[0] <= step]
        return self._at_stage(begun[-1]) if begun else self

    def _at_stage(self, stage: tuple[int, int, int, int, int]) -> ReinforceConfig:
        _, least_n, greatest_n, least_m, greatest_m = stage
        return replace(self, curriculum=(), n_nodes=(least_n, greatest_n), n_agents=(least_m, greatest_m))


@dataclass(frozen=True, kw_only=True)
class ImitateConfig(RunConfig):
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
    n_nodes: tuple[int, int] = (20, 200)
    """Range of n, the depot included. Each set draws one n."""
    n_agents: tuple[int, int] = (2, 20)
    """Range of m. Each set draws one m."""
    nodes_per_agent: int = 5
    """Least number of nodes per agent: it lowers the upper end of m's range for small n."""
    speed: float = 0.01
    """Distance per tick, the paper's Delta g (in its tests)."""
    depot: Literal["final"] = "final"
    """An agent that has returned to the depot has finished: the teacher's agents never leave twice."""
    network: DANConfig = field(default_factory=lambda: DANConfig(prune_visited=True))
    """Options of the policy dan."""

    set_tokens: int = 8192
    """Upper bound on instances times nodes of a set. The number of instances is a power of two from 16 to 256."""
    buffer: int = 16
    """Number of sets to draw from at a time."""
    passes: float = 1.0
    """Share of a set's decision indices that are used before a fresh set replaces it, at most 1."""
    roll_in: str | None = None
    """Weights of a student (a file, or a shipped model's name) that plays a random number of decisions at the beginning
    of each game; the teacher shows how to continue (DAgger), and the next decisions are learnt from, a share `passes`
    of the set's. None: the teacher plays whole games."""
    sets_per_step: int = 4
    """Number of sets that an optimiser step takes decisions from."""
    teacher_iterations: int = 80
    """Iterations of the reference solver per node of an instance."""
    workers: int = 1
    """Processes that prepare sets while the network learns. 0: the learning process prepares them itself."""

    learning_rate: float = 5e-4
    """Peak of AdamW's learning rate, after a linear warm-up; then it falls along half a cosine."""
    final_rate: float = 0.02
    """Final learning rate as a share of the peak."""
    warmup: int = 200
    """Steps of the warm-up."""
    weight_decay: float = 0.01
    """AdamW's weight decay."""
    anneal_seconds: float | None = None
    """The learning rate reaches its final value after this many seconds of training, even before `steps` are reached.
    Such a run follows the clock, and does not resume bit for bit."""
    next_weight: float = 0.5
    """Weight in the loss of every other agent's next node in the teacher's plan. 0: only the deciding agent's. Without
    effect on networks that have no such output (`forward_dense`), such as DAN."""
    assignment_weight: float = 1.0
    """Weight in the loss of which agent visits each city in the teacher's plan. 0: not learnt. Without effect on
    networks that have no such output."""
    average: float = 0.999
    """Decay of the running average of the weights, which is what is validated and saved. 0 disables averaging."""
    validate_every: int = 500
    """Steps between validations."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_at_least(1, "set_tokens", "buffer", "sets_per_step", "teacher_iterations", "warmup")
        self._check_at_least(0, "workers")
        self._check_share("learning_rate")
        if self.depot != "final":
            raise ValueError(f"depot must be 'final' (the teacher's agents never leave twice), got {self.depot!r}")
        if self.n_nodes[0] <= self.n_agents[0]:
            raise ValueError(f"n_nodes[0] must be above n_agents[0]={self.n_agents[0]}, got {self.n_nodes[0]}")
        if self.sets_per_step > self.buffer:
            raise ValueError(f"sets_per_step must be at most buffer={self.buffer}, got {self.sets_per_step}")
        self._check_share("passes", "final_rate")
        for name in ("weight_decay", "next_weight", "assignment_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and at least 0, got {getattr(self, name)!r}")
        if self.anneal_seconds is not None:
            check_seconds("anneal_seconds", self.anneal_seconds)
