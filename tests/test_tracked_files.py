"""What is kept in the repository: sources, small pictures, small results; nothing that a tool left behind."""

import shutil
import subprocess

import pytest

from tests.layers import ROOT

LARGEST_BYTES = 300_000
FOLDERS = {
    ".ci",
    "converters",
    "docs",
    "duagc",
    "examples",
    "outputs",
    "pipeline",
    "recordings",
    "schemas",
    "tests",
}
FILES = {
    ".gitignore",
    "CITATION.cff",
    "CMakeLists.txt",
    "CONTRIBUTING.md",
    "LICENSE",
    "Makefile",
    "README.md",
    "codespell.txt",
    "constraints.txt",
    "mkdocs.yml",
    "pyproject.toml",
}


@pytest.fixture(scope="module")
def tracked() -> list[str]:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("no clone of the repository")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    return [name for name in listed.stdout.decode().split("\0") if name]


def test_no_file_is_large(tracked: list[str]) -> None:
    sizes = {name: (ROOT / name).stat().st_size for name in tracked if (ROOT / name).is_file()}
    assert len(sizes) > 500
    assert {name: size for name, size in sizes.items() if size > LARGEST_BYTES} == {}


def test_the_root_holds_what_it_should(tracked: list[str]) -> None:
    assert {name.split("/")[0] for name in tracked if "/" in name} <= FOLDERS
    assert {name for name in tracked if "/" not in name} <= FILES
