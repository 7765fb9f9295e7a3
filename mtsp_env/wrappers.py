"""Flat observations for libraries that do not take PettingZoo's nested dicts.

>>> from mtsp_env import mtsp_v0
>>> env = flatten(mtsp_v0.env(n_nodes=20, n_agents=3))
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv
from pettingzoo.utils import BaseWrapper


def flatten(
    env: AECEnv,
    mask_key: str | None = "action_mask",
    observation_key: str = "observation",
    mask_in_infos: bool = False,
) -> AECEnv:
    """``env`` with one flat float32 vector per observation, and the action mask where a library looks for it.

    The vector holds the parts of the nested observation in the order of its ``spaces.Dict``, which is alphabetical. In
    the plain problem, these are ``agent`` (m, one-hot), ``agents`` (3 m), ``cities`` (2 n) and ``visited`` (n),
    together 3 n + 4 m numbers. ``gymnasium.spaces.unflatten`` turns a vector back, with the space
    ``env.unwrapped.observation_space(agent)["observation"]``.

    ========================================  =====================================================================
    library                                   arguments
    ========================================  =====================================================================
    PettingZoo's tests and tutorials,         none
    SB3-contrib, Tianshou, CleanRL-style
    RLlib, ``ActionMaskingTorchRLModule``     ``observation_key="observations"``
    AgileRL                                   ``mask_key=None, mask_in_infos=True``
    TorchRL                                   ``PettingZooWrapper(use_mask=True)`` takes the nested observation as well
    ========================================  =====================================================================

    Args:
        env: ``mtsp_v0.env(...)``.
        mask_key: the mask's key in the observation, which is ``{observation_key: vector, mask_key: mask}``. None: the
            observation is the vector alone.
        observation_key: the vector's key in the observation.
        mask_in_infos: also put the mask into each agent's infos, as ``"action_mask"``.

    Raises:
        ValueError: the mask would be nowhere, both keys are the same, or ``env`` does not have this project's
            observations.
    """
    if mask_key is None and not mask_in_infos:
        raise ValueError("mask_key=None needs mask_in_infos=True; otherwise the action mask would be nowhere")
    if mask_key == observation_key:
        raise ValueError(f"mask_key and observation_key must differ, got {mask_key!r} for both")
    return _FlatWrapper(env, mask_key, observation_key, mask_in_infos)


class _FlatWrapper(BaseWrapper):
    """See ``flatten``."""

    def __init__(self, env: AECEnv, mask_key: str | None, observation_key: str, mask_in_infos: bool):
        super().__init__(env)
        self.mask_key, self.observation_key, self.mask_in_infos = mask_key, observation_key, mask_in_infos
        self._masks: dict[str, np.ndarray] = {}  # those of the decision at hand: ``last()`` and ``infos`` give the same
        self.nested_spaces: dict[str, spaces.Space] = {}
        self.observation_spaces: dict[str, spaces.Space] = {}
        for agent in env.possible_agents:
            space = env.observation_space(agent)
            if not (isinstance(space, spaces.Dict) and {"observation", "action_mask"} <= space.keys()):
                raise ValueError(f"expected the observations of mtsp_v0.env, got {space}")
            self.nested_spaces[agent] = space["observation"]
            self.observation_spaces[agent] = self._flat_space(space)

    def _flat_space(self, space: spaces.Dict) -> spaces.Space:
        box = spaces.flatten_space(space["observation"])
        assert isinstance(box, spaces.Box)
        flat = spaces.Box(box.low.astype(np.float32), box.high.astype(np.float32), dtype=np.float32)
        if self.mask_key is None:
            return flat
        return spaces.Dict({self.observation_key: flat, self.mask_key: space["action_mask"]})

    def observation_space(self, agent: str) -> spaces.Space:
        """Dict(observation, action_mask) with the chosen keys, or the Box of the vector alone."""
        return self.observation_spaces[agent]

    def observe(self, agent: str) -> Any:
        """What ``agent`` sees now, flat."""
        seen = self.env.observe(agent)
        vector = np.asarray(spaces.flatten(self.nested_spaces[agent], seen["observation"]), np.float32)
        return vector if self.mask_key is None else {self.observation_key: vector, self.mask_key: seen["action_mask"]}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """As in PettingZoo."""
        self.env.reset(seed=seed, options=options)
        self._masks.clear()

    def step(self, action: int | None) -> None:
        """As in PettingZoo."""
        self.env.step(action)
        self._masks.clear()

    @property
    def infos(self) -> dict[str, dict[str, Any]]:
        """The environment's, with every agent's mask in them if asked for."""
        infos = self.env.infos
        return {agent: self._with_mask(agent, info) for agent, info in infos.items()} if self.mask_in_infos else infos

    def last(self, observe: bool = True) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As in PettingZoo."""
        agent = self.agent_selection
        _, reward, terminated, truncated, info = self.env.last(observe=False)
        if self.mask_in_infos:
            info = self._with_mask(agent, info)
        return self.observe(agent) if observe else None, reward, terminated, truncated, info

    def _with_mask(self, agent: str, info: dict[str, Any]) -> dict[str, Any]:
        if agent not in self._masks:
            self._masks[agent] = self.env.observe(agent)["action_mask"]
        return {**info, "action_mask": self._masks[agent]}
