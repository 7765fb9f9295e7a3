"""What the ablations compare: networks, what they are taught, and in which stages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from train.optimisers import OptimiserName

Stage = Literal["imitate", "reinforce", "rollout", "improve", "regrets"]
"""A kind of training: imitation of the reference solver; REINFORCE with the other samples of an instance as its
baseline, or with the greedy rollout baseline; self-improvement; imitation with the labels ``regrets``."""


@dataclass(frozen=True)
class Budget:
    """How long a variant or one of its stages is trained.

    Steps give every variant the same labelled instances, however fast the machine is; minutes include the labelling.
    """

    amount: float
    unit: Literal["minutes", "steps"] = "minutes"

    def __str__(self) -> str:
        return f"{self.number}-{self.unit}"

    @property
    def number(self) -> str:
        """The amount without rounding errors such as those of 0.7 * 60."""
        return f"{self.amount:.12g}"

    def part(self, share: float) -> Budget:
        """That share of it."""
        return replace(self, amount=share * self.amount)


@dataclass(frozen=True)
class Variant:
    """A network and how it is trained.

    Attributes:
        name: its name in the table.
        stages: kinds of training, one after the other, each with its share of the budget.
        network: differences from the shipped configuration of the network, for the policies dan and joint.
        policy: the network, as ``RunConfig.policy`` takes it.
        next_weight: weight of the other agents' next nodes in the loss of what imitates tours.
        assignment_weight: weight of each city's visitor in that loss.
        optimiser: the optimiser of what imitates tours.
    """

    name: str
    stages: tuple[tuple[Stage, float], ...] = (("imitate", 1.0),)
    network: dict[str, Any] = field(default_factory=dict)
    policy: str = "dan"
    next_weight: float = 0.0
    assignment_weight: float = 0.0
    optimiser: OptimiserName = "adamw"

    @property
    def learner(self) -> str:
        """A folder's name that tells variants apart that do not learn the same in the same stage."""
        options = [f"{name}-{value}" for name, value in sorted(self.network.items())]
        weights = [f"next-{self.next_weight:g}", f"assignment-{self.assignment_weight:g}"]
        return "_".join([self.policy.rpartition(":")[2], *options, *weights, self.optimiser])


_TAUGHT_THEN_REFINED: tuple[tuple[Stage, float], ...] = (("imitate", 0.7), ("reinforce", 0.3))
_DAN = Variant("", _TAUGHT_THEN_REFINED)

DAN_VARIANTS = (
    replace(_DAN, name="as shipped: imitation, then REINFORCE"),
    replace(_DAN, name="imitation alone", stages=(("imitate", 1.0),)),
    replace(_DAN, name="REINFORCE alone", stages=(("reinforce", 1.0),)),
    replace(_DAN, name="visited cities not pruned", network={"prune_visited": False}),
    replace(_DAN, name="one layer in the city encoder", network={"city_layers": 1}),
    replace(_DAN, name="no agent encoder", network={"agent_layers": 0}),
    replace(_DAN, name="no city-agent encoder", network={"city_agent_layers": 0}),
    replace(_DAN, name="neither agent nor city-agent encoder", network={"agent_layers": 0, "city_agent_layers": 0}),
    replace(
        _DAN,
        name="attention model (Kool et al. 2019)",
        policy="benchmarks.policies.attention_model:AttentionModel",
    ),
)

_JOINT = Variant("joint", policy="joint", next_weight=0.5, assignment_weight=1.0)

DENSE_LABELS = (
    Variant("DAN"),
    Variant("DAN, agent of every city", network={"assignment": True}, assignment_weight=1.0),
    replace(_JOINT, name="joint", next_weight=0.0, assignment_weight=0.0),
    replace(_JOINT, name="joint, next node of every agent", assignment_weight=0.0),
    replace(_JOINT, name="joint, agent of every city", next_weight=0.0),
    replace(_JOINT, name="joint, both"),
)

JOINT_VARIANTS = (
    _JOINT,
    replace(_JOINT, name="joint, distances", network={"distances": True}),
    replace(_JOINT, name="joint, distances, polar coordinates", network={"distances": True, "polar": True}),
    replace(_JOINT, name="joint, Muon", optimiser="muon"),
    replace(_JOINT, name="joint, distances, Muon", network={"distances": True}, optimiser="muon"),
)

REFINEMENTS = (
    replace(_JOINT, name="imitation alone"),
    replace(_JOINT, name="then REINFORCE, shared baseline", stages=_TAUGHT_THEN_REFINED),
    replace(_JOINT, name="then REINFORCE, rollout baseline", stages=(("imitate", 0.7), ("rollout", 0.3))),
    replace(_JOINT, name="then self-improvement", stages=(("imitate", 0.7), ("improve", 0.3))),
    replace(_JOINT, name="then regrets", stages=(("imitate", 0.7), ("regrets", 0.3))),
)

Study = Literal["dan", "dense-labels", "joint", "refinement"]
STUDIES: dict[Study, tuple[Variant, ...]] = {
    "dan": DAN_VARIANTS,
    "dense-labels": DENSE_LABELS,
    "joint": JOINT_VARIANTS,
    "refinement": REFINEMENTS,
}
NOTES: dict[Study, str] = {
    "dan": "70 % imitation and 30 % REINFORCE, unless its name says otherwise",
    "dense-labels": "imitation alone. The labels are the next node of the deciding agent and what the name says",
    "joint": "imitation alone. The labels are the next node of every agent and the agent of every city; the optimiser "
    "is AdamW unless the name says otherwise",
    "refinement": "the joint network, 70 % imitation and 30 % what the name says. The labels of imitation are the next "
    "node of every agent and the agent of every city",
}
