"""A source tree whose kernels, or whose simulated room, were not compiled."""

import subprocess
import sys

WITHOUT = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name in ("duagc.pipeline.kernels._raster", "duagc.converters.simulate.render._flat_surfaces"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
"""


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", WITHOUT + code], capture_output=True, text=True, check=False)


def test_importing_the_kernels_is_an_import_error() -> None:
    found = python("try:\n    import duagc.pipeline.kernels\nexcept ImportError as error:\n    print(error)")
    assert found.returncode == 0, found.stderr
    assert found.stdout.startswith("the compiled kernels: No module named")
    assert "make setup" in found.stdout
    assert len(found.stdout.splitlines()) == 1


def test_the_command_makes_one_line_of_it() -> None:
    found = python("sys.argv = ['duagc', 'bench', 'raster']\nfrom duagc.pipeline.cli import main\nmain()")
    assert found.returncode == 1
    (line,) = found.stderr.splitlines()
    assert line.startswith("duagc: the compiled kernels: No module named")


def test_so_it_is_with_the_simulated_room() -> None:
    found = python(
        "sys.argv = ['duagc', 'simulate', '--out', 'x']\nfrom duagc.pipeline.cli import main\nmain()"
    )
    assert found.returncode == 1
    (line,) = found.stderr.splitlines()
    assert line.startswith("duagc: the compiled room: ")
    assert "make setup" in line
