"""The options of REINFORCE; each is a field with its documentation below it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from mtsp_env.checks import check_count
from train.config import RunConfig


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
    warmup: int = 0
    """Steps in which the learning rate rises linearly at the beginning, for weights that were trained before."""

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
        self._check_at_least(0, "warmup")
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
