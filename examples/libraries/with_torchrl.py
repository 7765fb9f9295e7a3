"""TorchRL's ClipPPO on the batched environment, with a small network that scores nodes.

``BatchedMTSP`` plays 64 games at once. Unlike a network on one flat vector, this one treats all cities alike, so that
what it learns about one holds for all.
"""

import time

import numpy as np
import torch
from compare import GAME, arguments, compare
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from mtsp_env.batched import BatchedMTSP

KEYS = ["cities", "agents", "visited"]
args = arguments(__doc__, steps=60_000)
frames, epochs, minibatch = 2048, 4, 512
updates = max(1, args.steps // frames)
torch.manual_seed(args.seed)


class Nodes(nn.Module):
    """Embeds every node, beside the mean of all nodes and where the agents are going: -> (..., n, 1)."""

    def __init__(self, n_agents: int, width: int = 64):
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(6, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.head = nn.Sequential(nn.Linear(2 * width + 3 * n_agents, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(self, cities: torch.Tensor, agents: torch.Tensor, visited: torch.Tensor) -> torch.Tensor:
        from_depot = cities - cities[..., :1, :]  # the depot is row 0
        nodes = [cities, cities.norm(dim=-1, keepdim=True), from_depot, visited[..., None].float()]
        nodes = self.embed(torch.cat(nodes, -1))  # (..., n, d)
        everything = torch.cat([nodes.mean(-2), agents.flatten(-2)], -1)[..., None, :]
        return self.head(torch.cat([nodes, everything.expand(*nodes.shape[:-1], -1)], -1))


class Actor(Nodes):
    def forward(self, *observation: torch.Tensor) -> torch.Tensor:
        return super().forward(*observation)[..., 0]  # (..., n) logits


class Critic(Nodes):
    def forward(self, *observation: torch.Tensor) -> torch.Tensor:
        return super().forward(*observation).mean(-2)  # (..., 1)


actor = ProbabilisticActor(
    TensorDictModule(Actor(GAME["n_agents"]), in_keys=KEYS, out_keys=["logits"]),
    in_keys={"logits": "logits", "mask": "action_mask"},
    distribution_class=MaskedCategorical,
    return_log_prob=True,
)
critic = TensorDictModule(Critic(GAME["n_agents"]), in_keys=KEYS, out_keys=["state_value"])
advantage = GAE(gamma=1.0, lmbda=0.95, value_network=critic, average_gae=True)
loss_module = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01, critic_coeff=0.5)
optimiser = torch.optim.Adam(loss_module.parameters(), lr=1e-3)

start = time.process_time()
collector = Collector(
    BatchedMTSP(**GAME, batch_size=64, seed=args.seed),
    actor,
    frames_per_batch=frames,
    total_frames=updates * frames,
    auto_register_policy_transforms=False,
)
for batch in collector:
    batch = batch.exclude("game", ("next", "game"))  # the state of the games, which nothing here needs
    with torch.no_grad():
        advantage(batch)
    batch = batch.reshape(-1)
    for _ in range(epochs):
        for rows in torch.randperm(len(batch)).split(minibatch):
            losses = loss_module(batch[rows])
            loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(loss_module.parameters(), 1.0)
            optimiser.step()
collector.shutdown()
seconds = time.process_time() - start


@torch.no_grad()
@set_exploration_type(ExplorationType.DETERMINISTIC)
def greedy(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    seen = {key: torch.as_tensor(observation[key])[None] for key in KEYS}
    return actor(TensorDict({**seen, "action_mask": torch.as_tensor(mask)[None]}, [1]))["action"].item()


compare("torchrl", greedy, updates * frames, seconds)
