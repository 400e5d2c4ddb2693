"""Search the learning rate and the entropy bonus: six runs side by side, which share one compiled program.

python examples/learning_rates.py    # two policies of 500,000 steps in each run; writes runs/learning_rates
"""

from pathlib import Path

import numpy as np
from rich.console import Console

import jaxnav

learning_rate_grid, entropy_grid = np.meshgrid([1e-3, 4e-3, 1e-2], [0.0, 0.01])
config = jaxnav.RunConfig(run_dir=Path("runs/learning_rates"), arms=("layout",), seeds=2, total_steps=500_000)
runs = jaxnav.train_batch(config, Console(), learning_rate=learning_rate_grid.ravel(), entropy=entropy_grid.ravel())

# Success in val scenes with best actions, within the longest step limit.
for run in runs:
    success = run.success_by_budget()["val"]["layout"]["argmax"][-1]
    ppo = run.config.ppo
    print(f"learning rate {ppo.learning_rate:g}, entropy {ppo.entropy:g}: SR {100 * success:.0f} %")
