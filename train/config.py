"""The options that every kind of training has; each is a field with its documentation below it."""

from __future__ import annotations

import json
import pkgutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from dan_policy.dan import DANConfig
from dan_policy.joint import JointConfig
from dan_policy.registry import NETWORKS
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.distributions import Generator, check_distribution, check_scenario

OVERRIDES = ("prune_visited", "reads", "distances", "polar", "confidence")
"""Options of a network that a run may change in the weights of ``init``."""


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
    depot: Literal["open", "wait", "final"] = "open"
    """Whether an agent that has returned to the depot has finished (final) or may leave it again: it is asked again at
    the next tick (open), or when something happens (wait)."""
    scenario: tuple[str, ...] = ("plain",)
    """The worlds to train in: names of scenarios, or package.module:function. Each batch draws one of them."""
    world_depot: Literal["open", "wait"] = "wait"
    """The depot rule in scenarios other than plain: an agent that stays at the depot is asked again at the next tick
    (open), or when something happens (wait)."""

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
    reads: tuple[str, ...] | None = None
    """With `init`: override which extra keys of observations in worlds the network reads. New ones have no effect
    before they are learnt."""
    distances: bool | None = None
    """With `init`: override whether the attention and the logits of the joint network depend on distances. At first
    they have no effect."""
    polar: bool | None = None
    """With `init`: override whether the tokens of the joint network know their distance from the decider, and their
    distance and direction from the depot. At first this has no effect."""
    confidence: float | None = None
    """With `init`: override how certain what the joint network foresees for other agents must be for `solve` to act on
    it. It changes no weights."""
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
    """bfloat16 autocast is faster on GPUs and on CPUs with AMX or AMD's AVX-512 BF16."""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""
    threads: int | None = None
    """Number of CPU threads that PyTorch uses. None: PyTorch's default."""
    compile: bool = False
    """Run the network's attention layers through torch.compile, which needs a C++ compiler: steps take less time, but
    the first ones wait for it. A run that is resumed may round differently."""
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
        if not self.scenario:
            raise ValueError("scenario must name at least 1 world, such as 'plain'")
        for name in self.scenario:
            check_scenario(self.world(name))

    def _check_policy(self) -> None:
        if not self.registered and ":" not in self.policy:
            raise ValueError(f"policy must be package.module:factory or one of {sorted(NETWORKS)}, got {self.policy!r}")
        if self.registered and self.policy_options:
            raise ValueError(f"policy_options must be empty for the policy {self.policy!r}, got {self.policy_options}")
        for name in OVERRIDES:
            value = getattr(self, name)
            if value is not None and (self.init is None or not self.registered):
                raise ValueError(f"{name} must be None unless a registered policy starts from init, got {value}")

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
        """The registered network's configuration (its defaults if it has no field here), or the factory's arguments."""
        if not self.registered:
            return dict(self.policy_options)
        kind = NETWORKS[self.policy].config
        return asdict(next((value for value in vars(self).values() if type(value) is kind), kind()))

    def generator(self) -> str | Generator:
        """The name of a distribution, or the function that ``package.module:function`` names.

        Raises:
            ValueError: there is no such function.
        """
        return _generator("distribution", self.distribution)

    def world(self, scenario: str) -> str | Generator:
        """The name of a scenario, or the function that ``package.module:function`` names. Raises as ``generator``."""
        return _generator("scenario", scenario)

    def to_dict(self) -> dict[str, Any]:
        """The configuration as JSON values."""
        return json.loads(json.dumps(asdict(self), default=str))


def _generator(option: str, name: str) -> str | Generator:
    if ":" not in name:
        return name
    try:
        return pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{option}={name!r} cannot be imported ({error})") from error
