"""Search with a policy: parts of good tours are planned again, and the new ones are kept if they are better.

Each round takes the agent that is home last and some of the others, often one or two neighbours, sometimes all. What is
left of their tours is planned again in several games at once: in each, the agents follow their tours for a number of
decisions, the same in all games, and then the policy plays on. It would only repeat what it did before, so each game
sees the instance in another symmetry of the square, and tours that have not begun run backwards and change agents at
random, which leaves the makespan as it is. What was decided last in one game is then decided first in another.

Random re-construction was proposed for a single tour by LEHD (Luo et al. 2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dan_policy.games import as_links, begin, best_tours, next_on_tour, play
from dan_policy.network import Network
from mtsp_env import rules
from mtsp_env.arrays import library
from mtsp_env.instance import FIELDS, Instance, Tours
from mtsp_env.tours import is_closed, tour_times

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

GAMES = 16  # side by side in each round: two in each symmetry of the square
SMALL_TEAM = 3  # a team has at most so many agents, unless all of them plan again,
WHOLE_TEAM = 0.1  # in this share of the rounds
LATEST = 0.7  # the policy takes over before this share of the cities is visited


def reconstruct(
    instance: Instance,
    tours: Sequence[Sequence[int]],
    policy: Network | TensorDictModuleBase,
    speed: float,
    rounds: int,
    rng: np.random.Generator,
    prefixes: Sequence[Sequence[int]] = (),
    device: torch.device | str = "cpu",
) -> Tours:
    """Tours whose makespan is that of ``tours`` or smaller.

    Args:
        instance: the problem, with no world fields but ``speeds`` and ``service``.
        tours: complete tours, such as a policy's. Agents that stay at home in them stay there.
        policy: as for ``games.play``; it takes its likeliest actions.
        speed: distance per tick of the games.
        rounds: number of rounds, at least 0.
        rng: draws the teams and their games.
        prefixes: what each agent has driven; none: all are at the depot.
        device: where the games are played.
    """
    best = [list(tour) for tour in tours]
    begun = [list(prefix) for prefix in prefixes] or [[0] for _ in best]
    times = tour_times(instance, best)
    for _ in range(rounds):
        last = int(times.argmax())
        if is_closed(begun[last]) or len(best[last]) == len(begun[last]) + 1:
            break  # it is home, or only has to go there
        team = _draw_team(instance, best, begun, last, rng)
        planned = _plan_again(instance, best, begun, team, policy, speed, rng, device)
        changed = best.copy()
        for agent, tour in zip(team, planned, strict=True):
            changed[agent] = tour
        changed_times = tour_times(instance, changed)
        if changed_times[team].max() < times[last]:
            best, times = changed, changed_times
    return best


def _draw_team(instance: Instance, tours: Tours, begun: Tours, last: int, rng: np.random.Generator) -> list[int]:
    """Agent ``last`` and others that can still visit cities: the nearer their cities are to its own, the likelier."""
    rests = [tour[len(prefix) :][:-1] for tour, prefix in zip(tours, begun, strict=True)]
    others = [  # those at home for good, or without a city to visit, are not asked
        agent
        for agent, (rest, prefix) in enumerate(zip(rests, begun, strict=True))
        if agent != last and not is_closed(prefix) and (rest or len(prefix) > 1)
    ]
    if rng.random() < WHOLE_TEAM or len(others) < SMALL_TEAM:
        return [last, *others]
    own = instance.nodes[rests[last]]

    def distance(agent: int) -> float:
        theirs = instance.nodes[rests[agent] or begun[agent][-1:]]
        return float(np.linalg.norm(own[:, None] - theirs, axis=-1).min())

    nearness = 1.0 / (1e-3 + np.array([distance(agent) for agent in others]))
    size = int(rng.integers(1, SMALL_TEAM))
    drawn = rng.choice(others, size, replace=False, p=nearness / nearness.sum())
    return [last, *drawn.tolist()]


def _plan_again(
    instance: Instance,
    tours: Tours,
    begun: Tours,
    team: list[int],
    policy: Network | TensorDictModuleBase,
    speed: float,
    rng: np.random.Generator,
    device: torch.device | str,
) -> Tours:
    """The best tours of the team from ``GAMES`` games in which it visits the same cities as before."""
    nodes = [0, *(node for agent in team for node in tours[agent] if node != 0)]
    number = {node: index for index, node in enumerate(nodes)}  # of the nodes of the team's own instance
    part = _part(instance, nodes, team)
    known = [[number[node] for node in tours[agent]] for agent in team]
    prefixes = [[number[node] for node in begun[agent]] for agent in team]
    cities = len(nodes) - 1 - sum(len(prefix) - 1 for prefix in prefixes)

    game = rules.make_rules(len(nodes), len(team), speed, "final", "sparse", None)
    state = begin(part, game, prefixes, GAMES, True, device)
    equivalent = [_equivalent(known, prefixes, instance.speeds is None, rng) for _ in range(GAMES)]
    state = _follow(state, game, equivalent, int(rng.integers(1 + int(LATEST * (cities - 1)))))
    return [[nodes[index] for index in tour] for tour in best_tours(play(policy, state, game))]


def _part(instance: Instance, nodes: list[int], agents: list[int]) -> Instance:
    """The instance with these nodes and agents alone."""
    rows = {"n": nodes, "m": agents}
    arrays: dict[str, Any] = {
        name: array[rows[str(FIELDS[name].shape[0])]] for name, array in instance.arrays().items()
    }
    return Instance(n_agents=len(agents), **arrays)


def _equivalent(tours: Tours, prefixes: Tours, alike: bool, rng: np.random.Generator) -> Tours:
    """Tours with the same makespan: those that have not begun run backwards and change agents at random.

    They change agents only if the agents are ``alike``.
    """
    waiting = [agent for agent, prefix in enumerate(prefixes) if len(prefix) == 1]
    turned = [tours[agent][:: rng.choice([-1, 1])] for agent in waiting]
    order = rng.permutation(len(waiting)) if alike else range(len(waiting))
    changed = list(tours)
    for agent, index in zip(waiting, order, strict=True):
        changed[agent] = turned[index]
    return changed


def _follow(state: rules.State, game: rules.Rules, tours: list[Tours], decisions: int) -> rules.State:
    """The games, one for each of ``tours``, after so many decisions in which every agent follows its tour."""
    xp, on = library(state.ready)
    first, following = (xp.asarray(array, device=on) for array in as_links(tours, state.visited.shape[1]))
    for _ in range(decisions):
        state = rules.depart(
            state, game, next_on_tour(first, following, rules.agent_to_decide(state), state.destination)
        )
    return state
