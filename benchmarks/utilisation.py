"""How much of the processor training uses.

`python benchmarks/utilisation.py` prints floating-point operations of the matrix products of one default update per
second, over the rate of a bare product of 1,024 x 1,024 matrices in the same turns: float32, and bfloat16 inputs summed
in float32. Operations are counted from the program as traced; everything that is no matrix product counts as none.
`learning`, the recurrent forward and backward pass over the minibatches with the optimiser, is the update less the
rollout.
"""

import jax
import jax.numpy as jnp
from _common import in_turns, ratios, report, spread
from _phases import phases
from _setup import set_up

from jaxnav.runs.config import RunConfig

SIDE, PRODUCTS, TURNS = 1024, 16, 31
GOALS = {"learning_over_f32_peak": 0.45, "rollout_share_of_update": 0.35}


def main() -> None:
    config = RunConfig()
    programs = phases(set_up(config))

    product = jax.jit(lambda a, b: jnp.matmul(a, b, preferred_element_type=jnp.float32))
    full = jax.random.normal(jax.random.key(0), (2, SIDE, SIDE))
    half = full.astype(jnp.bfloat16)
    peaks = {
        "f32": lambda: [product(*full) for _ in range(PRODUCTS)],
        "bf16_to_f32": lambda: [product(*half) for _ in range(PRODUCTS)],
    }
    taken = in_turns(peaks | {name: program.call for name, program in programs.items()}, TURNS)
    rates = {name: [PRODUCTS * 2 * SIDE**3 / 1e9 / one for one in taken[name]] for name in peaks}

    parts = {}
    for arm in config.arms:
        whole, rolling = programs[f"{arm} update"].flops, programs[f"{arm} rollout"].flops
        times = {what: taken[f"{arm} {what}"] for what in ("update", "rollout")}
        learning = [a - b for a, b in zip(times["update"], times["rollout"], strict=True)]
        flops = {"update": whole, "rollout": rolling, "learning": whole - rolling}
        for what, seconds in (times | {"learning": learning}).items():
            achieved = [flops[what] / 1e9 / one for one in seconds]
            parts[f"{arm} {what}"] = {
                "gflop": round(flops[what] / 1e9, 2),
                "ms": spread([1e3 * one for one in seconds]),
                "share_of_update": ratios(seconds, times["update"]),
                "gflop_per_s": spread(achieved),
                "over_f32_peak": ratios(achieved, rates["f32"]),
                "over_bf16_to_f32_peak": ratios(achieved, rates["bf16_to_f32"]),
            }
    report(
        {
            "episodes": config.ppo.num_envs,
            "rollout_steps": config.ppo.rollout,
            "hidden": config.sizes.hidden,
            "goals": GOALS,
            "product_gflop_per_s": {name: spread(values) for name, values in rates.items()},
            "parts": parts,
        }
    )


if __name__ == "__main__":
    main()
