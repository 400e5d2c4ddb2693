"""Run the layout estimator on your own detections: two views of a kitchen, then two with things of a bedroom.

The layout gap rises in the last two views, because their pairs are new.

python examples/own_detections.py
"""

import jax.numpy as jnp
import numpy as np

from jaxnav.layout import LayoutEstimator, prior_from_counts

NAMES = ("Fridge", "Sink", "Mug", "Bed", "Pillow")
GOAL = "Mug"
#: How often two categories were seen together before, in homes that you know.
COUNTS = jnp.array([[0, 9, 6, 0, 0], [9, 0, 8, 0, 0], [6, 8, 0, 1, 1], [0, 0, 1, 0, 9], [0, 0, 1, 9, 0]])
VIEWS = ({"Fridge", "Sink"}, {"Sink", "Mug"}, {"Mug", "Pillow"}, {"Bed", "Fridge"})

estimator = LayoutEstimator(prior_from_counts(COUNTS))
belief = estimator.init()
goal_index = jnp.int32(NAMES.index(GOAL))
for view in VIEWS:
    # Update the belief by the visible categories, bool [K].
    presence = jnp.array([name in view for name in NAMES])
    belief = estimator.update(belief, presence)

    # The weights state next to which categories the goal is expected.
    weights = np.asarray(LayoutEstimator.goal_weights(belief, goal_index))
    weight_texts = [f"{name} {weight:.2f}" for name, weight in zip(NAMES, weights, strict=True) if name != GOAL]
    visible = " and ".join(sorted(view))
    print(f"{visible:18} gap {float(belief.gap):.2f}   the {GOAL} is expected next to: {', '.join(weight_texts)}")
