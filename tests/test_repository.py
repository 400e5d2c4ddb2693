"""The files around the code: lock, Makefile, README and citation."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DEV = PROJECT["dependency-groups"]["dev"]
# An absolute path of somebody's machine, not a part of an address or of a relative path.
MACHINE_PATH = re.compile(r"(?<![\w.<])/(?:work|root|home|Users|tmp/venv)/")


def read_locked_versions() -> dict[str, str]:
    """Return the pinned versions by name, as the lock spells it."""
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE))


def list_repository_files() -> list[Path]:
    """Return every file that git tracks or would add."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listing = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [path for name in listing.split("\0") if name and (path := ROOT / name).is_file()]


@pytest.mark.parametrize("line", PROJECT["project"]["dependencies"] + DEV)
def test_lock_pins_a_version_within_the_requirement(line: str) -> None:
    requirement = Requirement(line)
    assert read_locked_versions()[requirement.name] in requirement.specifier


def test_dev_group_contains_every_extra() -> None:
    """All but the client of a service, which brings a dozen packages; a job of its own installs that."""
    extras = {name: lines for name, lines in PROJECT["project"]["optional-dependencies"].items() if name != "wandb"}
    assert {line for lines in extras.values() for line in lines} <= set(DEV)


def test_lock_contains_only_pinned_packages() -> None:
    # Nothing but `name==version`, markers and hashes: no index, no URL, no local file.
    for line in (ROOT / "requirements.lock").read_text().splitlines():
        assert re.fullmatch(r"[a-z0-9-]+==\S+( ; [^\\]+)? \\| +--hash=sha256:[0-9a-f]{64}( \\)?", line), line


def test_readme_commands_are_make_targets() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    # At the start of a line (a code block) or of a code span: prose such as "to make sure" does not count.
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
def test_machine_path_pattern(text: str, matches: bool) -> None:
    assert bool(MACHINE_PATH.search(text)) is matches


def test_no_file_names_a_path_of_one_machine() -> None:
    for path in list_repository_files():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:  # an image or an archive
            continue
        if path != Path(__file__):
            assert not MACHINE_PATH.search(text), f"{path.relative_to(ROOT)} names a path of one machine"
