# pyright: reportMissingImports=false
"""The released per-step flow in PyTorch, for `inference.py`.

It is written from the equations. Every step makes two whole passes of the network, the second with both direct
embeddings set to zero, and each pass asks the estimator first: 5 counts for every visible category in every row, the
divergence summed over rows by `torch.distributions` when the visible set is new, decayed by 0.8 when it is not (so
always at the second pass). The logits are (1 + s) a - s a_bar, s = D - 0.5, with the gate on Done. Two networks: of the
released sizes (7 x 7 image features, two LSTM layers of 512), and of jaxnav's layers and sizes.

It reads lines `network threads walks` and answers each with the walk's gaps in JSON, gradients off.
"""

import itertools
import json
import sys

import numpy as np
import torch
from torch import nn
from torch.distributions import Dirichlet, kl_divergence

ACTIONS, DONE, CONFIDENCE, GOAL = 6, 5, 1, 8  # the last two are columns of the table
Seen = dict[str, torch.Tensor]
Memory = tuple[torch.Tensor, ...]


class Estimator:
    """Hold the layout belief of one episode, as released."""

    def __init__(self, prior: torch.Tensor) -> None:
        self.alpha, self.gap = prior, torch.zeros(())
        self.memory = torch.zeros(20, len(prior))

    def __call__(self, presence: torch.Tensor) -> torch.Tensor:
        """Take in what is visible; return the expected co-occurrence w."""
        novelty = (self.memory - presence).square().mean(dim=-1).min()
        if novelty > 1e-4 and presence.sum() > 1:
            self.memory = torch.cat([presence[None], self.memory[1:]])
            posterior, identity = self.alpha + 5.0 * presence, torch.eye(len(presence))
            divergence = kl_divergence(Dirichlet(posterior + identity), Dirichlet(self.alpha + identity)).sum()
            self.gap, self.alpha = torch.tanh(divergence.abs()), posterior
        else:
            self.gap = 0.8 * self.gap
        return self.alpha / self.alpha.sum(dim=-1, keepdim=True) + torch.eye(len(presence))


def perceptron(*widths: int, last: bool = True) -> nn.Sequential:
    """Stack linear layers and ReLUs; `last` keeps the final ReLU."""
    layers = [layer for pair in itertools.pairwise(widths) for layer in (nn.Linear(*pair), nn.ReLU())]
    return nn.Sequential(*(layers if last else layers[:-1]))


class Relations(nn.Module):
    """Relate the appearances of categories by their boxes, R^T X."""

    def __init__(self, inputs: int, categories: int, layers: int, bias: bool) -> None:
        super().__init__()
        self.edges = nn.Linear(inputs, categories)
        self.mix = nn.ModuleList(nn.Linear(categories, categories, bias=bias) for _ in range(layers))

    def forward(self, table: torch.Tensor, appearance: torch.Tensor) -> torch.Tensor:
        relation = torch.relu(self.edges(table)).T
        for layer in self.mix:
            relation = torch.relu(layer(relation))
        return relation @ appearance


class Released(nn.Module):
    """Run the released network on ready image and box features."""

    def __init__(self, categories: int) -> None:
        super().__init__()
        self.image = nn.Conv2d(512, 64, 1)
        self.direct, self.relations = (Relations(6, categories, layers, bias=True) for layers in (2, 4))
        self.direct_maps, self.maps = perceptron(518, 128, 49, last=False), perceptron(518, 128, 49)
        self.previous = perceptron(ACTIONS, 10)
        self.fuse = nn.Conv2d(64 + 2 * categories + 10, 64, 1)
        self.core = nn.LSTM(64 * 49, 512, num_layers=2)
        self.actor, self.critic = nn.Linear(512, ACTIONS), nn.Sequential(nn.Linear(512, 64), nn.Linear(64, 1))

    def start(self) -> Memory:
        return torch.zeros(2, 1, 512), torch.zeros(2, 1, 512), torch.full((ACTIONS,), 1 / ACTIONS)

    def forward(self, seen: Seen, weights: torch.Tensor, memory: Memory, direct: bool) -> tuple[torch.Tensor, Memory]:
        hidden, cell, previous = memory
        boxes, appearance = seen["boxes"], seen["appearance"]
        scene = torch.relu(self.image(seen["image"]))[0]
        sought = self.direct_maps(torch.cat([self.direct(boxes, appearance), boxes], dim=-1)).view(-1, 7, 7)
        if not direct:
            scene, sought = torch.zeros_like(scene), torch.zeros_like(sought)
        table = torch.cat([self.relations(boxes, appearance), boxes], dim=-1)
        experience = self.maps(table * weights[:, None]).view(-1, 7, 7)
        action = self.previous(previous)[:, None, None].expand(-1, 7, 7)
        fused = torch.relu(self.fuse(torch.cat([scene, experience, sought, action])[None]))
        out, (hidden, cell) = self.core(fused.view(1, 1, -1), (hidden, cell))
        logits, _ = self.actor(out[0, 0]), self.critic(out[0, 0])
        return logits, (hidden, cell, previous)

    def remember(self, memory: Memory, logits: torch.Tensor) -> Memory:
        return *memory[:2], torch.softmax(logits, dim=-1)


class Equal(nn.Module):
    """Run jaxnav's layers and sizes (`ORG` with its defaults)."""

    def __init__(self, categories: int, view: int, features: int, sizes: dict[str, int]) -> None:
        super().__init__()
        width, hidden = sizes["appearance"], sizes["hidden"]
        rows = (width + features, sizes["row_hidden"], sizes["row_outputs"])
        self.appearance, self.sought = (nn.Parameter(torch.randn(categories, width)) for _ in range(2))
        self.view = perceptron(view, sizes["view_outputs"])
        self.direct_maps, self.maps = perceptron(*rows), perceptron(*rows)
        self.relations = Relations(features, categories, sizes["relation_layers"], bias=False)
        fused = sizes["view_outputs"] + 2 * categories * sizes["row_outputs"] + width + ACTIONS
        self.fuse, self.core = perceptron(fused, hidden), nn.GRUCell(hidden, hidden)
        self.actor, self.critic = nn.Linear(hidden, ACTIONS), nn.Linear(hidden, 1)

    def start(self) -> Memory:
        return torch.zeros(self.core.hidden_size), torch.zeros(ACTIONS)

    def forward(self, seen: Seen, weights: torch.Tensor, memory: Memory, direct: bool) -> tuple[torch.Tensor, Memory]:
        hidden, previous = memory
        table, appearance = seen["table"], seen["table"][:, :1] * self.appearance
        scene = self.view(seen["view"])
        maps = self.direct_maps(torch.cat([appearance, table], dim=-1)).flatten()
        sought = torch.cat([maps, table[:, GOAL] @ self.sought])
        if not direct:
            scene, sought = torch.zeros_like(scene), torch.zeros_like(sought)
        table = torch.cat([self.relations(table, appearance), table], dim=-1)
        experience = self.maps(table * weights[:, None]).flatten()
        hidden = self.core(self.fuse(torch.cat([scene, sought, experience, previous])), hidden)
        logits, _ = self.actor(hidden), self.critic(hidden)
        return logits, (hidden, previous)

    def remember(self, memory: Memory, logits: torch.Tensor) -> Memory:
        return memory[0], nn.functional.one_hot(logits.argmax(), ACTIONS).float()


def decide(network: Released | Equal, estimator: Estimator, seen: Seen, memory: Memory) -> tuple[int, Memory]:
    """Take one step: return the action and what is remembered."""
    presence, goal = seen["table"][:, 0], int(seen["table"][:, GOAL].argmax())
    gate = 0.58 * seen["table"][goal, CONFIDENCE]
    passes = []
    for direct in (True, False):
        logits, after = network(seen, estimator(presence)[:, goal], memory, direct)
        passes.append((torch.cat([logits[:DONE], gate * logits[DONE:]]), after))
    (factual, after), (counterfactual, _) = passes
    s = (estimator.gap - 0.5).clamp(-0.001, 0.8)
    logits = (1 + s) * factual - s * counterfactual
    return int(logits.argmax()), network.remember(after, logits)


def walk(network: Released | Equal, prior: torch.Tensor, views: list[Seen]) -> list[float]:
    """Return the gaps of one episode's steps."""
    estimator, memory, gaps = Estimator(prior), network.start(), []
    for seen in views:
        _, memory = decide(network, estimator, seen, memory)
        gaps.append(float(estimator.gap))
    return gaps


def main() -> None:
    inputs = {name: torch.from_numpy(array) for name, array in np.load(sys.argv[1]).items()}
    table, view = inputs["table"], inputs["view"]  # [T, K, features], [T, cells]
    categories, features = table.shape[1:]
    torch.manual_seed(0)
    networks = {
        "released": Released(categories).eval(),
        "equal": Equal(categories, view.shape[1], features, json.loads(sys.argv[2])).eval(),
    }
    # Random numbers stand for images and for the appearance of detected categories; only their number matters.
    boxes, detected = table[:, :, [2, 3, 4, 7, CONFIDENCE, GOAL]], table[:, :, :1] * torch.randn(categories, 512)
    views = [
        {"table": table[t], "view": view[t], "boxes": boxes[t], "appearance": detected[t], "image": image}
        for t, image in enumerate(torch.rand(len(table), 1, 512, 7, 7))
    ]
    counts = {name: sum(p.numel() for p in network.parameters()) for name, network in networks.items()}
    print(
        json.dumps({"torch": torch.__version__, "threads": torch.get_num_threads(), "parameters": counts}), flush=True
    )
    for line in sys.stdin:
        name, threads, walks = line.split()
        torch.set_num_threads(int(threads))
        with torch.inference_mode():
            gaps = [walk(networks[name], inputs["prior"], views) for _ in range(int(walks))]
        print(json.dumps(gaps[0]), flush=True)


if __name__ == "__main__":
    main()
