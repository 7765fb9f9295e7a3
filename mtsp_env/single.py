"""The Gymnasium view: one learner decides for whichever agent has just arrived.

>>> import gymnasium, mtsp_env
>>> env = gymnasium.make("mtsp/MinMaxMTSP-v0", n_nodes=20, n_agents=3)
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from mtsp_env.mtsp_v0 import raw_env

ID = "mtsp/MinMaxMTSP-v0"


class MinMaxMTSP(gymnasium.Env):
    """The game of ``mtsp_v0`` for learners with one policy, which all agents share.

    Each step is one decision. The observation is a dict of what the deciding agent sees: ``cities`` (n, 2) float32,
    ``agents`` (m, 3) float32, ``visited`` (n,) bool and ``agent``, its index. ``gymnasium.wrappers.FlattenObservation``
    makes one vector of it. The action is the node to go to next; the legal ones are in ``action_masks()``, where
    SB3-contrib looks for them, and in ``info["action_mask"]``, (n,) int8.

    The reward is what this one decision pays: with the default ``reward="sparse"`` zero until the end, then -makespan;
    with ``reward="shaped"`` the change of -(longest closed tour so far). Either way an episode's rewards add up to
    -makespan, so learn without a discount (gamma = 1). The last info holds ``makespan``, and with ``reference=True``
    the regret.

    A seed gives the same instances as it does in ``mtsp_v0.env``.

    Gymnasium's ``check_env`` does not pass as it is: it samples actions without a mask, and an illegal action is a
    ValueError, as everywhere in this project. In a subclass whose ``step`` swaps illegal actions for legal ones,
    everything that it checks passes. Sample with ``env.action_space.sample(info["action_mask"])``.

    Args:
        n_nodes: n, the depot included, at least 2.
        n_agents: m, at least 1.
        render_mode: None, "rgb_array" or "human".
        **settings: the other arguments of ``mtsp_v0.raw_env``.

    Raises:
        ValueError: an argument outside its range, or an illegal action; nothing changes.
    """

    metadata = {key: raw_env.metadata[key] for key in ("render_modes", "render_fps")}  # noqa: RUF012

    def __init__(self, n_nodes: int = 50, n_agents: int = 5, render_mode: str | None = None, **settings: Any):
        self.aec = raw_env(n_nodes, n_agents, render_mode=render_mode, **settings)
        self.render_mode = render_mode
        agent = self.aec.possible_agents[0]  # the spaces are the same for all
        nested: Any = self.aec.observation_space(agent)
        self.observation_space = nested["observation"]
        self.action_space = self.aec.action_space(agent)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """A fresh instance, or ``options["instance"]``; all agents at the depot.

        Raises:
            ValueError: an unknown option, or an instance of another size.
        """
        self.aec.reset(seed=seed, options=options)
        super().reset(seed=seed)
        return self._observe()

    def step(self, action: int) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """The deciding agent sets off for node ``action``; returns what the next to decide sees.

        Raises:
            ValueError: an illegal action; nothing has changed.
        """
        agent = self.aec.agent_selection
        self.aec.step(action)
        observation, info = self._observe()
        terminated, truncated = self.aec.terminations[agent], self.aec.truncations[agent]
        return observation, self.aec.rewards[agent], terminated, truncated, info

    def action_masks(self) -> np.ndarray:
        """(n,) bool: the deciding agent's legal next nodes."""
        return self.aec.observe(self.aec.agent_selection)["action_mask"].astype(bool)

    def render(self) -> np.ndarray | None:
        """The picture, uint8 (600, 800, 3), with "rgb_array"; None with "human"."""
        return self.aec.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self.aec.close()

    def _observe(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        agent = self.aec.agent_selection
        seen = self.aec.observe(agent)
        observation = {key: value.copy() for key, value in seen["observation"].items()}  # the caller's own
        return observation, {**self.aec.infos[agent], "action_mask": seen["action_mask"]}
