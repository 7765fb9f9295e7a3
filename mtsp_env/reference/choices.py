"""What a decision costs: near-optimal tours for each node to which an agent could go next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mtsp_env.checks import check_count
from mtsp_env.instance import Instance, Tours
from mtsp_env.reference.sisr import TOTAL_WEIGHT
from mtsp_env.reference.solver import _check_search, _solve, compile_kernels
from mtsp_env.tours import check_prefixes, check_tours, is_closed, makespan, path_lengths

# But for one decision, the tours are near-optimal already: a search that begins hotter would lose what they are like.
REPAIR_TEMPERATURE = 0.01
REPAIR_ITERATIONS = 20  # per unvisited city


def tours_after(
    instance: Instance,
    prefixes: Sequence[Sequence[int]],
    agent: int,
    nodes: Sequence[int],
    tours: Sequence[Sequence[int]],
    iterations: int | None = None,
    seed: int = 0,
) -> list[Tours]:
    """Near-optimal tours of a team under way if ``agent`` goes to one of ``nodes`` next, for each of them.

    The difference between two of their makespans says how much more one decision costs than the other. Independent
    searches would differ by chance. Here, each search begins with ``tours``, which it only adapts to the decision. It
    ends as soon as the decision costs nothing, that is, once its makespan is at most that of ``tours``.

    Args:
        instance: a plain problem.
        prefixes: how each agent's tour begins, see ``improve``.
        agent: who decides. It is not home for good.
        nodes: unvisited cities, or 0: the agent goes home for good.
        tours: near-optimal tours that begin with the prefixes, such as those of ``improve``.
        iterations: limit on the iterations of each search, at least 0; by default 20 per unvisited city.
        seed: a whole number of at least 0, the same for every search.

    Returns:
        The tours for each of the nodes, in the same order. For the node to which ``tours`` lead, they are ``tours``
        without visits to the depot in the middle.

    Raises:
        ValueError: a problem that is not plain, tours that do not solve it or do not begin with the prefixes, a node to
            which the agent cannot go, or a number outside its range.
    """
    if instance.world:
        raise ValueError(f"tours_after knows plain problems only, got one with {list(instance.world)}")
    _check_search(iterations, seed)
    begun = check_prefixes(instance, prefixes)
    check_tours(instance, tours)
    base = [[0, *(int(node) for node in tour if node != 0), 0] for tour in tours]
    for number, (tour, prefix) in enumerate(zip(base, begun, strict=True)):
        if tour[: len(prefix)] != prefix or (is_closed(prefix) and tour != prefix):
            raise ValueError(f"tour {number} must begin with its prefix {prefix}, got {tour}")
    check_count("agent", agent, minimum=0)
    if agent >= instance.n_agents or is_closed(begun[agent]):
        raise ValueError(f"agent must be one of 0..{instance.n_agents - 1} that is not home for good, got {agent}")
    visited = {node for prefix in begun for node in prefix if node}
    others_closed = all(is_closed(prefix) for other, prefix in enumerate(begun) if other != agent)
    left = instance.n_nodes - 1 - len(visited)
    for node in nodes:
        if not 0 <= node < instance.n_nodes or node in visited or (node == 0 and left and others_closed):
            raise ValueError(f"agent {agent} must go to an unvisited city, or home if others are out, got {node}")
    compile_kernels()
    iterations = REPAIR_ITERATIONS * left if iterations is None else iterations
    planned, enough = base[agent][len(begun[agent])], makespan(instance, base)
    solutions = []
    for node in nodes:
        if node == planned:
            solutions.append([list(tour) for tour in base])
            continue
        decided = [[*prefix, node] if number == agent else prefix for number, prefix in enumerate(begun)]
        start = _shortest_change(instance, begun, agent, node, base)
        solution = _solve(
            instance,
            start,
            iterations=iterations,
            seed=seed,
            prefixes=decided,
            temperature=REPAIR_TEMPERATURE,
            enough=enough,
        )
        solutions.append(solution)
    return solutions


def _shortest_change(instance: Instance, prefixes: Tours, agent: int, node: int, tours: Tours) -> Tours:
    """Of several simple changes of ``tours`` that send ``agent`` to ``node`` next, the one with the shortest tours."""
    if node == 0:  # its other cities are left to the search
        return [[*prefixes[agent], 0] if number == agent else tour for number, tour in enumerate(tours)]
    lengths = path_lengths(instance.nodes, tours)

    def cost(change: dict[int, list[int]]) -> float:
        after = lengths.copy()
        after[list(change)] = path_lengths(instance.nodes, list(change.values()))
        return float(after.max() + TOTAL_WEIGHT * after.sum())

    best = min(_changes(prefixes, agent, node, tours), key=cost)
    return [best.get(number, tour) for number, tour in enumerate(tours)]


def _changes(prefixes: Tours, agent: int, node: int, tours: Tours) -> Iterator[dict[int, list[int]]]:
    """Simple changes of ``tours`` that send ``agent`` to the city ``node`` next: the new tours of some agents."""
    own = tours[agent][len(prefixes[agent]) : -1]
    if node in own:
        for rest in _beginning_with(node, own):
            yield {agent: [*prefixes[agent], *rest, 0]}
        return
    other = next(number for number, tour in enumerate(tours) if node in tour)
    theirs = tours[other][len(prefixes[other]) : -1]
    at = theirs.index(node)
    pairs = [
        ([node, *own], theirs[:at] + theirs[at + 1 :]),  # take over the city alone
        (theirs[at:], theirs[:at] + own),  # exchange the rests of both tours
    ]
    if len(prefixes[agent]) == len(prefixes[other]) == 1:  # both are at the depot: exchange their tours
        pairs += [(rest, own) for rest in _beginning_with(node, theirs)]
    for mine, rest in pairs:
        yield {agent: [*prefixes[agent], *mine, 0], other: [*prefixes[other], *rest, 0]}


def _beginning_with(node: int, rest: list[int]) -> list[list[int]]:
    """The cities ``rest`` in orders that begin with ``node`` and have few new legs."""
    at = rest.index(node)
    before, after = rest[:at], rest[at + 1 :]
    turned = before[::-1]
    return [[node, *before, *after], [node, *turned, *after], [node, *after, *before], [node, *after, *turned]]
