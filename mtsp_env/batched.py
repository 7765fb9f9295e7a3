"""The TorchRL face: a batch of games in one flat stream, in which row b's deciding agent acts."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from tensordict.nn import TensorDictModule
    from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase
except ImportError as error:
    raise ImportError('mtsp_env.batched needs TorchRL: pip install "mtsp-env[dan]"') from error

from mtsp_env import rules
from mtsp_env.arrays import cast
from mtsp_env.checks import check_count
from mtsp_env.distributions import Generator, check_distribution, sample, scenario_shapes
from mtsp_env.instance import FIELDS, ArrayField, Problem, Tours, check_arrays

Arrays = dict[str, "torch.Tensor"]


class BatchedMTSP(EnvBase):
    """B games of the MinMax mTSP side by side, by the same rules as ``mtsp_v0`` (``mtsp_env.rules``).

    At each step row b's deciding agent, ``agent[b]``, picks its next node. Keys:

    - observation of the deciding agent: ``cities`` (B, n, 2) float32, ``agents`` (B, m, 3) float32, ``visited`` (B, n)
      bool, ``action_mask`` (B, n) bool, ``agent`` (B,) int64, its index; in worlds, or with ``view`` or ``hearing``,
      also those of ``mtsp_env.rules.OBSERVED`` that apply;
    - ``action`` (B,) int64, the node to go to next; ``reward`` (B, 1) float32; ``done``, ``terminated``, ``truncated``
      (B, 1) bool;
    - the state of the games, nested under ``"game"``: the problem (``("game", "nodes")``, (B, n, 2) float64, and the
      fields of its world) and ``mtsp_env.rules.STATE_FIELDS``. The environment keeps nothing else, so that any
      TensorDict of a rollout can be stepped from.

    ``reset(TensorDict({"game": {"nodes": nodes}}, [B]), set_state=True)`` replays given instances; with all fields of
    the state under ``"game"``, the games go on from there. With ``set_state=False`` a TensorDict's state is ignored:
    every row, or with ``_reset`` the rows that it asks for, gets a fresh instance. If ``set_state`` is not given,
    TorchRL 0.14 takes it for True and warns; later versions take it for False. A finished row that is stepped again
    repeats its last reward and ``done``.

    ``td = env.step(td)["next"]`` is the quickest loop: what ``step`` returns under ``"next"`` can be stepped as it is.
    On a CPU the rules run in NumPy, on the tensors' own memory, which is several times faster than torch for arrays of
    these sizes. If Numba is installed (the extra "reference"), plain games are played by compiled loops, which are
    several times faster still (``mtsp_env.kernels``); the first step then takes some seconds, once per machine.

    ``SerialEnv``, ``ParallelEnv``, ``Collector(env, None)`` and ``ActionMask`` sample actions without the mask: give
    them ``masked_random_policy()``. It draws from torch's global generator, which each worker process seeds from its
    own ``set_seed``: ``ParallelEnv.set_seed(seed)`` gives worker i the i-th of a series of seeds that ``seed`` starts.

    Args:
        n_nodes, n_agents, speed, depot, reward, max_decisions, distribution, scenario, view, hearing: as for
            ``mtsp_v0.raw_env``.
        batch_size: B or [B].
        device: where the games live, "cpu" or "cuda". None: on the CPU, in TensorDicts without a device, which TorchRL
            makes a little faster.
        seed: seed of the instances; a row's instance depends on the order of resets alone.
        check_actions: raise ValueError on an illegal action. On a GPU this waits for the device at each step: switch it
            off if the policy is masked.
        compile: True, or a dict of options of ``torch.compile``: TorchRL then calls ``compile``. Not worth it on a CPU,
            where NumPy is faster.

    Raises:
        ValueError: an argument outside its range, nodes outside the unit square, or an illegal action.
    """

    batch_locked = True
    _supports_set_state = True

    def __init__(
        self,
        n_nodes: int = 50,
        n_agents: int = 5,
        batch_size: int | Sequence[int] = 64,
        speed: float = 0.01,
        depot: rules.Depot = "open",
        reward: rules.Reward = "sparse",
        max_decisions: int | None = None,
        distribution: str | Generator = "uniform",
        device: torch.device | str | None = None,
        seed: int | None = None,
        check_actions: bool = True,
        scenario: str | Generator = "plain",
        view: int | None = None,
        hearing: float | None = None,
    ):
        self.rules = rules.make_rules(n_nodes, n_agents, speed, depot, reward, max_decisions, view, hearing)
        check_distribution(distribution)
        sizes = [batch_size] if isinstance(batch_size, (int, np.integer)) else list(batch_size)
        if len(sizes) != 1:
            raise ValueError(f"batch_size must be B or [B], got {batch_size!r}")
        check_count("batch_size", sizes[0], minimum=1)
        super().__init__(device=device, batch_size=torch.Size(sizes))
        self.n_nodes, self.n_agents, self.distribution, self.scenario = n_nodes, n_agents, distribution, scenario
        self._world = scenario_shapes(scenario, sizes[0], n_nodes, n_agents)  # its world fields, of one instance
        rules.check_world(self._world, self.rules)
        self.check_actions = check_actions
        self._rng = np.random.default_rng(seed)
        self._last: TensorDictBase | None = None  # for tours()
        self._on_cpu = device is None or torch.device(device).type == "cpu"
        self._in_numpy = self._on_cpu
        self._numpy_rules = _quickest_rules(self._world, self.rules)
        self._numpy_views: dict[str, tuple[torch.Tensor, np.ndarray]] = {}
        self._advance: Callable[[dict], tuple[dict, dict]] = self._decide
        self._make_specs()

    def _make_specs(self) -> None:
        batch, n, m = self.batch_size[0], self.n_nodes, self.n_agents

        def spec(name: str, field: ArrayField) -> Bounded | Unbounded | Binary:
            sizes = (batch, *self._world.get(name, field.sizes(n, m)))
            options = {"dtype": getattr(torch, field.dtype), "device": self.device}
            if field.dtype == "bool":
                return Binary(sizes[-1], sizes, **options)
            if field.low is not None and field.high is not None and math.isfinite(field.high):
                return Bounded(field.low, field.high, sizes, **options)
            return Unbounded(sizes, **options)

        fields = {name: FIELDS[name] for name in ("nodes", *self._world)} | rules.state_fields(self._world)
        game = {name: spec(name, field) for name, field in fields.items()}
        extra = rules.observed_fields(self._world, self.rules)
        observation = {
            "cities": Bounded(-1.0, 1.0, (batch, n, 2), dtype=torch.float32, device=self.device),
            "agents": Unbounded((batch, m, 3), dtype=torch.float32, device=self.device),
            "visited": Binary(n, (batch, n), dtype=torch.bool, device=self.device),
            "action_mask": Binary(n, (batch, n), dtype=torch.bool, device=self.device),
            "agent": Categorical(m, (batch,), dtype=torch.int64, device=self.device),
            **{name: spec(name, field) for name, field in extra.items()},
        }
        self._state_keys = rules.state_fields(self._world).keys()
        flag = Categorical(2, (batch, 1), dtype=torch.bool, device=self.device)
        done = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        same = {"shape": self.batch_size, "device": self.device}
        self.state_spec = Composite({"game": Composite(game, **same)}, **same)
        self.observation_spec = Composite({**observation, "game": Composite(game, **same)}, **same)
        self.action_spec = Categorical(n, self.batch_size, dtype=torch.int64, device=self.device)
        self.reward_spec = Unbounded((batch, 1), dtype=torch.float32, device=self.device)
        self.done_spec = Composite(done, **same)

    def _set_seed(self, seed: int | None) -> None:
        self._rng = np.random.default_rng(seed)

    def compile(self, **options: Any) -> BatchedMTSP:
        """Run the rules through ``torch.compile`` from now on; returns this environment.

        The first step takes some seconds, longer still if nothing was compiled on this machine before. If compiling
        fails, a warning says why, and the rules run as they would without it.

        Args:
            options: of ``torch.compile``; by default fullgraph=True, dynamic=False.
        """
        self._advance = partial(self._compiled, torch.compile(self._decide, fullgraph=True, dynamic=False, **options))
        self._in_numpy = False
        return self

    def _compiled(self, advance: Callable[[dict], tuple[dict, dict]], arrays: dict) -> tuple[dict, dict]:
        """The first compiled step; those after it call ``advance`` themselves."""
        try:
            outputs = advance(arrays)
            self._advance = advance
        except Exception as error:  # compilers fail in many ways; an illegal action was refused before
            warnings.warn(f"torch.compile failed, the rules run without it: {_first_line(error)}", stacklevel=5)
            self._advance, self._in_numpy = self._decide, self._on_cpu
            outputs = self._decide(self._library(arrays))
        return outputs

    # Reset

    def _reset(self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: object) -> TensorDictBase:
        asked = None if tensordict is None else tensordict.get("_reset", None)
        given = set_state and asked is None  # otherwise fresh instances; TorchRL keeps the rows that _reset leaves out
        arrays = self._library(self._given_arrays(tensordict) if given else self._fresh_arrays(asked))
        problem = Problem(self.n_agents, {name: arrays[name] for name in FIELDS if name in arrays})
        self._check_fields(problem)
        if self._state_keys <= arrays.keys():
            state = rules.state_from_arrays(arrays, self.n_agents)
        else:
            state = rules.start(problem, self.rules)
        return self._tensordict(self._outputs(state))

    def _check_fields(self, problem: Problem) -> None:
        shapes = {name: tuple(problem.arrays[name].shape[1:]) for name in problem.world}
        if shapes != self._world:
            raise ValueError(
                f"this environment plays instances with the world fields {self._world}, as its scenario draws them, "
                f"got some with {shapes}"
            )

    def _fresh_arrays(self, asked: torch.Tensor | None) -> Arrays:
        batch = self.batch_size[0]
        rows = torch.ones(batch, dtype=torch.bool) if asked is None else asked.reshape(batch).cpu()
        drawn = sample(self.distribution, self._rng, int(rows.sum()), self.n_nodes, self.n_agents, self.scenario)
        arrays = {}
        for name, array in drawn.arrays.items():
            # Ones in the rows that TorchRL keeps as they were: valid values of every field
            arrays[name] = torch.ones((batch, *array.shape[1:]), dtype=torch.float64)
            arrays[name][rows] = torch.as_tensor(array)
            arrays[name] = arrays[name].to(self.device)
        return arrays

    def _given_arrays(self, tensordict: TensorDictBase | None) -> Arrays:
        game = None if tensordict is None else tensordict.get("game", None)
        nodes = None if game is None else game.get("nodes", None)
        if game is None or nodes is None:
            keys = [] if tensordict is None else sorted(map(str, tensordict.keys(True, True)))
            raise ValueError(f"set_state=True needs the key ('game', 'nodes'), got {keys}")
        shape = (*self.batch_size, self.n_nodes, 2)
        if nodes.shape != shape:
            raise ValueError(f"nodes must have shape {shape}, got {tuple(nodes.shape)}")
        arrays = {key: value.to(self.device).contiguous() for key, value in game.items()}
        arrays |= {name: arrays[name].to(torch.float64) for name in FIELDS if name in arrays}
        check_arrays({name: arrays[name].cpu().numpy() for name in FIELDS if name in arrays}, self.n_agents)
        return arrays

    # Step

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Make a decision in every row; see ``EnvBase.step``.

        The same as the inherited method, without its work for TensorDicts that ask for more than a plain step.
        """
        keys = tensordict.keys()
        if "next" in keys or "_step" in keys:
            return super().step(tensordict)
        if tensordict.batch_size != self.batch_size:
            raise ValueError(f"expected a batch size of {list(self.batch_size)}, got {list(tensordict.batch_size)}")
        return tensordict.set("next", self._step(tensordict))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._checked_action(tensordict)
        return self._tensordict(
            self._advance(self._library({**dict(tensordict.get("game").items()), "action": action}))
        )

    def _decide(self, arrays: dict) -> tuple[dict, dict]:
        """One decision in every row: arrays of the game and ``action`` -> what ``_outputs`` returns."""
        before = rules.state_from_arrays(arrays, self.n_agents)
        depart = self._numpy_rules.depart if self._in_numpy else rules.depart
        return self._outputs(depart(before, self.rules, arrays["action"]), before)

    def _outputs(self, state: rules.State, before: rules.State | None = None) -> tuple[dict, dict]:
        """Arrays at the root and arrays of the game; with the state before, also the reward of the decision."""
        terminated, truncated = rules.terminated(state), rules.truncated(state, self.rules)
        over = terminated | truncated
        observe = self._numpy_rules.observe if self._in_numpy else rules.observe
        root = observe(state, self.rules).arrays()
        root |= {"done": over[:, None], "terminated": terminated[:, None], "truncated": truncated[:, None]}
        if before is not None:
            reward = rules.reward(before, state, self.rules, over)
            root["reward"] = cast(reward, "float32")[:, None]
        return root, state.arrays()

    def _library(self, arrays: Arrays) -> dict:
        """The same memory as arrays of the library in which the rules run."""
        if not self._in_numpy:
            return arrays
        known = self._numpy_views  # of the last step's tensors: most steps go on from these
        return {
            key: known[key][1] if key in known and known[key][0] is tensor else tensor.contiguous().numpy()
            for key, tensor in arrays.items()
        }

    def _tensordict(self, outputs: tuple[dict, dict]) -> TensorDictBase:
        root, game = outputs
        if self._in_numpy:
            root = {key: torch.from_numpy(array) for key, array in root.items()}
            self._numpy_views = {key: (torch.from_numpy(array), array) for key, array in game.items()}
            game = {key: tensor for key, (tensor, _) in self._numpy_views.items()}
        same = {"batch_size": self.batch_size, "device": self.device}
        self._last = TensorDict({**root, "game": TensorDict(game, **same)}, **same)
        return self._last

    # Actions

    def _checked_action(self, tensordict: TensorDictBase) -> torch.Tensor:
        action = tensordict.get("action")
        if action.shape != self.batch_size or action.dtype not in _WHOLE:
            raise ValueError(
                f"action must be whole numbers of shape {tuple(self.batch_size)}, got {action.dtype} of shape "
                f"{tuple(action.shape)}"
            )
        if action.dtype != torch.int64 or not action.is_contiguous():
            action = action.to(torch.int64).contiguous()
        if self.check_actions:
            self._check_legal(tensordict, action)
        return action

    def _check_legal(self, tensordict: TensorDictBase, action: torch.Tensor) -> None:
        legal = tensordict.get("action_mask", None)
        if legal is None:
            state = self._state_of(tensordict)
            legal = torch.as_tensor(rules.legal_actions(state, self.rules, rules.agent_to_decide(state)))
        arrays = self._library({"action": action, "legal": legal})
        good = rules.are_legal(arrays["action"], arrays["legal"])
        if not good.all():
            row = int(torch.nonzero(~torch.as_tensor(good))[0])
            raise ValueError(
                f"agent {int(rules.agent_to_decide(self._state_of(tensordict))[row])} of row {row} may not go to node "
                f"{int(action[row])}; legal are {torch.nonzero(legal[row])[:, 0].tolist()}"
            )

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Write a uniformly random legal ``action``, read off ``action_mask``."""
        if tensordict is None or "action_mask" not in tensordict.keys():  # noqa: SIM118 (a TensorDict is no mapping)
            raise ValueError(
                "rand_action needs a TensorDict with the key 'action_mask', as reset() and step() return it"
            )
        return tensordict.set("action", random_legal_action(tensordict.get("action_mask")))

    # Results

    def makespan(self, tensordict: TensorDictBase | None = None) -> torch.Tensor:
        """(B,) float64: each row's longest tour so far, return legs counted; if truncated, the penalty as well."""
        return torch.as_tensor(rules.final_cost(self._state_of(tensordict), self.rules))

    def tours(self, tensordict: TensorDictBase | None = None) -> list[Tours]:
        """Each row's tours in ``tensordict``, by default as of the last reset or step.

        They are closed at the depot, but those of broken agents.
        """
        state = self._state_of(tensordict)
        arrays = [torch.as_tensor(array).cpu().numpy() for array in (state.visits, state.destination)]
        alive = [None] * len(arrays[0]) if state.alive is None else torch.as_tensor(state.alive).cpu().numpy()
        return [rules.tours(visits, at, True, living) for visits, at, living in zip(*arrays, alive, strict=True)]

    def _state_of(self, tensordict: TensorDictBase | None) -> rules.State:
        tensordict = self._last if tensordict is None else tensordict
        if tensordict is None:
            raise ValueError("no game yet: call reset() first")
        return rules.state_from_arrays(self._library(dict(tensordict.get("game").items())), self.n_agents)


def _quickest_rules(world: Iterable[str], settings: rules.Rules) -> ModuleType:
    """The module whose ``depart`` and ``observe`` play these games in NumPy: ``kernels`` if it can, else ``rules``."""
    try:
        kernels = import_module("mtsp_env.kernels")
    except (ImportError, RuntimeError):  # without Numba, or if Numba finds no folder that it may write its cache to
        return rules
    return kernels if kernels.can_play(world, settings) else rules


def random_legal_action(action_mask: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
    """(...) int64: a uniformly random legal node of each row of ``action_mask`` (..., n) bool."""
    rank = action_mask.cumsum(-1, dtype=torch.int32)  # (..., n) a legal node's is 1 above that of the legal one before
    uniform = torch.rand(*rank.shape[:-1], 1, device=rank.device, generator=generator)
    drawn = uniform * rank[..., -1:]  # (..., 1) in [0, number of legal nodes)
    return torch.searchsorted(rank, drawn.to(torch.int32), right=True)[..., 0]


def masked_random_policy() -> TensorDictModule:
    """A policy that reads ``action_mask`` and writes a uniformly random legal ``action``, from torch's generator."""
    return TensorDictModule(random_legal_action, ["action_mask"], ["action"])


_WHOLE = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
