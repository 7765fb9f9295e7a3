"""The TorchRL face: a batch of games in one flat stream, in which row b's deciding agent acts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase
except ImportError as error:
    raise ImportError('mtsp_env.batched needs TorchRL: pip install "mtsp-env[dan]"') from error

from mtsp_env import rules
from mtsp_env.instance import Tours, check_distribution, check_nodes, sample_nodes


class BatchedMTSP(EnvBase):
    """B games of the MinMax mTSP side by side, by the same rules as ``mtsp_v0`` (``mtsp_env.rules``).

    At each step row b's deciding agent, ``agent[b]``, picks its next node. Root keys:

    - observation (of the deciding agent): ``cities`` (B, n, 2) float32, ``agents`` (B, m, 3) float32, ``visited``
      (B, n) bool, ``action_mask`` (B, n) bool, ``agent`` (B,) int64;
    - ``action`` (B,) int64, the node to go to next; ``reward`` (B, 1) float32; ``done``, ``terminated``, ``truncated``
      (B, 1) bool;
    - the state: the fields of ``mtsp_env.rules.State``, ``nodes`` (B, n, 2) float64 first among them. The environment
      keeps nothing else, so that any TensorDict of a rollout can be stepped from.

    ``reset(TensorDict({"nodes": nodes}, batch_size=[B]), set_state=True)`` replays given instances; with all the fields
    of the state in it, the games go on from there. With ``_reset`` in it, the rows asked for get fresh instances. A
    finished row that is stepped again repeats its last reward and ``done``.

    Args:
        n_nodes, n_agents, speed, depot, reward, max_decisions, distribution: as for ``mtsp_v0.raw_env``.
        batch_size: [B].
        device: where the games live, "cpu" or "cuda".
        seed: of the instances; a row's instance depends on the order of resets alone.
        check_actions: raise ValueError on an illegal action. On a GPU this waits for the device at each step: switch it
            off where the policy is masked.

    Raises:
        ValueError: an argument outside its range, nodes outside the unit square, or an illegal action.
    """

    batch_locked = True
    _supports_set_state = True

    def __init__(
        self,
        n_nodes: int = 50,
        n_agents: int = 5,
        batch_size: Sequence[int] = (64,),
        speed: float = 0.01,
        depot: rules.Depot = "open",
        reward: rules.Reward = "sparse",
        max_decisions: int | None = None,
        distribution: str = "uniform",
        device: torch.device | str = "cpu",
        seed: int | None = None,
        check_actions: bool = True,
    ):
        self.rules = rules.make_rules(n_nodes, n_agents, speed, depot, reward, max_decisions)
        check_distribution(distribution)
        batch_size = torch.Size(batch_size)
        if len(batch_size) != 1 or batch_size[0] < 1:
            raise ValueError(f"batch_size must be [B] with B of at least 1, got {list(batch_size)}")
        super().__init__(device=device, batch_size=batch_size)
        self.n_nodes, self.n_agents, self.distribution = n_nodes, n_agents, distribution
        self.check_actions = check_actions
        self._rng = np.random.default_rng(seed)
        self._last: rules.State | None = None  # for tours()
        self._make_specs()

    def _make_specs(self) -> None:
        batch, n, m = self.batch_size[0], self.n_nodes, self.n_agents

        def unbounded(*shape: int, dtype: torch.dtype = torch.int64) -> Unbounded:
            return Unbounded((batch, *shape), dtype=dtype, device=self.device)

        state = {
            "nodes": Bounded(0.0, 1.0, (batch, n, 2), dtype=torch.float64, device=self.device),
            "home": unbounded(n, dtype=torch.float64),
            "visited": Binary(n, (batch, n), dtype=torch.bool, device=self.device),
            "cities_left": unbounded(),
            "trips": unbounded(dtype=torch.float64),
            "visits": unbounded(n),
            "destination": unbounded(m),
            "leg": unbounded(m, dtype=torch.float64),
            "departed": unbounded(m),
            "ready": unbounded(m),
            "length": unbounded(m, dtype=torch.float64),
            "decisions": unbounded(),
            "agent": Categorical(m, (batch,), dtype=torch.int64, device=self.device),
        }
        seen = {
            "cities": Bounded(-1.0, 1.0, (batch, n, 2), dtype=torch.float32, device=self.device),
            "agents": unbounded(m, 3, dtype=torch.float32),
            "action_mask": Binary(n, (batch, n), dtype=torch.bool, device=self.device),
        }
        done = {
            key: Categorical(2, (batch, 1), dtype=torch.bool, device=self.device)
            for key in ("done", "terminated", "truncated")
        }
        self.state_spec = Composite(state, shape=self.batch_size, device=self.device)
        self.observation_spec = Composite({**seen, **state}, shape=self.batch_size, device=self.device)
        self.action_spec = Categorical(n, self.batch_size, dtype=torch.int64, device=self.device)
        self.reward_spec = unbounded(1, dtype=torch.float32)
        self.done_spec = Composite(done, shape=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._rng = np.random.default_rng(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: object) -> TensorDictBase:
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if set_state and asked is None:
            state = self._given_state(tensordict)
        else:  # only the rows asked for get an instance; TorchRL keeps the others as they are
            state = rules.start(self._fresh_nodes(asked), self.n_agents)
        self._last = state
        return self._tensordict(state, **self._over(state))

    def _fresh_nodes(self, asked: torch.Tensor | None) -> torch.Tensor:
        batch = self.batch_size[0]
        if asked is None:
            return torch.as_tensor(self._sample(batch), device=self.device)
        asked = asked.reshape(batch)
        nodes = torch.zeros((batch, self.n_nodes, 2), dtype=torch.float64, device=self.device)
        nodes[asked] = torch.as_tensor(self._sample(int(asked.sum())), device=self.device)
        return nodes

    def _sample(self, batch: int) -> np.ndarray:
        return sample_nodes(self.distribution, self._rng, batch, self.n_nodes)

    def _given_state(self, tensordict: TensorDictBase) -> rules.State:
        nodes = tensordict.get("nodes", None)
        if nodes is None:
            raise ValueError(f"set_state=True needs the key 'nodes', got {sorted(map(str, tensordict.keys()))}")
        shape = (*self.batch_size, self.n_nodes, 2)
        if nodes.shape != shape:
            raise ValueError(f"nodes must have shape {shape}, got {tuple(nodes.shape)}")
        nodes = nodes.to(device=self.device, dtype=torch.float64)
        check_nodes(nodes.cpu().numpy())
        if set(rules.State._fields) <= set(tensordict.keys()):
            return self._state(tensordict)
        return rules.start(nodes, self.n_agents)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        before, action = self._state(tensordict), tensordict.get("action")
        if self.check_actions:
            self._check(tensordict, before, action)
        after = rules.depart(before, self.rules, action)
        self._last = after
        reward = rules.reward(before, after, self.rules).to(torch.float32)
        return self._tensordict(after, reward=reward[:, None], **self._over(after))

    def _check(self, tensordict: TensorDictBase, state: rules.State, action: torch.Tensor) -> None:
        legal = tensordict.get("action_mask", None)
        if legal is None:
            legal = rules.legal_actions(state, self.rules, state.agent)
        inside = (action >= 0) & (action < self.n_nodes)
        good = inside & legal.gather(1, torch.where(inside, action, 0)[:, None])[:, 0]
        if not good.all():
            row = int(torch.nonzero(~good)[0])
            raise ValueError(
                f"agent {int(state.agent[row])} of row {row} may not go to node {int(action[row])}; "
                f"legal are {torch.nonzero(legal[row])[:, 0].tolist()}"
            )

    def _over(self, state: rules.State) -> dict[str, torch.Tensor]:
        terminated, truncated = rules.all_visited(state), rules.truncated(state, self.rules)
        over = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        return {key: value[:, None] for key, value in over.items()}

    def _state(self, tensordict: TensorDictBase) -> rules.State:
        return rules.State(*(tensordict.get(key) for key in rules.State._fields))

    def _tensordict(self, state: rules.State, **extra: torch.Tensor) -> TensorDictBase:
        seen = rules.observe(state, self.rules)
        return TensorDict(
            {**seen._asdict(), **state._asdict(), **extra}, batch_size=self.batch_size, device=self.device
        )

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Write a uniformly random legal ``action``, read off ``action_mask``."""
        if tensordict is None or "action_mask" not in tensordict.keys():  # noqa: SIM118 (a TensorDict is no mapping)
            raise ValueError(
                "rand_action needs a TensorDict with the key 'action_mask', as reset() and step() return it"
            )
        legal = tensordict.get("action_mask")
        rank = legal.cumsum(1, dtype=torch.int32)  # (B, n) a legal node's is one above that of the legal one before
        drawn = torch.rand(legal.shape[0], 1, device=legal.device) * rank[:, -1:]  # (B, 1) in [0, number of legal ones)
        return tensordict.set("action", torch.searchsorted(rank, drawn.to(torch.int32), right=True)[:, 0])

    def makespan(self, tensordict: TensorDictBase | None = None) -> torch.Tensor:
        """(B,) float64: each row's longest tour so far, return legs counted (the penalty too where truncated)."""
        return rules.final_cost(self._state_of(tensordict), self.rules)

    def tours(self, tensordict: TensorDictBase | None = None) -> list[Tours]:
        """Each row's tours, closed at the depot, in ``tensordict``; by default as of the last reset or step."""
        state = self._state_of(tensordict)
        return [
            rules.tours(visits, destination)
            for visits, destination in zip(state.visits.cpu().numpy(), state.destination.cpu().numpy(), strict=True)
        ]

    def _state_of(self, tensordict: TensorDictBase | None) -> rules.State:
        state = self._last if tensordict is None else self._state(tensordict)
        if state is None:
            raise ValueError("no game yet: call reset() first")
        return state
