"""Seeds in one run against the same seeds in turn.

`python benchmarks/seeds.py` trains N seeds of one arm as one run, as `train.py` does; apart, each of the same states is
trained by a run of one seed. Both do the same updates, compiled beforehand; the ratio of one seed to itself is the
noise of the measurement.
"""

import dataclasses

from _common import print_report, ratio_by_turn, steps_per_second, time_in_turns
from _setup import make_training_call, set_up_training

from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import make_trainer

ARM = "layout"
NUM_SEEDS = (1, 2, 4, 8)
TURNS = 5


def main() -> None:
    config = dataclasses.replace(RunConfig(), arms=(ARM,), chunk=1)
    setup = set_up_training(config)
    params = setup.params
    trainers = {}
    for num_seeds in NUM_SEEDS:
        run_config = dataclasses.replace(config, seeds=num_seeds)
        trainers[num_seeds] = make_trainer(
            run_config, setup.compiled_world.env, setup.estimator_config, setup.knowledge
        )

    # One call for each number of seeds, and one for each seed of the largest run on its own.
    calls = {}
    for num_seeds, trainer in trainers.items():
        calls[f"together {num_seeds}"] = make_training_call(trainer, trainer.init(params), params)
    for seed, state in enumerate(trainers[NUM_SEEDS[-1]].init(params)[ARM]):
        calls[f"seed {seed}"] = make_training_call(trainers[1], {ARM: [state]}, params)
    times = time_in_turns(calls, TURNS)

    results = {}
    for num_seeds in NUM_SEEDS:
        together_times = times[f"together {num_seeds}"]
        seed_times = [times[f"seed {seed}"] for seed in range(num_seeds)]
        apart_times = [sum(turn_times) for turn_times in zip(*seed_times, strict=True)]
        num_steps = num_seeds * config.steps_per_update
        results[str(num_seeds)] = {
            "together_steps_per_s": steps_per_second(together_times, num_steps),
            "apart_steps_per_s": steps_per_second(apart_times, num_steps),
            "together_over_apart": ratio_by_turn(apart_times, together_times),
        }
    print_report({"arm": ARM, "updates_per_call": config.chunk, "seeds": results})


if __name__ == "__main__":
    main()
