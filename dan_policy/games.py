"""Games of one instance side by side, played by any policy, as ``solve`` needs them.

``episode.rollout`` samples from torch's global generator and sets TorchRL's exploration type, both of which belong to
the whole process. This loop draws from a generator that it is given and sets nothing, so that threads do not disturb
each other. On a CPU the rules run in NumPy, which is faster than torch for arrays of these sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from dan_policy.layers import padded_length
from dan_policy.network import Key, Network, check_greatest, is_actor, network_keys
from dan_policy.symmetry import views
from mtsp_env import rules
from mtsp_env.arrays import library, locate, pick
from mtsp_env.instance import Array, Instance, Problem, Tours, batch

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

Logits = Callable[[rules.State, rules.Observation], Tensor]
"""What the deciding agents see, and the state of their games -> logits (B, n)."""

Choose = Callable[[rules.State, rules.Observation], Array]
"""The same -> actions (B,), each legal."""


def begin(
    instance: Instance,
    game: rules.Rules,
    prefixes: Sequence[Sequence[int]] = (),
    rows: int = 1,
    augment: bool = False,
    device: torch.device | str = "cpu",
) -> rules.State:
    """``rows`` times the moment at which all ``prefixes`` are driven, by the game's own rules and clock.

    Args:
        instance: the problem.
        game: its rules.
        prefixes: the beginning of each agent's tour (``mtsp_env.tours.check_prefixes``); none: all are at the depot.
        rows: number of games.
        augment: the i-th game sees the instance in the square's symmetry i modulo 8.
        device: "cpu" gives NumPy arrays, others torch tensors.
    """
    problem = batch([instance] * rows)
    if augment:
        nodes = views(torch.tensor(instance.nodes), rows).numpy()  # (rows, n, 2)
        problem = Problem(problem.n_agents, {**problem.arrays, "nodes": nodes})
    state, left = rules.start(problem, game), [list(prefix[1:]) for prefix in prefixes]
    while any(left):
        agent = min((a for a in range(len(left)) if left[a]), key=lambda a: (state.ready[0, a], a))
        action, *left[agent] = left[agent]
        state = rules.depart(state, game, np.full(rows, action), np.full(rows, agent))
    if torch.device(device).type == "cpu":
        return state
    tensors = {name: torch.as_tensor(array, device=device) for name, array in state.arrays().items()}
    return rules.state_from_arrays(tensors, instance.n_agents)


@torch.no_grad()
def play(
    policy: Network | TensorDictModuleBase,
    state: rules.State,
    game: rules.Rules,
    generator: torch.Generator | None = None,
    sharpness: float = 1.0,
) -> rules.State:
    """The state at the end of the games that ``policy`` plays from ``state``.

    A network with ``forward_next`` and a ``config.confidence`` makes fewer forward passes (``_foreseen_logits``).

    Args:
        policy: a network, or an actor that reads the observation and writes ``action``.
        state: one game per row, by the depot rule "final", so that every game ends.
        game: the rules.
        generator: on the state's device; actions are drawn from it. None takes the likeliest actions.
        sharpness: how many times as large the policy's logits are as those that it was trained with.

    Raises:
        ValueError: as ``chooser`` says.
    """
    confidence = getattr(getattr(policy, "config", None), "confidence", None)
    if confidence is not None and hasattr(policy, "forward_next"):
        choose = _choose(_foreseen_logits(policy, confidence, sharpness), generator)
    else:
        choose = chooser(policy, generator)
    while not rules.terminated(state).all():
        state = rules.depart(state, game, choose(state, rules.observe(state, game)))
    return state


def chooser(policy: Network | TensorDictModuleBase, generator: torch.Generator | None = None) -> Choose:
    """A policy as a function of the state of B games and of what their deciding agents see.

    It returns legal actions (B,), as a NumPy array if the games are made of NumPy arrays. Arguments as for ``play``.

    Raises:
        ValueError: when it is called: a policy that reads unknown keys, whose logits have a wrong shape or are not
            numbers, or that writes an illegal action.
    """
    return _choose(_logits_of(policy), generator)


def _choose(logits_of: Logits, generator: torch.Generator | None) -> Choose:
    @torch.no_grad()
    def choose(state: rules.State, seen: rules.Observation) -> Array:
        mask = torch.as_tensor(seen.action_mask)
        logits = logits_of(state, seen)
        if logits.shape != mask.shape:
            raise ValueError(f"the policy must return logits of shape {tuple(mask.shape)}, got {tuple(logits.shape)}")
        logits = logits.masked_fill(~mask, -torch.inf)
        best, action = logits.max(1)  # (B,) each
        if not best.isfinite().all():
            check_greatest(best)
            raise ValueError("the policy's logits must be finite for at least one legal node, got -inf for all of them")
        if generator is not None:
            action = torch.multinomial(logits.float().softmax(1), 1, generator=generator)[:, 0]
        return action.numpy() if isinstance(state.ready, np.ndarray) else action

    return choose


def best_tours(state: rules.State) -> Tours:
    """The tours of the game with the smallest makespan, the first of equals."""
    row = int(rules.makespan(state).argmin())
    visits, destination = (torch.as_tensor(array[row]).cpu().numpy() for array in (state.visits, state.destination))
    return rules.tours(visits, destination)


def as_links(tours: Sequence[Tours], n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """The tours of B games as arrays.

    Returns:
        first: (B, m) int64, each agent's first city.
        following: (B, n) int64, the node that comes after a city on its tour; 0 at the depot.
    """
    following = np.zeros((len(tours), n_nodes), np.int64)
    for row, tours_of_game in zip(following, tours, strict=True):
        for tour in tours_of_game:
            row[tour[1:-1]] = tour[2:]
    return np.array([[tour[1] for tour in tours_of_game] for tours_of_game in tours]), following


def next_on_tour(first: Array, following: Array, agent: Array, destination: Array) -> Array:
    """Where the deciding agents ``agent`` (B,) go next if they follow their tours.

    Args:
        first, following: the tours, as ``as_links`` returns them, in the library of the other arrays.
        agent: (B,), the deciding agents.
        destination: (B, m), where all agents are or are heading.
    """
    own = locate(agent, destination.shape[1])
    here = pick(destination, own)
    xp, _ = library(destination)
    return xp.where(here == 0, pick(first, own), pick(following, locate(here, following.shape[1])))


def _logits_of(policy: Network | TensorDictModuleBase) -> Logits:
    if is_actor(policy):
        from dan_policy.actor import logits_of_actor  # imports TorchRL

        return lambda state, seen: logits_of_actor(policy, _tensors(seen.arrays()), _tensors(state.arrays()))
    keys = network_keys(policy)
    return lambda state, seen: policy(*(_tensor(state, seen, key) for key in keys))


def _foreseen_logits(network: Any, confidence: float, sharpness: float) -> Logits:
    """Logits of the deciding agents, for all decisions of the same games in turn.

    ``network.forward_next`` says where each agent goes next, not only the decider. Agents that decide after it do what
    was foreseen for them if its probability is above ``confidence``; if not, or if they have already done so, the
    network looks again, with the eyes of the agent that decides now. Games that are over need no further look. However
    sharp the logits are, certain is what the network was certain of in training. Nothing is foreseen for others while
    some cities are out of the decider's view, since they may be those that are next to another agent.
    """
    keys, view = network_keys(network), getattr(network.config, "view", None)
    foreseen: Tensor | None = None  # (B, m, n) logits of each game's last look
    unused: Tensor | None = None  # (B, m) False if nothing was foreseen, or once an agent has moved since then

    def whole(seen: rules.Observation) -> Tensor:
        """(B,) whether the decider sees all cities that are left."""
        left = (~torch.as_tensor(seen.visited)).sum(1) - 1  # without the depot
        return left <= (seen.visited.shape[1] if view is None else view)

    def logits_of(state: rules.State, seen: rules.Observation) -> Tensor:
        nonlocal foreseen, unused
        agent, mask = torch.as_tensor(seen.agent), torch.as_tensor(seen.action_mask)
        inputs = [_tensor(state, seen, key) for key in keys]
        row = torch.arange(len(agent), device=agent.device)
        if foreseen is None or unused is None:
            if not whole(seen).any():
                return network(*inputs)
            foreseen = network.forward_next(*inputs)
            unused = whole(seen)[:, None].repeat(1, foreseen.shape[1])
        else:
            legal = foreseen[row, agent].masked_fill(~mask, -torch.inf)
            sure = (legal / sharpness).softmax(1).amax(1) * unused[row, agent]
            asked = row[sure <= confidence]
            if torch.is_autocast_enabled(sure.device.type):  # a few batch sizes, for the reason of a few lengths
                asked = sure.argsort()[: min(padded_length(len(asked)), len(row))]
            if len(asked):
                foreseen[asked] = network.forward_next(*(None if x is None else x[asked] for x in inputs))
                unused[asked] = whole(seen)[asked, None]
        unused[row, agent] = False
        return foreseen[row, agent]

    return logits_of


def _tensor(state: rules.State, seen: rules.Observation, key: Key) -> Tensor | None:
    """What a network reads under ``key``: a part of the observation, or of the state under "game".

    None: a part that only observations in worlds have.
    """
    if isinstance(key, str) and key in seen._fields:
        array = getattr(seen, key)
        return None if array is None else torch.as_tensor(array)
    arrays = state.arrays()
    if isinstance(key, tuple) and len(key) == 2 and key[0] == "game" and key[1] in arrays:
        return torch.as_tensor(arrays[key[1]])
    choices = [*seen._fields, *(("game", name) for name in arrays)]
    raise ValueError(f"the network reads {key!r}; choose from {choices}")


def _tensors(arrays: Mapping[str, Array]) -> dict[str, Tensor]:
    return {name: torch.as_tensor(array) for name, array in arrays.items()}
