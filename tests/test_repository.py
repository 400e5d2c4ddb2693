"""Tests of the files around the code: the lock file, Makefile, README, citation and changelog."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DEV_REQUIREMENTS = PROJECT["dependency-groups"]["dev"]
#: Pattern of an absolute path of one machine, but not of a part of an address or of a relative path.
MACHINE_PATH = re.compile(r"(?<![\w.<])/(?:work|root|home|Users|tmp/venv)/")


def read_locked_versions() -> dict[str, str]:
    """Pinned version by package name, as the lock file spells the name."""
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE))


def list_repository_files() -> list[Path]:
    """Every file that git tracks or would add."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listing = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")

    # A tracked file may be deleted; names are separated, and the last one ended, by NUL.
    paths = [ROOT / name for name in listing.split("\0") if name]
    return [path for path in paths if path.is_file()]


@pytest.mark.parametrize("line", PROJECT["project"]["dependencies"] + DEV_REQUIREMENTS)
def test_lock_pins_a_version_within_the_requirement(line: str) -> None:
    requirement = Requirement(line)
    assert read_locked_versions()[requirement.name] in requirement.specifier


def test_dev_group_contains_every_extra() -> None:
    """The `wandb` extra is exempt: the client brings a dozen packages, so a separate job installs it."""
    extra_requirements = set()
    for extra_name, requirements in PROJECT["project"]["optional-dependencies"].items():
        if extra_name != "wandb":
            extra_requirements.update(requirements)
    assert extra_requirements <= set(DEV_REQUIREMENTS)


def test_lock_contains_only_pinned_packages() -> None:
    # Lines hold only `name==version`, markers and hashes: no index, no URL, no local file.
    for line in (ROOT / "requirements.lock").read_text().splitlines():
        assert re.fullmatch(r"[a-z0-9-]+==\S+( ; [^\\]+)? \\| +--hash=sha256:[0-9a-f]{64}( \\)?", line), line


def test_readme_commands_are_make_targets() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    # Commands stand at the start of a line (in a code block) or of a code span; "to make sure" is prose, no command.
    pattern = r"(?:^(?: {4})?|`)(?:\$ )?make ([a-z-]+)"
    commands = set(re.findall(pattern, (ROOT / "README.md").read_text(), re.MULTILINE))
    assert {"run", "test"} <= commands <= targets


def test_citation_carries_the_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["project"]["version"]
    assert citation["license"] == PROJECT["project"]["license"]


def test_changelog_begins_with_the_version() -> None:
    sections = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert sections[0] == PROJECT["project"]["version"]


@pytest.mark.parametrize(
    ("text", "matches"),
    [("see /root/notes", True), ("'/home/ann/x'", True), ("https://site.org/home/x", False), ("runs/work/x", False)],
)
def test_machine_path_pattern_matches_only_absolute_paths(text: str, matches: bool) -> None:
    assert bool(MACHINE_PATH.search(text)) is matches


def test_no_file_names_a_path_of_one_machine() -> None:
    for path in list_repository_files():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:  # an image or an archive
            continue
        if path != Path(__file__):
            assert not MACHINE_PATH.search(text), f"{path.relative_to(ROOT)} names a path of one machine"
