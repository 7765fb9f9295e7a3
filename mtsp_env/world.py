"""What happens in a world: legs that take longer, cities that appear, agents that break down or wait at the depot.

``rules.py`` calls these functions only if the problem has world fields, or if an option hides something from an agent;
a plain game never comes here. Nothing loops over ticks or over the rows of a batch: the clock jumps from one decision
to the next, and what happens in between is worked out for all agents at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mtsp_env.arrays import Place, append, at_most, cast, indices, library, locate, norm, pick, pick_many, put
from mtsp_env.instance import Array, Problem
from mtsp_env.state import BROKEN, NEVER, TICK_TOLERANCE, Observation, Rules, State, travel_ticks

LONGEST = 2**52  # ticks; longer legs count as this many, so that ticks never overflow


class Leg(NamedTuple):
    """How long one leg takes, in units of time: float64 (B,) each."""

    announced: Array  # what everybody sees: driving as fast as the agent can, and the visit
    travel: Array  # until it arrives, traffic included
    total: Array  # until it decides again, the visit included


def leg_times(state: State, agent: Place, goal: Place, length: Array) -> Leg:
    """The next leg of ``agent``, to ``goal``, over the distance ``length`` (B,)."""
    arrays = state.problem.arrays
    travel = length / pick(arrays["speeds"], agent) if "speeds" in arrays else length
    visit = pick(arrays["service"], goal) if "service" in arrays else 0.0
    announced = travel + visit
    if "traffic" in arrays:
        factors = pick(arrays["traffic"], agent)  # (B, K)
        k = pick(state.legs, agent) % factors.shape[1]
        travel = travel * pick(factors, locate(k, factors.shape[1]))
    return Leg(announced, travel, travel + visit)


def ticks_of(time: Array, rules: Rules) -> Array:
    """``travel_ticks`` of any time, however long."""
    return travel_ticks(at_most(time, LONGEST * rules.speed), rules.speed)


def event_ticks(problem: Problem, rules: Rules) -> dict[str, Array]:
    """The first ticks at or after ``appears`` (never before tick 0) and ``breaks`` (never before tick 1)."""
    arrays, ticks = problem.arrays, {}
    for name, field, first in (("appear_tick", "appears", 0), ("break_tick", "breaks", 1)):
        if field in arrays:
            xp = library(arrays[field])[0]
            tick = at_most(xp.ceil(arrays[field] / rules.speed - TICK_TOLERANCE), float(NEVER))
            ticks[name] = xp.where(tick > first, cast(tick, "int64"), first)
    return ticks


def leaves_at(state: State, rules: Rules, agent: Place, sets_out: Array, tick: Array) -> Array:
    """(B,) The own time of ``agent`` as it leaves at ``tick`` (B,).

    If waiting counts, it is the clock's for an agent that ``sets_out`` (B,) from the depot for a city.
    """
    own_time = pick(state.own_time, agent)
    if not state.problem.waiting_counts:
        return own_time
    return library(own_time)[0].where(sets_out, cast(tick, "float64") * rules.speed, own_time)


def note_leg(state: State, rules: Rules, agent: Place, is_leg: Array, tick: Array, leg: Leg) -> dict[str, Array | None]:
    """The fields of the state that only worlds have, once ``agent`` has set off; staying at the depot is no leg."""
    legs, arrival = state.legs, state.arrival
    if legs is not None:
        legs = put(legs, agent, pick(legs, agent) + is_leg)
    if arrival is not None:
        arrival = put(arrival, agent, tick + ticks_of(leg.travel, rules))
    return {
        "legs": legs,
        "appear_tick": state.appear_tick,
        "break_tick": state.break_tick,
        "arrival": arrival,
        "alive": state.alive,
    }


# Between two decisions


def advance(state: State, rules: Rules, tick: Array) -> State:
    """Let the clock run from ``tick`` (B,), at which an agent has just set off, to the next decision.

    Agents that wait are woken, and those whose time comes break down. What a city's appearance changes is read off
    ``appear_tick`` by those who look.
    """
    xp = library(state.ready)[0]
    ready, due = state.ready, _due(state.ready, state)
    if rules.depot == "wait":
        asleep = ready == NEVER
        first = xp.min(due, axis=1)  # (B,) when an agent that is not waiting decides next
        woken = asleep & (first > tick)[:, None]  # not before everybody who decides at this tick has done so
        ready = xp.where(woken, xp.minimum(first, _next_event(state, tick))[:, None], ready)
        due = _due(ready, state)
    state = state._replace(ready=ready)
    return state if state.alive is None else _break_down(state, tick, xp.min(due, axis=1))


def _due(ready: Array, state: State) -> Array:
    """(B, m) ``ready``, or NEVER for agents that break down by then."""
    return ready if state.alive is None else library(ready)[0].where(ready < state.break_tick, ready, NEVER)


def _next_event(state: State, tick: Array) -> Array:
    """(B,) The first tick after ``tick`` at which a city appears or an agent breaks down; NEVER: none does."""
    xp = library(tick)[0]
    soonest = xp.full_like(tick, NEVER)
    for ticks in (state.appear_tick, state.break_tick):
        if ticks is not None:
            soonest = xp.minimum(soonest, xp.min(xp.where(ticks > tick[:, None], ticks, NEVER), axis=1))
    return soonest


def _break_down(state: State, tick: Array, clock: Array) -> State:
    """Break down the agents whose time comes after ``tick`` and by ``clock``, the next decision, (B,) each."""
    xp, breaks = library(tick)[0], state.break_tick
    # A game ends at the first event at which all cities are reached: nobody breaks down after it.
    reached = last_arrival(state)
    fails = _bound_for_a_city(state) & (breaks <= clock[:, None]) & (state.arrival > breaks)
    ends = (state.cities_left == 0) & ~xp.any(fails, axis=1)
    event = state.alive & (breaks > tick[:, None]) & (breaks >= reached[:, None])
    end = xp.minimum(clock, xp.min(xp.where(event, breaks, NEVER), axis=1))
    clock = xp.where(ends, end, clock)
    has_ended = ends & (reached <= tick)
    breaking = state.alive & (breaks <= clock[:, None]) & ~has_ended[:, None]
    if type(breaking) is np.ndarray and not breaking.any():
        return state  # as after most decisions

    cut = breaking & (state.arrival > breaks)  # on the way
    reopened = _destinations(state, cut & (state.destination != 0))
    away = breaking & (cut | (state.destination != 0))
    return state._replace(
        visited=state.visited & ~reopened,
        cities_left=state.cities_left + xp.sum(cast(reopened, "int64"), axis=1),
        visits=xp.where(reopened, -1, state.visits),
        leg=xp.where(breaking, 0.0, state.leg),
        ready=xp.where(breaking, BROKEN, state.ready),
        own_time=xp.where(away, state.problem.arrays["breaks"], state.own_time),
        alive=state.alive & ~breaking,
    )


def last_arrival(state: State) -> Array:
    """(B,) The tick at which the last agent that is bound for a city arrives there, if it does not break down."""
    xp = library(state.arrival)[0]
    return xp.max(xp.where(_bound_for_a_city(state), state.arrival, 0), axis=1)


def _bound_for_a_city(state: State) -> Array:
    return state.alive & (state.destination != 0)


def _destinations(state: State, agents: Array) -> Array:
    """(B, n) bool: the nodes to which those of ``agents`` (B, m) bool travel."""
    nodes = indices(state.visited, axis=1)
    return library(agents)[0].any((state.destination[:, :, None] == nodes) & agents[:, :, None], axis=1)


# What an agent knows


def known_cities(state: State, rules: Rules, tick: Array, here: Array) -> Array | None:
    """(B, n) bool: the nodes that an agent at ``here`` (B,) knows at ``tick`` (B,), the depot included; None: all.

    With ``rules.view`` these are the nearest open cities only, the first of equally near ones.
    """
    known = None if state.appear_tick is None else state.appear_tick <= tick[:, None]
    if rules.view is None:
        return known
    xp, nodes = library(state.visited)[0], state.problem.nodes
    is_open = ~state.visited if known is None else ~state.visited & known
    is_open[:, 0] = False
    distance = norm(nodes - pick(nodes, locate(here, nodes.shape[1]))[:, None])  # (B, n)
    order = xp.argsort(xp.where(is_open, distance, xp.inf), axis=1, stable=True)
    known = is_open & (xp.argsort(order, axis=1, stable=True) < rules.view)
    known[:, 0] = True
    return known


def heard_agents(state: State, rules: Rules, agent: Array, here: Array) -> Array:
    """(B, m) bool: of whom ``agent`` (B,) at node ``here`` (B,) hears: itself, and whose destination is near."""
    nodes = state.problem.nodes
    goals, own = pick_many(nodes, state.destination), pick(nodes, locate(here, nodes.shape[1]))
    return (norm(goals - own[:, None]) <= rules.hearing) | (indices(state.ready, axis=1) == agent[:, None])


def add_to_view(
    seen: Observation, state: State, rules: Rules, agent: Array, here: Array, known: Array | None
) -> Observation:
    """``seen`` as ``agent`` (B,) at node ``here`` (B,) knows it, and with the keys that only worlds have.

    ``known`` is what ``known_cities`` returns.
    """
    arrays, (xp, _) = state.problem.arrays, library(seen.cities)
    depot = seen.cities[:, :1]  # (B, 1, 2)
    if known is not None:
        cities = xp.where(known[:, :, None], seen.cities, depot)
        seen = seen._replace(cities=cities, visited=seen.visited | ~known, city_known=known)
    if "speeds" in arrays:
        seen = seen._replace(agent_speeds=cast(arrays["speeds"], "float32"))
    if "service" in arrays:
        service = cast(arrays["service"], "float32")
        seen = seen._replace(service=service if known is None else xp.where(known, service, 0.0))
    if state.alive is not None:
        seen = seen._replace(agent_alive=state.alive)
    if rules.hearing is not None:
        heard = heard_agents(state, rules, agent, here)
        nothing_left = append(depot, xp.zeros_like(depot[:, :, 0]))  # (B, 1, 3)
        seen = seen._replace(agents=xp.where(heard[:, :, None], seen.agents, nothing_left), agent_known=heard)
        if state.alive is not None:
            seen = seen._replace(agent_alive=state.alive | ~heard)
    return seen


def known_own_times(state: State, rules: Rules, decider: Array, tick: Array) -> Array:
    """(B, m) Own times after the current legs, as far as anybody can know them while ``decider`` (B,) decides.

    The traffic on a leg under way is not known yet: it is expected to take as long as announced, or as long as it has
    taken so far if that is longer. Without traffic these are ``state.own_time``, to the last bit.
    """
    if state.legs is None:
        return state.own_time
    arrays, (xp, _) = state.problem.arrays, library(state.own_time)
    k = arrays["traffic"].shape[2]
    which = indices(state.ready, axis=1) * k + (state.legs - 1) % k  # (B, m)
    factor = pick_many(xp.reshape(arrays["traffic"], (-1, state.ready.shape[1] * k)), which)
    visit = pick_many(arrays["service"], state.destination) if "service" in arrays else 0.0
    took = (state.leg - visit) * factor + visit
    before = xp.round((state.own_time - took) * 1e9) / 1e9  # so that not even its last bit depends on the factor
    elapsed = tick[:, None] - state.departed
    is_over = (state.leg == 0.0) | (elapsed >= ticks_of(took, rules))
    is_over = is_over | (indices(state.ready, axis=1) == decider[:, None])
    elapsed = cast(elapsed, "float64") * rules.speed
    return xp.where(is_over, state.own_time, before + xp.maximum(state.leg, elapsed))


# What a game costs


def own_times(state: State, way_home: Array) -> Array:
    """(B, m) Own times at which the agents are home or broken, with distances ``way_home`` (B, m) left."""
    arrays, (xp, _) = state.problem.arrays, library(way_home)
    if "speeds" in arrays:
        way_home = way_home / arrays["speeds"]
    if "traffic" in arrays:
        m, k = arrays["traffic"].shape[1:]
        which = indices(way_home, axis=1) * k + state.legs % k  # (B, m)
        way_home = way_home * pick_many(xp.reshape(arrays["traffic"], (-1, m * k)), which)
    if state.alive is None:
        return state.own_time + way_home
    times = xp.where(state.alive, state.own_time + way_home, state.own_time)
    return xp.minimum(times, arrays["breaks"])


def cut_off_cost(state: State, rules: Rules, makespan: Array, tick: Array) -> Array:
    """(B,) What a game costs that is cut off at ``tick`` (B,), when its makespan is ``makespan`` (B,) so far.

    The slowest agent makes an out-and-back trip to each city that is not visited (in worlds with ``breaks``: not
    reached), always in the worst traffic. If waiting counts, it begins when it is home, not before ``tick``, and when
    the last of these cities has appeared.
    """
    arrays, (xp, _) = state.problem.arrays, library(makespan)
    nodes, missing = arrays["nodes"], ~state.visited
    if state.alive is not None:
        missing = missing | _destinations(state, state.alive & (state.arrival > tick[:, None]))
    trip = 2.0 * norm(nodes - nodes[:, :1])  # (B, n); 0 for the depot
    if "speeds" in arrays:
        trip = trip / xp.min(arrays["speeds"], axis=1)[:, None]
    if "traffic" in arrays:
        trip = trip * xp.max(arrays["traffic"], axis=(1, 2))[:, None]
    if "service" in arrays:
        trip = trip + arrays["service"]
    begin = makespan
    if state.problem.waiting_counts:
        begin = xp.maximum(begin, cast(tick, "float64") * rules.speed)
    if "appears" in arrays:
        begin = xp.maximum(begin, xp.max(xp.where(missing, arrays["appears"], 0.0), axis=1))
    return begin + xp.sum(xp.where(missing, trip, 0.0), axis=1)
