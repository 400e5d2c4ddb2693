# pyright: reportMissingImports=false
"""The released per-step flow in PyTorch, for `inference.py`.

The code is written from the equations. Every step makes two whole passes of the network, the second with both direct
embeddings set to zero, and each pass asks the estimator first: 5 counts for every visible category in every row, the
divergence summed over rows by `torch.distributions` when the visible set is new, decayed by 0.8 when it is not (so
always at the second pass). The logits are (1 + s) a - s a_bar, s = D - 0.5, with the gate on Done. Two networks: of the
released sizes (7 x 7 image features, two LSTM layers of 512), and of jaxnav's layers and sizes.

The process reads lines `network threads walks` and answers each with the walk's gaps in JSON, gradients off.
"""

import itertools
import json
import sys

import numpy as np
import torch
from torch import nn
from torch.distributions import Dirichlet, kl_divergence

NUM_ACTIONS = 6
DONE = 5
# Columns of the detection table.
CONFIDENCE = 1
GOAL = 8

#: Inputs of one step, by name.
View = dict[str, torch.Tensor]
#: Recurrent state and previous action.
Memory = tuple[torch.Tensor, ...]


class Estimator:
    """Layout belief of one episode, as released."""

    def __init__(self, prior: torch.Tensor) -> None:
        self.alpha = prior
        self.gap = torch.zeros(())
        self.past_views = torch.zeros(20, len(prior))

    def __call__(self, presence: torch.Tensor) -> torch.Tensor:
        """Update the belief by the visible categories; return the expected co-occurrence w."""
        novelty = (self.past_views - presence).square().mean(dim=-1).min()
        if novelty > 1e-4 and presence.sum() > 1:
            self.past_views = torch.cat([presence[None], self.past_views[1:]])
            posterior = self.alpha + 5.0 * presence
            identity = torch.eye(len(presence))
            divergence = kl_divergence(Dirichlet(posterior + identity), Dirichlet(self.alpha + identity)).sum()
            self.gap = torch.tanh(divergence.abs())
            self.alpha = posterior
        else:
            self.gap = 0.8 * self.gap
        return self.alpha / self.alpha.sum(dim=-1, keepdim=True) + torch.eye(len(presence))


def make_perceptron(*widths: int, final_relu: bool = True) -> nn.Sequential:
    """Return linear layers, each followed by a ReLU."""
    layers = []
    for num_inputs, num_outputs in itertools.pairwise(widths):
        layers += [nn.Linear(num_inputs, num_outputs), nn.ReLU()]
    return nn.Sequential(*(layers if final_relu else layers[:-1]))


class Relations(nn.Module):
    """Appearances of the categories, aggregated by a relation between their boxes, R^T X."""

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
    """The released network, on given image and box features."""

    def __init__(self, categories: int) -> None:
        super().__init__()
        self.image = nn.Conv2d(512, 64, 1)
        self.direct = Relations(6, categories, 2, bias=True)
        self.relations = Relations(6, categories, 4, bias=True)
        self.direct_maps = make_perceptron(518, 128, 49, final_relu=False)
        self.maps = make_perceptron(518, 128, 49)
        self.previous = make_perceptron(NUM_ACTIONS, 10)
        self.fuse = nn.Conv2d(64 + 2 * categories + 10, 64, 1)
        self.core = nn.LSTM(64 * 49, 512, num_layers=2)
        self.actor = nn.Linear(512, NUM_ACTIONS)
        self.critic = nn.Sequential(nn.Linear(512, 64), nn.Linear(64, 1))

    def start(self) -> Memory:
        return torch.zeros(2, 1, 512), torch.zeros(2, 1, 512), torch.full((NUM_ACTIONS,), 1 / NUM_ACTIONS)

    def forward(
        self, view: View, weights: torch.Tensor, memory: Memory, use_direct: bool
    ) -> tuple[torch.Tensor, Memory]:
        hidden, cell, previous_action = memory
        boxes = view["boxes"]
        appearance = view["appearance"]

        # The direct pathways, zero in the counterfactual pass.
        scene = torch.relu(self.image(view["image"]))[0]
        direct_table = torch.cat([self.direct(boxes, appearance), boxes], dim=-1)
        goal_maps = self.direct_maps(direct_table).view(-1, 7, 7)
        if not use_direct:
            scene = torch.zeros_like(scene)
            goal_maps = torch.zeros_like(goal_maps)

        # Experience, weighted by the layout.
        table = torch.cat([self.relations(boxes, appearance), boxes], dim=-1)
        experience = self.maps(table * weights[:, None]).view(-1, 7, 7)

        action = self.previous(previous_action)[:, None, None].expand(-1, 7, 7)
        fused = torch.relu(self.fuse(torch.cat([scene, experience, goal_maps, action])[None]))
        output, (hidden, cell) = self.core(fused.view(1, 1, -1), (hidden, cell))
        logits = self.actor(output[0, 0])
        self.critic(output[0, 0])  # part of the measured work
        return logits, (hidden, cell, previous_action)

    def remember(self, memory: Memory, logits: torch.Tensor) -> Memory:
        return *memory[:2], torch.softmax(logits, dim=-1)


class Equal(nn.Module):
    """jaxnav's layers and sizes (`ORG` with its defaults)."""

    def __init__(self, categories: int, view: int, features: int, sizes: dict[str, int]) -> None:
        super().__init__()
        width = sizes["appearance"]
        hidden_size = sizes["hidden"]
        row_widths = (width + features, sizes["row_hidden"], sizes["row_outputs"])
        self.appearance = nn.Parameter(torch.randn(categories, width))
        self.goal_embedding = nn.Parameter(torch.randn(categories, width))
        self.view = make_perceptron(view, sizes["view_outputs"])
        self.direct_maps = make_perceptron(*row_widths)
        self.maps = make_perceptron(*row_widths)
        self.relations = Relations(features, categories, sizes["relation_layers"], bias=False)
        num_fused = sizes["view_outputs"] + 2 * categories * sizes["row_outputs"] + width + NUM_ACTIONS
        self.fuse = make_perceptron(num_fused, hidden_size)
        self.core = nn.GRUCell(hidden_size, hidden_size)
        self.actor = nn.Linear(hidden_size, NUM_ACTIONS)
        self.critic = nn.Linear(hidden_size, 1)

    def start(self) -> Memory:
        return torch.zeros(self.core.hidden_size), torch.zeros(NUM_ACTIONS)

    def forward(
        self, view: View, weights: torch.Tensor, memory: Memory, use_direct: bool
    ) -> tuple[torch.Tensor, Memory]:
        hidden, previous_action = memory
        table = view["table"]
        appearance = table[:, :1] * self.appearance

        # The direct pathways, zero in the counterfactual pass.
        scene = self.view(view["view"])
        detections = self.direct_maps(torch.cat([appearance, table], dim=-1)).flatten()
        goal = torch.cat([detections, table[:, GOAL] @ self.goal_embedding])
        if not use_direct:
            scene = torch.zeros_like(scene)
            goal = torch.zeros_like(goal)

        # Experience, weighted by the layout.
        table = torch.cat([self.relations(table, appearance), table], dim=-1)
        experience = self.maps(table * weights[:, None]).flatten()

        hidden = self.core(self.fuse(torch.cat([scene, goal, experience, previous_action])), hidden)
        logits = self.actor(hidden)
        self.critic(hidden)  # part of the measured work
        return logits, (hidden, previous_action)

    def remember(self, memory: Memory, logits: torch.Tensor) -> Memory:
        return memory[0], nn.functional.one_hot(logits.argmax(), NUM_ACTIONS).float()


def decide(network: Released | Equal, estimator: Estimator, view: View, memory: Memory) -> tuple[int, Memory]:
    """Return the action of one step and the next memory."""
    presence = view["table"][:, 0]
    goal = int(view["table"][:, GOAL].argmax())
    done_gate = 0.58 * view["table"][goal, CONFIDENCE]

    def run_pass(use_direct: bool) -> tuple[torch.Tensor, Memory]:
        logits, next_memory = network(view, estimator(presence)[:, goal], memory, use_direct)
        return torch.cat([logits[:DONE], done_gate * logits[DONE:]]), next_memory

    factual, next_memory = run_pass(use_direct=True)
    counterfactual, _ = run_pass(use_direct=False)
    strength = (estimator.gap - 0.5).clamp(-0.001, 0.8)
    logits = (1 + strength) * factual - strength * counterfactual
    return int(logits.argmax()), network.remember(next_memory, logits)


def walk(network: Released | Equal, prior: torch.Tensor, views: list[View]) -> list[float]:
    """Return the gaps of one episode's steps."""
    estimator = Estimator(prior)
    memory = network.start()
    gaps = []
    for view in views:
        _, memory = decide(network, estimator, view, memory)
        gaps.append(float(estimator.gap))
    return gaps


def main() -> None:
    inputs = {name: torch.from_numpy(array) for name, array in np.load(sys.argv[1]).items()}
    table = inputs["table"]  # [T, K, features]
    view_cells = inputs["view"]  # [T, cells]
    num_categories, num_features = table.shape[1:]

    torch.manual_seed(0)
    networks = {
        "released": Released(num_categories).eval(),
        "equal": Equal(num_categories, view_cells.shape[1], num_features, json.loads(sys.argv[2])).eval(),
    }

    # Random numbers stand for images and for the appearance of detected categories; only their number matters.
    boxes = table[:, :, [2, 3, 4, 7, CONFIDENCE, GOAL]]
    appearance = table[:, :, :1] * torch.randn(num_categories, 512)
    images = torch.rand(len(table), 1, 512, 7, 7)
    views = []
    for t in range(len(table)):
        view = {"table": table[t], "view": view_cells[t], "boxes": boxes[t]}
        view |= {"appearance": appearance[t], "image": images[t]}
        views.append(view)

    counts = {}
    for name, network in networks.items():
        counts[name] = sum(parameter.numel() for parameter in network.parameters())
    description = {"torch": torch.__version__, "threads": torch.get_num_threads(), "parameters": counts}
    print(json.dumps(description), flush=True)

    for line in sys.stdin:
        name, num_threads, num_walks = line.split()
        torch.set_num_threads(int(num_threads))
        gaps = []
        with torch.inference_mode():
            for _ in range(int(num_walks)):
                gaps.append(walk(networks[name], inputs["prior"], views))
        print(json.dumps(gaps[0]), flush=True)


if __name__ == "__main__":
    main()
