"""The train and eval commands, called in process, on a run of a few small rooms."""

from jaxnav.cli import eval as eval_command
from jaxnav.cli import train as train_command

CONFIG = """
method: org
seeds: 2
total_steps: 512  # 4 updates, 2 chunks
counterfactual: distil
chunk: 2
save_every: 1
validations: 0
worlds: {num_train: 4, num_val: 4, num_test: 4, train_step_limit: 10, step_limit: 12, large_step_limit: 14}
layout: {setting: calibrated, walks: 64, steps: 20}
sizes: {hidden: 16, view_outputs: 8, appearance: 4, row_hidden: 8, row_outputs: 2}
method_sizes: {relation_layers: 1}
ppo: {num_envs: 16, rollout: 8, epochs: 1, minibatches: 2, learning_rate: 1e-2, distil: 0.1}
"""
SHIFTS = (0.0, 1.0)
EXPERIMENT = f"""
agents:
  main: {{}}
  anonymous: {{method: anonymous, arms: [baseline]}}
measure: {{variants: [main], instrument: [main]}}
shifts: {list(SHIFTS)}
episodes: 24
base:
  direct: goal
  done_gate: true
{"".join(f"  {line}{chr(10)}" for line in CONFIG.strip().splitlines())}
"""
SEEDS, POLICIES = 2, {"baseline-0", "baseline-1", "layout-0", "layout-1"}


def train(config_file, run_dir, *options):
    return train_command.main(["--config", str(config_file), "--run-dir", str(run_dir), *map(str, options)])


def evaluate(*options):
    return eval_command.main([*map(str, options)])


def write_config(folder):
    path = folder / "tiny.yaml"
    path.write_text(CONFIG)
    return path


def study_command(folder):
    """Options of a small experiment with all its files below a folder."""
    config = folder / "experiment.yaml"
    config.write_text(EXPERIMENT)
    pages = f"{{{folder / 'docs/study.md'}: instrument}}"
    return [config, "--results", folder / "results", "--runs", folder / "runs", "--pages", pages]


def finished_run(tmp_path_factory):
    """Config file and directory of a finished run, made once for all tests.

    The directory holds what a kill while the config was being written leaves.
    """
    folder = tmp_path_factory.getbasetemp() / "finished"
    config_file, run_dir = folder / "tiny.yaml", folder / "run"
    if not folder.exists():
        run_dir.mkdir(parents=True)
        (run_dir / ".config.json.123.tmp").write_text("{")
        assert train(write_config(folder), run_dir) == 0
    return config_file, run_dir


def refusal(capsys):
    """The message of a refusal, one line."""
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    return error


def contents(folder):
    """Every file below a folder, byte for byte."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
