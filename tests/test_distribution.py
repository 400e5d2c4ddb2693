"""What is built: the wheel and the archive of the sources."""

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
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def build_distribution(sources, kind, folder):
    """Build in a folder of sources, without a network, and return the path."""
    command = [sys.executable, "-c", BUILD, f"build_{kind}", folder]
    completed = subprocess.run(command, cwd=sources, capture_output=True, text=True, check=True)
    return folder / completed.stdout.splitlines()[-1]


#: Trained policies of a study, too large for the archive; the study trains them anew where they are missing.
LEFT_OUT = ROOT / "results" / "claims" / "runs"


@pytest.fixture(scope="module")
def built_distributions(tmp_path_factory):
    """The unpacked archive of the sources, and the wheel that is built there."""
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
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.mark.slow
def test_source_archive_contains_every_file_of_the_repository(built_distributions):
    unpacked, _ = built_distributions
    for folder in FOLDERS:
        expected = {name for name in list_files(ROOT / folder) if not (ROOT / folder / name).is_relative_to(LEFT_OUT)}
        assert list_files(unpacked / folder) == expected
    assert {path.name for path in FILES} <= list_files(unpacked)


@pytest.mark.slow
def test_wheel_contains_only_the_package_and_its_data(built_distributions):
    _, wheel = built_distributions
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == {f"jaxnav/{name}" for name in list_files(ROOT / "jaxnav")}
    assert {"jaxnav/py.typed", "jaxnav/configs/smoke.yaml", "jaxnav/scenes/generate/rooms.yaml"} <= names


@pytest.mark.slow
def test_package_description_has_no_relative_links(built_distributions):
    _, wheel = built_distributions
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    readme = Parser().parsestr(archive.read(name).decode()).get_payload()
    assert isinstance(readme, str)
    assert "# jaxnav" in readme
    *_, python = re.findall(r"```python\n.*?```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert python in readme
    assert "![" not in readme
    prose = re.sub(r"```.*?```", "", readme, flags=re.DOTALL)
    assert re.findall(r"\]\((?!https?://)", prose) == []
