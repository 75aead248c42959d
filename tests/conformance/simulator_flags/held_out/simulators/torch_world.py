"""World model: a recurrent net trained on the feedback, then the policy is trained inside it."""
import torch
from torch import nn


class World(nn.Module):
    def __init__(self, n_obs, n_act):
        super().__init__()
        self.cell = nn.GRUCell(n_obs + n_act, 64)
        self.head = nn.Linear(64, n_obs + 1)

    def forward(self, obs, act, memory):
        memory = self.cell(torch.cat([obs, act], -1), memory)
        out = self.head(memory)
        return obs + out[..., :-1], out[..., -1], memory


def improve(world, actor, starts, steps=1000):
    optimiser = torch.optim.Adam(actor.parameters(), 1e-3)
    for _ in range(steps):
        obs = starts[torch.randint(len(starts), (32,))]
        memory = torch.zeros(32, 64)
        total = 0.0
        for _ in range(15):
            obs, reward, memory = world(obs, actor(obs), memory)
            total = total + reward.mean()
        optimiser.zero_grad()
        (-total).backward()
        optimiser.step()
