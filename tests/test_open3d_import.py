"""Open3D where system libraries of windows and USB cameras are missing."""

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

from duagc.pipeline.base import open3d_import
from duagc.pipeline.base.errors import DuagError

LIBRARIES = [
    library for library in open3d_import.PACKAGES if library not in ("libgomp.so.1", "libstdc++.so.6")
]
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere, Open3D's wheels bring what they need")


def path_of(library: str) -> Path:
    return open3d_import.STAND_INS / f"{library.partition('.so')[0]}.so"


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


@LINUX
def test_open3d_casts_rays_with_nothing_but_stand_ins() -> None:
    """Also where the libraries are installed: those that are loaded come first."""
    paths = [str(path_of(library)) for library in LIBRARIES]
    done = python(
        f"""
import ctypes, sys, numpy as np
kept = [ctypes.CDLL(path) for path in {paths}]
from duagc.pipeline.base.open3d_import import import_open3d
o3d = import_open3d()
loaded = {{line.split("/")[-1].strip() for line in open("/proc/self/maps") if "/" in line}}
assert not loaded & {set(LIBRARIES)}, loaded
assert "dash" not in sys.modules
scene = o3d.t.geometry.RaycastingScene(nthreads=1)
scene.add_triangles(
    o3d.core.Tensor(np.array([[0, 0, 2], [1, 0, 2], [0, 1, 2]], np.float32)),
    o3d.core.Tensor(np.array([[0, 1, 2]], np.uint32)),
)
ray = o3d.core.Tensor(np.array([[0.2, 0.2, 0.0, 0.0, 0.0, 1.0]], np.float32))
assert abs(scene.cast_rays(ray)["t_hit"].numpy()[0] - 2.0) < 1e-5
print("done")
"""
    )
    assert done.stdout == "done\n", done.stderr


def test_the_viewer_in_a_browser_is_imported_when_it_is_called() -> None:
    done = python(
        """
import sys
from duagc.pipeline.base.open3d_import import import_open3d
o3d = import_open3d()
assert not {"dash", "plotly"} & set(sys.modules)
mesh = o3d.geometry.TriangleMesh.create_box()
for _ in range(2):
    assert type(o3d.visualization.get_plotly_fig([mesh])).__name__ == "Figure"
assert "dash" in sys.modules
print("done")
"""
    )
    assert done.stdout == "done\n", done.stderr


@LINUX
def test_a_stand_in_that_is_called_stops_the_process_with_one_line() -> None:
    done = python(f"import ctypes; ctypes.CDLL({str(path_of('libusb-1.0.so.0'))!r}).libusb_init(None)")
    assert done.returncode < 0
    assert done.stderr == (
        "open3d: calls libusb_init of libusb-1.0.so.0, which is not installed; "
        "on Debian: apt-get install libusb-1.0-0\n"
    )


@pytest.mark.parametrize(
    ("complaint", "line"),
    [
        (
            "libEGL.so.1: cannot open shared object file: No such file or directory",
            "open3d: libEGL.so.1 not found; on Debian: apt-get install libegl1",
        ),
        (
            "libgomp.so.1: cannot open shared object file: No such file or directory",
            "open3d: libgomp.so.1 not found; on Debian: apt-get install libgomp1",
        ),
        (
            "libodd.so.7: cannot open shared object file: No such file or directory",
            "open3d: libodd.so.7 not found; expected it installed",
        ),
        (
            "No module named 'open3d'",
            "open3d: No module named 'open3d', expected what `pip install duagc` installs",
        ),
    ],
)
def test_what_keeps_it_from_starting_is_one_line(
    complaint: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise ImportError(complaint)

    monkeypatch.setattr(open3d_import, "_imported", refuse)
    monkeypatch.setattr(open3d_import, "STAND_INS", tmp_path)  # empty
    monkeypatch.setattr(open3d_import, "_kept", {})
    with pytest.raises(DuagError) as raised:
        open3d_import.import_open3d()
    assert str(raised.value) == line


def test_a_stand_in_that_lacks_a_function_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    complaints = ["libEGL.so.1: cannot open shared object file", "libOpen3D.so: undefined symbol: eglNew"]

    def refuse() -> None:
        raise ImportError(complaints.pop(0))

    monkeypatch.setattr(open3d_import, "_imported", refuse)
    monkeypatch.setattr(open3d_import, "STAND_INS", tmp_path)
    monkeypatch.setattr(open3d_import, "_kept", {})
    monkeypatch.setattr(ctypes, "CDLL", lambda path: path)
    (tmp_path / "libEGL.so").touch()
    with pytest.raises(DuagError) as raised:
        open3d_import.import_open3d()
    assert str(raised.value) == (
        "open3d: libOpen3D.so: undefined symbol: eglNew; on Debian: apt-get install libegl1"
    )


def test_an_interrupted_import_is_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a compiled module makes of Ctrl-C while it is set up."""

    def stop() -> None:
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr(open3d_import, "_imported", stop)
    monkeypatch.setattr(open3d_import, "_kept", {"libusb-1.0.so.0": None})
    with pytest.raises(KeyboardInterrupt):
        open3d_import.import_open3d()
