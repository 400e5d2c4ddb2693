"""Mistakes, one or more a promise, that the tests of docs/promises.md have to notice.

`python -m support.planted` in `tests` plants one after the other in a copy of the project, and ends with code 1 if the
tests of one pass all the same.
"""

import sys
from typing import NamedTuple

from support.mutants import FAST_TIER, ROOT, passes, project, survives


class Mistake(NamedTuple):
    """A mistake in a module.

    Attributes:
      module: path in `jaxnav`.
      before: a text of the module.
      after: the text in its place.
      tests: path in `tests` of the tests that have to fail.
      tier: the tests of this file, as an expression of markers.
    """

    module: str
    before: str
    after: str
    tests: str
    tier: str = FAST_TIER


INFERENCE = "twins/test_inference.py"
TENTATIVE = "policies/test_tpn.py"
PROBES = "promises/test_ppo_learns.py"
STORED = "promises/test_stored_data_is_verified.py"
NAMES = "promises/test_names_are_text.py"
LEARNER = "training/test_learner.py"
EXTRAS = "promises/test_works_without_extras.py"
MISTAKES = (
    Mistake("causal.py", "- s * counterfactual", "+ s * counterfactual", INFERENCE),
    Mistake("layout.py", "state.gap * config.decay", "state.gap * 1.01 * config.decay", INFERENCE),
    Mistake("policies/methods/org.py", "weights[..., None] * (aggregated", "(aggregated", INFERENCE),
    Mistake("policies/methods/org.py", "weights[..., None] * (aggregated", "0.9 * weights[..., None] * (aggregated",
            INFERENCE),
    Mistake("policies/methods/org.py", "jnp.swapaxes(relations, -1, -2) * features", "relations * features", INFERENCE),
    Mistake("policies/methods/org.py", "jnp.swapaxes(nnx.relu(self.edges(features.table)), -1, -2)",
            "nnx.relu(self.edges(features.table))", INFERENCE),
    Mistake("policies/methods/tpn.py", "values = known_values[..., 1:, :]", "values = known_values[..., :-1, :]",
            TENTATIVE),
    Mistake("policies/methods/tpn.py", "(keys @ state[..., None])[..., 0]",
            "(keys @ state[..., None])[..., 0] / np.sqrt(state.shape[-1])", TENTATIVE),
    Mistake("policies/spatial_memory.py", "stride: int = 2", "stride: int = 1", INFERENCE),
    Mistake("training/ppo.py", "policy_loss = -masked_mean(", "policy_loss = masked_mean(", PROBES, "slow"),
    Mistake("training/ppo.py", "reward + gamma * next_value - value", "reward + next_value - value", PROBES,
            "slow"),
    Mistake("training/ppo.py", "scalars.value_weight * value_loss", "0.0 * value_loss", PROBES, "slow"),
    Mistake("causal.py", "jnp.where(s == 0, logits, effect)", "effect", "test_causal.py"),
    Mistake("causal.py", "gap - epsilon)", "gap - float(epsilon))", "test_causal.py"),
    Mistake("evaluation/grid.py", "success * best_length / length", "success * length / best_length",
            "evaluation/test_episodes.py"),
    Mistake("evaluation/episodes.py", "default_rng([seed, len", "default_rng([len", "evaluation/test_episodes.py"),
    Mistake("training/ppo.py", "max_consecutive_errors=2**30", "max_consecutive_errors=0", LEARNER),
    Mistake("store/checkpoint.py", "if _PLAIN_PATH.fullmatch(str(folder)):", "if str(folder):",
            "promises/test_paths_are_names.py"),
    Mistake("store/export.py", '"""Exported', 'import jax  # noqa\n"""Exported', "store/test_export.py"),
    Mistake("store/export.py", "FORMAT_VERSION = 3", "FORMAT_VERSION = 2", "promises/test_old_versions.py"),
    Mistake("store/checkpoint.py", "if file_digests.get(file_name) != digest", "if False", STORED),
    Mistake("store/export.py", 'if params_sha256 != policy["params_sha256"]', "if False", STORED),
    Mistake("store/files.py", 'verify_digest(source, row, "restore the file, or remove the line")', "row", STORED),
    Mistake("store/files.py", "fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)", "pass",
            "promises/test_one_writer.py"),
    Mistake("runs/train.py", "signal.signal(handled_number, signal.SIG_DFL)", "pass", "promises/test_interrupts.py"),
    Mistake("plain_console.py", '"markup": False', '"markup": True', NAMES),
    Mistake("cli/console.py", '(escape_control_chars(buffer.read(), keep="\\n") for', "(buffer.read() for", NAMES),
    Mistake("cli/console.py", "case MemoryError():", "case ZeroDivisionError():", "promises/test_bounds.py"),
    Mistake("__init__.py", '"""Layout', 'import matplotlib  # noqa\n"""Layout', EXTRAS),
)  # fmt: skip


def main() -> bool:
    """Plant every mistake, print what becomes of it, and return whether all were noticed."""
    noticed = True
    with project() as folder:
        for tests, tier in dict.fromkeys((mistake.tests, mistake.tier) for mistake in MISTAKES):
            if not passes(folder, tests, tier):
                raise SystemExit(f"{tests} fails without a mistake; fix it first")
        for mistake in MISTAKES:
            source = (ROOT / "jaxnav" / mistake.module).read_text()
            if mistake.before not in source:
                raise SystemExit(f"{mistake.module} holds no {mistake.before!r}; bring the list up to date")
            mutant_source = source.replace(mistake.before, mistake.after, 1)
            alive = survives(folder, mistake.module, mutant_source, mistake.tests, mistake.tier)
            noticed &= not alive
            print(
                "OVERLOOKED" if alive else "noticed   ", mistake.module, repr(mistake.after), mistake.tests, flush=True
            )
    return noticed


if __name__ == "__main__":
    sys.exit(not main())
