"""What an evaluation is about: a run, a policy, or an agent of any other kind.

`find_subject` turns the argument of `jaxnav.evaluate` into policies with their configuration, or into agents that act
on observations.
"""

import difflib
import importlib
import os
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxnav.errors import InputError
from jaxnav.evaluation.agents import is_agent
from jaxnav.policies.methods import method_label
from jaxnav.runs.config import RunConfig
from jaxnav.runs.loaded_policy import LoadedPolicy
from jaxnav.runs.policies import (
    CONFIG_FILE,
    Policies,
    config_for_task,
    is_policy,
    list_packaged_policies,
    load_policy_as_run,
)
from jaxnav.runs.run import Run
from jaxnav.store.files import expand_home


class PolicySubject(NamedTuple):
    """Policies to evaluate.

    Attributes:
      name: run directory, folder or name of the policy.
      config: configuration of the run, or one that stands for it.
      policies: policies of all arms and seeds.
      run: the run; None for a single policy.
    """

    name: str
    config: RunConfig
    policies: Policies
    run: Run | None


class AgentSubject(NamedTuple):
    """Agents to evaluate that act on observations.

    Attributes:
      name: name of the agent in tables.
      agents: the agent, or one for each training seed.
    """

    name: str
    agents: tuple[Any, ...]


def find_subject(subject: Any) -> PolicySubject | AgentSubject:
    """Find out what to evaluate.

    Args:
      subject: a run or its directory; an exported policy, its folder, or the name of a packaged one; an agent (see
        `jaxnav.evaluation.agents`), a list of agents of several training seeds, or `package.module:AGENT`.

    Raises:
      InputError: none of them.
    """
    if isinstance(subject, Run):
        return PolicySubject(str(subject.config.run_dir), subject.config, subject.policies(), subject)
    if isinstance(subject, LoadedPolicy):
        config, policies = policy_in_memory_as_run(subject)
        return PolicySubject(f"{method_label(subject.spec.method.name)} policy", config, policies, None)
    if isinstance(subject, str | os.PathLike):
        return _find_named_subject(Path(subject) if isinstance(subject, os.PathLike) else subject)

    # Several agents are training seeds of one; a NamedTuple with `init` and `act` is an agent.
    if isinstance(subject, list | tuple) and not is_agent(subject):
        if not subject:
            raise InputError("the list of agents is empty; give at least one agent")
        if any(isinstance(member, LoadedPolicy) for member in subject):
            raise InputError("a list of policies is no agent; give one policy at a time, or the run that they are of")
        return AgentSubject(_agent_name(subject[0]), tuple(subject))
    return AgentSubject(_agent_name(subject), (subject,))


def _agent_name(agent: Any) -> str:
    """Name of an agent in tables and messages: that of its function or class."""
    return getattr(agent, "__name__", type(agent).__name__)


def _find_named_subject(name: str | Path) -> PolicySubject | AgentSubject:
    """Find the run, policy or agent that a path or a name stands for."""
    text = os.fspath(name)
    folder = expand_home(name)
    if isinstance(name, str) and re.fullmatch(r"[\w.]+:\w+", text) and not folder.exists():
        return _import_subject(text)
    if is_policy(name):
        config, policies = load_policy_as_run(name)
        return PolicySubject(text, config, policies, None)

    # A name without a folder may be a misspelt policy.
    if not folder.exists() and os.sep not in text:
        close_names = difflib.get_close_matches(text, list_packaged_policies(), n=3)
        if close_names:
            raise InputError(
                f"{text}: holds no run ({CONFIG_FILE} is missing) and is no policy; did you mean "
                f"{' or '.join(map(repr, close_names))}?"
            )
    return find_subject(Run.open(name))


def _import_subject(name: str) -> PolicySubject | AgentSubject:
    """Import `package.module:AGENT`; modules of the working directory are found, too.

    Raises:
      InputError: the module cannot be imported, or has no such attribute.
    """
    module_name, _, attribute = name.partition(":")
    working_directory = os.getcwd()
    has_path = working_directory in sys.path or "" in sys.path
    if not has_path:
        sys.path.insert(0, working_directory)
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever the foreign module raises, `sys.exit` of a script included
        raise InputError(
            f"{name}: cannot be imported ({type(error).__name__}: {error}); give package.module:AGENT"
        ) from error
    finally:
        if not has_path and working_directory in sys.path:
            sys.path.remove(working_directory)

    if not hasattr(module, attribute):
        close_names = difflib.get_close_matches(attribute, vars(module), n=3)
        hint = f"did you mean {' or '.join(close_names)}?" if close_names else "give the name of an agent in it"
        raise InputError(f"{name}: {module_name} has no {attribute}; {hint}")
    subject = find_subject(getattr(module, attribute))
    return subject._replace(name=attribute) if isinstance(subject, AgentSubject) else subject


def policy_in_memory_as_run(policy: LoadedPolicy) -> tuple[RunConfig, Policies]:
    """Treat a policy in memory as if a run had trained it with one seed.

    Raises:
      InputError: no generated world has the policy's task.
    """
    arm = "baseline" if policy.estimator_config is None else "layout"
    config = config_for_task(policy.task, policy.spec.method.name, arm)
    if config is None:
        raise InputError(
            "the policy was trained for a task that no generated world has; give the run that it comes from"
        )
    policies = Policies(
        params=jax.tree.map(lambda leaf: leaf[None], policy.params),
        arms=config.arms,
        knowledge=policy.knowledge,
        prior_counts=None,
        spec=policy.spec,
        estimator_config=policy.estimator_config,
        prior_steps=0,
        task=policy.task,
    )
    return config, policies
