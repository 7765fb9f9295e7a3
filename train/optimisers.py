"""The optimisers of imitation: AdamW for all parameters, or Muon for the matrices of the hidden layers."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import nn
from torch.optim import AdamW, Muon, Optimizer

from dan_policy.layers import AttentionLayer

OptimiserName = Literal["adamw", "muon"]

HIDDEN_LAYERS = (AttentionLayer, nn.MultiheadAttention, nn.TransformerEncoderLayer, nn.TransformerDecoderLayer)
"""Modules whose matrices Muon optimises. Embeddings of coordinates and the output layers are left to AdamW."""


def make_optimiser(name: OptimiserName, network: nn.Module, learning_rate: float, weight_decay: float) -> Optimizer:
    """The optimiser of all parameters of a network.

    Muon (Jordan et al. 2024) takes the nearest semi-orthogonal matrix to each matrix's momentum as its step, so that
    all directions of a layer are learnt equally fast. Its steps are scaled to the size of AdamW's (Liu et al. 2025,
    "Muon is scalable for LLM training"), so that both use the same learning rate and weight decay.

    Args:
        name: "adamw", or "muon" for Muon on the matrices of ``HIDDEN_LAYERS`` and AdamW on all other parameters.
        network: the network.
        learning_rate: learning rate of all parameters.
        weight_decay: weight decay of all parameters, decoupled from the gradient.

    Raises:
        ValueError: "muon" for a network without hidden layers of these kinds.
    """
    if name == "adamw":
        return AdamW(network.parameters(), lr=learning_rate, weight_decay=weight_decay)
    matrices = hidden_matrices(network)
    taken = set(matrices)
    others = [parameter for parameter in network.parameters() if parameter not in taken]
    muon = Muon(matrices, lr=learning_rate, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")
    return CombinedOptimiser(muon=muon, adamw=AdamW(others, lr=learning_rate, weight_decay=weight_decay))


def hidden_layers(network: nn.Module, option: str) -> list[nn.Module]:
    """The network's layers of the kinds in ``HIDDEN_LAYERS``, in its order.

    Raises:
        ValueError: there are none; the message says that ``option`` needs them.
    """
    layers = [module for module in network.modules() if isinstance(module, HIDDEN_LAYERS)]
    if not layers:
        kinds = [kind.__name__ for kind in HIDDEN_LAYERS]
        raise ValueError(f"{option} needs a network with layers of {kinds}, got {type(network).__name__}")
    return layers


def hidden_matrices(network: nn.Module) -> list[nn.Parameter]:
    """The parameters with two dimensions inside ``hidden_layers``, each once, in the order of the network."""
    layers = hidden_layers(network, "optimiser='muon'")
    inside = {parameter for layer in layers for parameter in layer.parameters() if parameter.ndim == 2}
    return [parameter for parameter in network.parameters() if parameter in inside]


class CombinedOptimiser(Optimizer):
    """Several optimisers of different parameters that step together and follow one learning-rate schedule.

    Args:
        **optimisers: the optimisers by the names that their states have in ``state_dict``.
    """

    def __init__(self, **optimisers: Optimizer):
        self.optimisers = optimisers
        super().__init__(self._groups(), {})  # the same dicts, so that a schedule reaches every optimiser

    def _groups(self) -> list[dict[str, Any]]:
        return [group for optimiser in self.optimisers.values() for group in optimiser.param_groups]

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """Take one step with each optimiser. A closure, which would have to be called once per optimiser, is refused.

        Raises:
            ValueError: ``closure`` is not None.
        """
        if closure is not None:
            raise ValueError(f"closure must be None, got {closure!r}")
        for optimiser in self.optimisers.values():
            optimiser.step()

    def state_dict(self) -> dict[str, Any]:
        """Each optimiser's state by its name."""
        return {name: optimiser.state_dict() for name, optimiser in self.optimisers.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state_dict[name])
        self.param_groups = self._groups()  # loading has replaced them
