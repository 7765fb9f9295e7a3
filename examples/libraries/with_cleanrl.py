"""PPO with an action mask in one file, as CleanRL writes it: needs torch alone.

Eight games are played side by side through Gymnasium's vector API. One network decides for all agents. It finds the
cities in the flat observation again, to treat them all alike.
"""

import time
from itertools import pairwise

import gymnasium
import numpy as np
import torch
from compare import GAME, arguments, compare, flat, make_env
from torch import nn
from torch.distributions import Categorical

args = arguments(__doc__, steps=60_000)
n_envs, n_steps, epochs, minibatches = 8, 128, 4, 4
gamma, gae_lambda, clip, entropy_weight, value_weight = 1.0, 0.95, 0.2, 0.01, 0.5

torch.manual_seed(args.seed)
envs = gymnasium.vector.SyncVectorEnv(
    [lambda: gymnasium.wrappers.FlattenObservation(make_env())] * n_envs,
    autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,  # a step that ends a game returns the start of the next
)
size, n_nodes = envs.single_observation_space.shape[0], int(envs.single_action_space.n)
sizes = [GAME["n_agents"], 3 * GAME["n_agents"], 2 * n_nodes, n_nodes]  # of agent, agents, cities, visited


def mlp(*widths: int) -> nn.Sequential:
    layers = [layer for pair in pairwise(widths) for layer in (nn.Linear(*pair), nn.Tanh())]
    return nn.Sequential(*layers[:-1])


class Actor(nn.Module):
    """Scores each node by the same network, so that what it learns about one holds for all: (B, size) -> (B, n)."""

    def __init__(self) -> None:
        super().__init__()
        self.score = mlp(2 + 1 + 2 + 3 * GAME["n_agents"], 64, 64, 1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        _, agents, cities, visited = observation.split(sizes, 1)
        cities = cities.unflatten(1, (n_nodes, 2))  # (B, n, 2), the depot first
        from_depot, everybody = cities - cities[:, :1], agents[:, None].expand(-1, n_nodes, -1)
        return self.score(torch.cat([cities, visited[..., None], from_depot, everybody], 2))[..., 0]


actor, critic = Actor(), mlp(size, 128, 128, 1)
parameters = [*actor.parameters(), *critic.parameters()]
optimiser = torch.optim.Adam(parameters, lr=1e-3, eps=1e-5)


def policy(observation: torch.Tensor, mask: torch.Tensor) -> Categorical:
    return Categorical(logits=actor(observation).masked_fill(~mask, -1e8))


observations = torch.zeros(n_steps, n_envs, size)
masks = torch.zeros(n_steps, n_envs, n_nodes, dtype=torch.bool)
actions = torch.zeros(n_steps, n_envs, dtype=torch.int64)
log_probs, rewards, values = torch.zeros(3, n_steps, n_envs)
ends = torch.zeros(n_steps, n_envs)  # 1: this decision ended its game

start = time.process_time()
seen, info = envs.reset(seed=args.seed)
updates = max(1, args.steps // (n_steps * n_envs))
for update in range(updates):
    optimiser.param_groups[0]["lr"] = 1e-3 * (1 - update / updates)
    with torch.no_grad():
        for t in range(n_steps):
            observations[t], masks[t] = torch.as_tensor(seen).float(), torch.as_tensor(info["action_mask"]).bool()
            choice = policy(observations[t], masks[t])
            actions[t] = choice.sample()
            log_probs[t], values[t] = choice.log_prob(actions[t]), critic(observations[t])[:, 0]
            seen, reward, terminated, truncated, info = envs.step(actions[t].numpy())
            rewards[t], ends[t] = torch.as_tensor(reward), torch.as_tensor(terminated | truncated)

        advantages, advantage = torch.zeros_like(rewards), torch.zeros(n_envs)
        next_value = critic(torch.as_tensor(seen).float())[:, 0]
        for t in reversed(range(n_steps)):
            goes_on = 1 - ends[t]
            delta = rewards[t] + gamma * next_value * goes_on - values[t]
            advantage = delta + gamma * gae_lambda * goes_on * advantage
            advantages[t], next_value = advantage, values[t]
        returns = advantages + values

    flat_batch = [x.flatten(0, 1) for x in (observations, masks, actions, log_probs, advantages, returns)]
    for _ in range(epochs):
        for rows in torch.randperm(n_steps * n_envs).chunk(minibatches):
            observation, mask, action, old_log_prob, advantage, target = (x[rows] for x in flat_batch)
            choice = policy(observation, mask)
            ratio = (choice.log_prob(action) - old_log_prob).exp()
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            policy_loss = -torch.min(advantage * ratio, advantage * ratio.clamp(1 - clip, 1 + clip)).mean()
            value_loss = 0.5 * (critic(observation)[:, 0] - target).square().mean()
            loss = policy_loss + value_weight * value_loss - entropy_weight * choice.entropy().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimiser.step()
seconds = time.process_time() - start


@torch.no_grad()
def greedy(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    return policy(torch.as_tensor(flat(observation))[None], torch.as_tensor(mask)).logits.argmax().item()


compare("cleanrl", greedy, updates * n_steps * n_envs, seconds)
