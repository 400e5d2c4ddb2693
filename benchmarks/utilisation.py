"""Share of the processor's peak that training uses.

`python benchmarks/utilisation.py` prints floating-point operations of the matrix products of one default update per
second, over the rate of a bare product of 1,024 x 1,024 matrices in the same turns: float32, and bfloat16 inputs summed
in float32. Operations are counted in the traced program; only matrix products count. `learning`, the recurrent forward
and backward pass over the minibatches with the optimiser, is no program of its own: its operations and seconds are
those of the update less those of the rollout in the same turn.
"""

from typing import Any

import jax
import jax.numpy as jnp
from _common import print_report, ratio_by_turn, summarize, time_in_turns
from _setup import Program, TrainingSetup, compile_program, compile_update, set_up_training

from jaxnav.runs.config import RunConfig
from jaxnav.training.ppo import collect_rollout

MATRIX_SIZE = 1024
NUM_PRODUCTS = 16
TURNS = 31


def main() -> None:
    config = RunConfig()
    setup = set_up_training(config)
    programs = {}
    for arm in config.arms:
        programs[f"{arm} update"] = compile_update(setup, arm)
        programs[f"{arm} rollout"] = compile_rollout(setup, arm)

    # Bare products, whose rate is the peak.
    matmul = jax.jit(lambda lhs, rhs: jnp.matmul(lhs, rhs, preferred_element_type=jnp.float32))
    f32_matrices = jax.random.normal(jax.random.key(0), (2, MATRIX_SIZE, MATRIX_SIZE))
    bf16_matrices = f32_matrices.astype(jnp.bfloat16)
    calls = {
        "f32": lambda: [matmul(*f32_matrices) for _ in range(NUM_PRODUCTS)],
        "bf16_to_f32": lambda: [matmul(*bf16_matrices) for _ in range(NUM_PRODUCTS)],
    }
    calls |= {name: program.call for name, program in programs.items()}
    times = time_in_turns(calls, TURNS)

    product_gflop = NUM_PRODUCTS * 2 * MATRIX_SIZE**3 / 1e9
    peak_rates = {}
    for name in ("f32", "bf16_to_f32"):
        peak_rates[name] = [product_gflop / call_time for call_time in times[name]]

    parts = {}
    for arm in config.arms:
        # Learning is the update less the rollout, in operations and in the seconds of each turn.
        update = programs[f"{arm} update"]
        rollout = programs[f"{arm} rollout"]
        update_times = times[f"{arm} update"]
        rollout_times = times[f"{arm} rollout"]
        learning_times = [
            update_time - rollout_time for update_time, rollout_time in zip(update_times, rollout_times, strict=True)
        ]
        phases = {
            "update": (update.flops, update_times),
            "rollout": (rollout.flops, rollout_times),
            "learning": (update.flops - rollout.flops, learning_times),
        }
        for phase, (flops, phase_times) in phases.items():
            phase_rates = [flops / 1e9 / phase_time for phase_time in phase_times]
            parts[f"{arm} {phase}"] = {
                "gflop": round(flops / 1e9, 2),
                "ms": summarize([1e3 * phase_time for phase_time in phase_times]),
                "share_of_update": ratio_by_turn(phase_times, update_times),
                "gflop_per_s": summarize(phase_rates),
                "over_f32_peak": ratio_by_turn(phase_rates, peak_rates["f32"]),
                "over_bf16_to_f32_peak": ratio_by_turn(phase_rates, peak_rates["bf16_to_f32"]),
            }
    print_report(
        {
            "episodes": config.ppo.num_envs,
            "rollout_steps": config.ppo.rollout,
            "hidden": config.sizes.hidden,
            "product_gflop_per_s": {name: summarize(values) for name, values in peak_rates.items()},
            "parts": parts,
        }
    )


def compile_rollout(setup: TrainingSetup, arm: str) -> Program:
    """Compile the rollout of one update."""
    learner = setup.trainer.learners[arm]
    state, _, env_params, knowledge = setup.update_arguments(arm)

    def act(state: Any, env_params: Any, knowledge: Any) -> Any:
        policy = learner.agent_loop.bind(state.params)
        return collect_rollout(
            learner.agent_loop,
            policy,
            state.agent,
            state.key,
            env_params,
            knowledge,
            num_steps=learner.config.rollout,
            use_coin=learner.counterfactual == "coin",
        )

    return compile_program(act, state, env_params, knowledge)


if __name__ == "__main__":
    main()
