"""Tests of the built distributions: the wheel and the source archive contain the right files."""

import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("jaxnav", "tests", "benchmarks", "configs", "docs", "examples", "results")
FILES = [path for path in ROOT.iterdir() if path.is_file() and not path.name.startswith(".")]
#: Trained policies of a study, too large for the archive; the study trains missing policies again.
EXCLUDED_FOLDER = ROOT / "results" / "claims" / "runs"
BUILD_SCRIPT = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def build_distribution(sources, kind, folder):
    """Build a distribution in a folder of sources, without a network, and return its path."""
    command = [sys.executable, "-c", BUILD_SCRIPT, f"build_{kind}", folder]
    completed = subprocess.run(command, cwd=sources, capture_output=True, text=True, check=True)
    return folder / completed.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def built_distributions(tmp_path_factory):
    """The unpacked source archive, and the wheel that is built from it."""
    # Build in a copy, because a build leaves files in the sources.
    folder = tmp_path_factory.mktemp("built")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / "copy" / name)
    for path in FILES:
        shutil.copy(path, folder / "copy")

    with tarfile.open(build_distribution(folder / "copy", "sdist", folder)) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    return unpacked, build_distribution(unpacked, "wheel", folder)


def list_files(folder):
    """Relative paths of all files of a folder, without the caches of compiled modules."""
    names = set()
    for path in folder.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            names.add(path.relative_to(folder).as_posix())
    return names


@pytest.mark.slow
def test_source_archive_contains_every_file_of_the_repository(built_distributions):
    unpacked, _ = built_distributions
    for folder in FOLDERS:
        expected_names = set()
        for name in list_files(ROOT / folder):
            if not (ROOT / folder / name).is_relative_to(EXCLUDED_FOLDER):
                expected_names.add(name)
        assert list_files(unpacked / folder) == expected_names
    assert {path.name for path in FILES} <= list_files(unpacked)


@pytest.mark.slow
def test_wheel_contains_only_the_package_and_its_data(built_distributions):
    _, wheel = built_distributions
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == {f"jaxnav/{name}" for name in list_files(ROOT / "jaxnav")}
    assert {"jaxnav/py.typed", "jaxnav/configs/smoke.yaml", "jaxnav/scenes/generate/rooms.yaml"} <= names


@pytest.mark.slow
def test_package_description_has_no_relative_links(built_distributions):
    # The description is the body of the wheel's metadata.
    _, wheel = built_distributions
    archive = zipfile.ZipFile(wheel)
    (metadata_name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    description = Parser().parsestr(archive.read(metadata_name).decode()).get_payload()
    assert isinstance(description, str)

    # The description is the README with the code, but without images.
    assert "# jaxnav" in description
    *_, python_block = re.findall(r"```python\n.*?```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert python_block in description
    assert "![" not in description

    # Outside code blocks, all links are absolute.
    prose = re.sub(r"```.*?```", "", description, flags=re.DOTALL)
    assert re.findall(r"\]\((?!https?://)", prose) == []
