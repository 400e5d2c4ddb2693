"""Run the layout estimator on detections of your own: here three views of a kitchen, then of something else.

python examples/own_detections.py
"""

import jax.numpy as jnp
import numpy as np

from jaxnav.layout import LayoutEstimator, prior_from_counts

NAMES = ("Fridge", "Sink", "Mug", "Bed", "Pillow")
#: How often two of them were seen together before, in homes that you know.
COUNTS = jnp.array([[0, 9, 6, 0, 0], [9, 0, 8, 0, 0], [6, 8, 0, 1, 1], [0, 0, 1, 0, 9], [0, 0, 1, 9, 0]])
VIEWS = ({"Fridge", "Sink"}, {"Sink", "Mug"}, {"Mug", "Pillow"}, {"Bed", "Fridge"})

estimator = LayoutEstimator(prior_from_counts(COUNTS))
belief, goal = estimator.init(), jnp.int32(NAMES.index("Mug"))
for view in VIEWS:
    belief = estimator.update(belief, jnp.array([name in view for name in NAMES]))
    weights = np.asarray(LayoutEstimator.goal_weights(belief, goal))
    expected = ", ".join(f"{name} {weight:.2f}" for name, weight in zip(NAMES, weights, strict=True) if name != "Mug")
    print(f"{' and '.join(sorted(view)):18} gap {float(belief.gap):.2f}   the Mug is expected beside: {expected}")
