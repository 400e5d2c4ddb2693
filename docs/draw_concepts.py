"""Draw the figures of docs/concepts.md: a belief before and after a view, and the layout gap along episodes.

`python docs/draw_concepts.py` writes docs/images/concepts/belief.png and gap.png in less than a minute. The episodes
are those of the packaged policy `rooms-org` in generated val rooms; the best action is taken at every step.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxnav
from jaxnav.causal import removal_weight
from jaxnav.choices import EstimatorName
from jaxnav.env.objectnav import EnvParams
from jaxnav.env.render import (
    AGENT_COLOR,
    GOAL_COLOR,
)
from jaxnav.layout import EstimatorConfig, LayoutEstimator, prior_from_counts
from jaxnav.viz.style import (
    MUTED_COLOR,
    TEXT_COLOR,
    freeze_axes_positions,
    make_panels,
    save_figure,
    set_panel_title,
)

FOLDER = Path(__file__).parent / "images" / "concepts"

NUM_EPISODES = 1024
NUM_STEPS = 41
EPSILON = 0.5
#: Colour of each layout shift.
SHIFT_COLORS = {0: AGENT_COLOR, 1: GOAL_COLOR}
#: Title of the panels for each setting of the layout estimator; None is the calibrated one of the policy.
GAP_TITLES: dict[EstimatorName | None, str] = {
    None: "Equation 5: change of the belief",
    "learned": "Gap learned: probability of another layout",
}


def draw_belief() -> Figure:
    """Draw the expected shares of the worked example, before and after a mug is seen with a bed."""
    # The estimator of the page: mug, coffee machine, bed.
    categories = ("mug", "coffee machine", "bed")
    counts = jnp.array([[0, 6, 2], [6, 0, 2], [2, 2, 0]])
    config = EstimatorConfig(strength=None, uniform=0.0)
    estimator = LayoutEstimator(prior_from_counts(counts, config), config)
    prior_belief = estimator.init()
    belief = estimator.update(prior_belief, jnp.array([True, False, True]))
    shares_before = np.asarray(estimator.expectation(prior_belief))
    shares_after = np.asarray(estimator.expectation(belief))

    # One panel per row of the belief that changes: the shares of the two other categories.
    figure, panels = make_panels(1, 2, height=2.3, sharey=True)
    for axes, row in zip(panels[0], (0, 2), strict=True):
        others = [category for category in range(3) if category != row]
        positions = np.arange(2)
        for offset, shares, color, label in (
            (-0.2, shares_before, MUTED_COLOR, "before the view"),
            (0.2, shares_after, AGENT_COLOR, "after the view"),
        ):
            heights = shares[row, others]
            axes.bar(positions + offset, heights, width=0.36, color=color, label=label)
            for position, height in zip(positions + offset, heights, strict=True):
                axes.text(position, height + 0.02, f"{height:.2f}", ha="center", fontsize=8, color=TEXT_COLOR)
        axes.set_xticks(positions, [categories[category] for category in others])
        axes.set_ylim(0, 1)
        set_panel_title(axes, f"A {categories[row]} is seen: what is seen with it?")
    panels[0, 0].set_ylabel("expected share w")
    panels[0, 1].legend(frameon=False, fontsize=8, loc="upper right")
    return figure


class GapMeans(NamedTuple):
    """Means over the episodes that still run, by step.

    Attributes:
      gap: [T], layout gap D.
      weight: [T], weight of the removed logits.
      num_running: int [T], episodes that still run.
    """

    gap: np.ndarray
    weight: np.ndarray
    num_running: np.ndarray


def measure_gap(setting: EstimatorName | None, shift: int) -> GapMeans:
    """Measure the gap of the packaged policy, from whose decisions no experience is removed.

    Args:
      setting: of the layout estimator; None for the policy's own. The actions do not depend on it.
      shift: layout shift of the rooms.
    """
    env, params = jaxnav.make("rooms", split="val", shift=shift)
    policy = jaxnav.load_policy("rooms-org", setting, env=env)

    def run_episode(key: jax.Array, params: EnvParams) -> tuple[jax.Array, jax.Array]:
        """Act until Done; return gap and whether the episode still runs, by step."""

        def step(carry, _):
            state, memory, moved, ended = carry
            _, heading, horizon = env.task.rules.split_pose(state.pose)
            observation = env.observe(state, params)
            # With a threshold of 1 no experience is removed.
            output = policy.decide(observation, memory, 1.0, heading=heading, moved=moved, horizon=horizon)
            assert output.gap is not None
            choice = jnp.argmax(output.logits).astype(jnp.int32)
            action, memory = policy.apply_choice(output, choice, memory.room)

            next_state, _, done, _ = env.advance(state, action, params)
            moved = env.cell_of_pose(next_state.pose) != env.cell_of_pose(state.pose)
            return (next_state, memory, moved, ended | done), (output.gap, ~ended)

        _, state = env.reset(key, params)
        memory = policy.begin(params.room[state.scene])
        start = (state, memory, jnp.bool_(False), jnp.bool_(False))
        _, trace = jax.lax.scan(step, start, length=NUM_STEPS)
        return trace

    keys = jax.random.split(jax.random.key(0), NUM_EPISODES)
    gap, running = jax.jit(jax.vmap(run_episode, (0, None)))(keys, params)
    num_running = np.asarray(running).sum(axis=0)
    weight = np.asarray(removal_weight(gap, EPSILON))
    gap_mean = (np.asarray(gap) * running).sum(axis=0) / num_running
    weight_mean = (weight * running).sum(axis=0) / num_running
    return GapMeans(np.asarray(gap_mean), np.asarray(weight_mean), num_running)


def draw_gap() -> Figure:
    """Draw gap and removal weight along episodes, at both shifts, for two measures of the gap."""
    figure, panels = make_panels(2, 2, height=3.8, sharex=True, sharey="row")
    for column, (setting, title) in enumerate(GAP_TITLES.items()):
        gap_axes, weight_axes = panels[:, column]
        for shift, color in SHIFT_COLORS.items():
            means = measure_gap(setting, shift)
            gap_axes.plot(means.gap, color=color, lw=1.6, label=f"shift {shift}")
            weight_axes.plot(means.weight, color=color, lw=1.6)
            print(f"{setting or 'calibrated'}, shift {shift}: {means.num_running[-1]} episodes run at the last step")
        gap_axes.axhline(EPSILON, color=MUTED_COLOR, lw=0.8, ls="--")
        set_panel_title(gap_axes, title)
        weight_axes.set_xlabel("step of the episode")

    # Labels of the rows, and what the lines are.
    gap_axes, weight_axes = panels[:, 0]
    gap_axes.set(ylabel="layout gap D", ylim=(0, 0.75))
    weight_axes.set(ylabel="removal weight s", ylim=(0, None))
    gap_axes.text(40, EPSILON + 0.015, "epsilon", ha="right", fontsize=8, color=MUTED_COLOR)
    gap_axes.legend(frameon=False, fontsize=8, loc="lower left")
    return figure


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    save_figure(freeze_axes_positions(draw_belief()), FOLDER / "belief.png")
    save_figure(freeze_axes_positions(draw_gap()), FOLDER / "gap.png")
