"""The teacher as a critic: what each decision of a student costs, in the student's own games.

Most decisions of a trained policy cost nothing, because many tours are equally good, and a few cost per cent. Labels
that name one next node treat both alike. Here the teacher completes the student's game once for each node to which the
student may well go next, and the node's *regret* is how much longer the makespan becomes than with the best of them.
The student should then go to a node with the probability that it has now, times exp(-regret / temperature), up to a
common factor: decisions that cost nothing stay as they are.

Learning from costs to go of the teacher, in states of the student: AggreVaTe (Ross & Bagnell 2014). The target is the
policy improvement of MPO (Abdolmaleki et al. 2018).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from dan_policy.episode import rollout
from mtsp_env.instance import Instance, Problem, Tours
from mtsp_env.tours import makespan
from train.collect import autocast, environment
from train.network import student
from train.supervised_config import ImitateConfig

LIKELY = 0.05  # nodes with at least this probability are tried,
MOST_TRIED = 5  # but not more than so many; those to which the student and the teacher's own tours go are always
GREATEST_REGRET = 0.05  # relative to the makespan; larger ones count as this
LEAST_LOSS = 0.001  # expected regret from which a decision is worth learning from
LEAST_PROBABILITY = 0.01  # of the best node, so that the student can learn to go where it would never go


class Corrections(NamedTuple):
    """Decisions of a student's games of one size, and the probabilities that it should have had.

    ``arrays`` (T, B, ...) has the observation, by its keys, ``target`` (T, B, n) and, if not all decisions are here,
    ``weight`` (T, B), how many each of them stands for. They are sorted by the decision's index in its game, so that
    the B of one row have almost equally many unvisited cities.
    """

    arrays: dict[str, np.ndarray]
    valid: np.ndarray  # (T, B) bool, False where the last row is filled up

    def decisions(self, device: torch.device | str) -> tuple[TensorDictBase, Tensor]:
        """A TensorDict [T, B] with everything that is learnt from, and valid (T, B)."""
        tensors = {name: torch.as_tensor(array, device=device) for name, array in self.arrays.items()}
        decisions = TensorDict(tensors, batch_size=self.valid.shape, device=device)
        return decisions, torch.as_tensor(self.valid, device=device)


def correct(config: ImitateConfig, rng: np.random.Generator, problem: Problem) -> Corrections:
    """Whole games that the student plays greedily, and what their decisions cost.

    Kept are all decisions in which the student's expected regret is ``LEAST_LOSS`` or more, and as many others, at
    least one for each instance in the mean. They are drawn at random, and teach it to go on as before: each has a
    ``weight`` above 1, because it stands for those that were not drawn as well.

    Args:
        config: the run's options; ``roll_in`` names the student.
        rng: draws the teacher's seeds and the other decisions.
        problem: a batch of plain instances.
    """
    observation, prior, chosen, valid = student_games(config, problem)
    regret = np.full(prior.shape, np.inf, np.float32)
    for row, seed in enumerate(rng.integers(2**31, size=len(problem.nodes)).tolist()):
        instance = Instance(np.asarray(problem.nodes[row]), problem.n_agents)
        length = int(valid[:, row].sum())
        seen = (observation["agent"], observation["action_mask"], prior, chosen)
        game = (array[:length, row] for array in seen)
        for step, known in game_regrets(instance, *game, config.teacher_iterations, seed):
            regret[step, row, list(known)] = list(known.values())
    target, expected = improved(prior, regret, config.regret_temperature)

    costly = np.flatnonzero(valid & (expected >= LEAST_LOSS))
    others = np.flatnonzero(valid & (expected < LEAST_LOSS))
    batch = valid.shape[1]
    drawn = rng.permutation(others)[: max(len(costly), batch)]
    weight = np.ones(valid.shape, np.float32)
    weight.reshape(-1)[drawn] = len(others) / max(1, len(drawn))  # each stands for those that were not drawn
    kept = np.sort(np.concatenate([costly, drawn]))
    filled = np.append(kept, np.repeat(kept[-1:], -len(kept) % batch))
    learnt = observation | {"target": target, "weight": weight}
    arrays = {name: _rows(array, filled, batch) for name, array in learnt.items()}
    return Corrections(arrays, (np.arange(len(filled)) < len(kept)).reshape(-1, batch))


def improved(prior: np.ndarray, regret: np.ndarray, temperature: float) -> tuple[np.ndarray, np.ndarray]:
    """The probabilities that the student should have, and the regret that it expects now.

    Args:
        prior: (..., n), its probabilities.
        regret: (..., n), regrets of its actions, at least 0; inf: not known.
        temperature: a regret of this much divides a probability by e.

    Returns:
        Probabilities (..., n) float32, unchanged where no regret is known; and the mean regret (...) over the actions
        whose regret is known, 0 if there are none.
    """
    known = np.isfinite(regret)
    cost = np.where(known, np.minimum(regret, GREATEST_REGRET), 0.0)
    share = np.where(known, prior, 0.0)
    mass = share.sum(-1, keepdims=True)  # (..., 1) actions whose regret is not known keep what is left of 1
    expected = (share * cost).sum(-1, keepdims=True) / np.where(mass > 0.0, mass, 1.0)
    least = LEAST_PROBABILITY * -np.expm1(-expected / temperature)  # 0 if the student's decision costs nothing
    weight = np.where(known & (cost == 0.0), np.maximum(prior, least), share) * np.exp(-cost / temperature)
    total = weight.sum(-1, keepdims=True)
    target = np.where(known, weight * (mass / np.where(total > 0.0, total, 1.0)), prior)
    return target.astype(np.float32), expected[..., 0]


def student_games(
    config: ImitateConfig, problem: Problem
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Greedy games of ``config.roll_in``.

    Returns:
        Its observations (T, B, ...) by their keys, its probabilities (T, B, n), its actions (T, B), and valid (T, B).
    """
    config = replace(config, device="cpu")  # the teacher runs there
    env, actor = environment(problem, config), student(config)
    keys = [key for key in env.observation_spec.keys() if key != "game"]  # noqa: SIM118 (no dict)
    with autocast(config):
        episode = rollout(actor, env, "greedy", problem, [*keys, "logits"])
    decisions = episode.decisions
    assert decisions is not None
    logits = decisions["logits"].float().masked_fill(~decisions["action_mask"], -torch.inf)
    observation = {key: decisions[key].numpy() for key in keys}
    return observation, logits.softmax(-1).numpy(), decisions["action"].numpy(), episode.valid.numpy()


def game_regrets(
    instance: Instance,
    deciders: np.ndarray,
    legal: np.ndarray,
    prior: np.ndarray,
    chosen: np.ndarray,
    teacher_iterations: int,
    seed: int,
) -> Iterator[tuple[int, dict[int, float]]]:
    """Step by step through one game, the regret of each node that is tried; steps at which only one is are left out.

    The teacher's tours are kept from step to step: they go on as those for the node that the student has chosen.

    Args:
        instance: the problem.
        deciders: (T,), the agent that takes each decision.
        legal: (T, n) bool, its action mask.
        prior: (T, n), the student's probabilities.
        chosen: (T,), the node that it went to.
        teacher_iterations: iterations of the first search, per node.
        seed: seed of all searches.
    """
    from mtsp_env.reference import improve, tours_after  # imports Numba, which only the teacher needs

    costs: list[tuple[int, int, dict[int, float]]] = []  # index, chosen node, makespan after each node that was tried
    prefixes: Tours = [[0] for _ in range(instance.n_agents)]
    tours = improve(instance, iterations=teacher_iterations * instance.n_nodes, seed=seed, prefixes=prefixes)
    left = instance.n_nodes - 1
    for step, (agent, node) in enumerate(zip(deciders.tolist(), chosen.tolist(), strict=True)):
        if left == 0:  # everybody goes home
            break
        likely = np.argsort(-prior[step])[:MOST_TRIED]
        planned = tours[agent][len(prefixes[agent])]
        tried = list(dict.fromkeys([planned, node, *likely[prior[step, likely] >= LIKELY].tolist()]))
        if not legal[step, planned]:  # the teacher may leave an agent at home, which must visit a city
            tried.remove(planned)
        after = dict(zip(tried, tours_after(instance, prefixes, agent, tried, tours, seed=seed), strict=True))
        costs.append((step, node, {other: makespan(instance, solution) for other, solution in after.items()}))
        tours = after[node]
        prefixes[agent].append(node)
        left -= node != 0
    yield from with_hindsight(costs)


def with_hindsight(costs: list[tuple[int, int, dict[int, float]]]) -> Iterator[tuple[int, dict[int, float]]]:
    """Regrets from the costs of a whole game, first to last; decisions with one node are left out.

    Tours that a later search finds also begin with the nodes chosen so far, so that no chosen node costs more than the
    best one of the next decision. What nodes cost beyond that came from searches that ended too early. Other nodes have
    no later searches: their regrets are reduced by the share that those of the chosen ones have lost in the mean.

    Args:
        costs: for each decision its index, the chosen node, and the makespan of the tours found after each node tried.
    """
    first = sum(after[chosen] / min(after.values()) - 1.0 for _, chosen, after in costs)
    least, settled = math.inf, []
    for step, chosen, after in reversed(costs):
        after = after | {chosen: min(after[chosen], least)}
        least = min(after.values())
        settled.append((step, chosen, {node: cost / least - 1.0 for node, cost in after.items()}))
    share = sum(regrets[chosen] for _, chosen, regrets in settled) / first if first > 0.0 else 1.0
    for step, chosen, regrets in reversed(settled):
        if len(regrets) > 1:
            yield step, {node: regret if node == chosen else share * regret for node, regret in regrets.items()}


def _rows(array: np.ndarray, indices: np.ndarray, batch: int) -> np.ndarray:
    """The entries ``indices`` (N,) of an array (T, B, ...) seen as (T B, ...), in rows of ``batch``."""
    return array.reshape(-1, *array.shape[2:])[indices].reshape(-1, batch, *array.shape[2:])
