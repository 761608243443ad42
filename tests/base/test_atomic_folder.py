"""Folders that appear whole: whatever stops the process, the old one or the new one is there."""

import shutil
import sys
from pathlib import Path

import pytest

from duagc.pipeline.base import atomic_folder
from duagc.pipeline.base.atomic_folder import check_apart, new_folder
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.runs.stages import STAGES


def write(out: Path, text: str) -> None:
    with new_folder(out, force=True) as folder:
        (folder / "manifest.json").write_text(text)
        (folder / "fused.mcap").write_text(text)


def content(out: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in out.iterdir()}


class Stopped(BaseException):
    pass


def test_a_folder_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    write(tmp_path / "run", "old")
    write(tmp_path / "run", "new")
    assert content(tmp_path / "run") == {"manifest.json": "new", "fused.mcap": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("name", ["notes.txt", "cloud/a.ply", "inner/manifest.json", ".git/HEAD", "link"])
def test_a_folder_that_holds_something_else_is_not_replaced(tmp_path: Path, name: str) -> None:
    out = tmp_path / "run"
    write(out, "old")
    (out / name).parent.mkdir(exist_ok=True)
    (out / name).symlink_to(tmp_path) if name == "link" else (out / name).write_text("mine")
    with pytest.raises(
        DuagError, match=rf"run/{name}: --force would remove it, though it is no part of a run"
    ):
        write(out, "new")
    assert (out / "manifest.json").read_text() == "old"
    assert (out / name).exists()


def test_what_a_run_consists_of_is_what_its_stages_write(tmp_path: Path) -> None:
    """Beginnings of its files as well, which a process that was killed leaves."""
    out = tmp_path / "run"
    write(out, "old")
    files = [f"robots/alpha/{name}" if s.per_robot else name for s in STAGES for name in s.writes_files]
    for name in [file.replace("*", "alpha") for file in files]:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("old")
        (out / f"{name}.part").write_text("old")
    write(out, "new")
    assert content(out) == {"manifest.json": "new", "fused.mcap": "new"}


def test_what_is_stopped_while_it_removes_the_old_one_leaves_the_new_one(tmp_path, monkeypatch) -> None:
    write(tmp_path / "run", "old")

    def half(folder, **_):
        (Path(folder) / "fused.mcap").unlink(missing_ok=True)
        raise Stopped

    monkeypatch.setattr(atomic_folder.shutil, "rmtree", half)
    with pytest.raises(Stopped):
        write(tmp_path / "run", "new")
    monkeypatch.undo()
    assert content(tmp_path / "run") == {"manifest.json": "new", "fused.mcap": "new"}
    write(tmp_path / "run", "newer")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_cannot_be_removed_is_named_and_the_new_one_is_there(tmp_path, monkeypatch) -> None:
    """A folder without the permission to write: the error of the system names only a file in it."""
    write(tmp_path / "run", "old")

    remove = shutil.rmtree

    def refuse(folder, **how):
        if str(folder).endswith(".replaced.part"):
            raise PermissionError(13, "Permission denied", "fused.mcap")
        remove(folder, **how)

    monkeypatch.setattr(atomic_folder.shutil, "rmtree", refuse)
    with pytest.raises(DuagError, match=r"run\.replaced\.part: Permission denied.*run is whole"):
        write(tmp_path / "run", "new")
    assert content(tmp_path / "run") == {"manifest.json": "new", "fused.mcap": "new"}


def test_what_is_stopped_between_two_names_gives_the_old_one_back(tmp_path: Path) -> None:
    write(tmp_path / "run", "old")
    (tmp_path / "run").rename(tmp_path / "run.replaced.part")
    with pytest.raises(DuagError, match="exists already"), new_folder(tmp_path / "run", force=False):
        pytest.fail("there is a run")
    assert content(tmp_path / "run") == {"manifest.json": "old", "fused.mcap": "old"}
    shutil.rmtree(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_a_link_stays_and_what_it_names_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    write(tmp_path / "disk" / "run", "old")
    (tmp_path / "run").symlink_to(tmp_path / "disk" / "run")
    for text in ("new", "newer"):
        write(tmp_path / "run", text)
        assert (tmp_path / "run").is_symlink()
        assert content(tmp_path / "disk" / "run") == {"manifest.json": text, "fused.mcap": text}
        assert sorted(path.name for path in tmp_path.iterdir()) == ["disk", "run"]
        assert [path.name for path in (tmp_path / "disk").iterdir()] == ["run"]


@pytest.mark.parametrize("force", [True, False])
def test_a_link_to_nothing_is_refused_before_the_work(tmp_path: Path, force: bool) -> None:
    (tmp_path / "run").symlink_to(tmp_path / "absent" / "run")
    with pytest.raises(DuagError, match="symbolic link to nothing"), new_folder(tmp_path / "run", force):
        pytest.fail("began")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_output_that_holds_an_input_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run" / "recording").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "run")
    (tmp_path / "input").symlink_to(tmp_path / "run" / "recording")
    for out in ("run", "link"):
        for path in ("run", "run/recording", "link/recording", "input", "run/store-to-come"):
            with pytest.raises(DuagError, match="expected --out apart"):
                check_apart(tmp_path / out, [tmp_path, tmp_path / path])
    check_apart(tmp_path / "run", [tmp_path, tmp_path / "runs" / "recording"])


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="such links are found when the file is read")
def test_an_input_that_is_a_link_to_itself_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "settings.toml").symlink_to(tmp_path / "settings.toml")
    with pytest.raises(DuagError, match=r"settings\.toml: a link that leads back to itself"):
        check_apart(tmp_path / "out", [tmp_path / "settings.toml"])


@pytest.mark.parametrize("ends_well", [True, False], ids=["renamed", "removed"])
def test_a_folder_whose_owner_ends_while_it_is_locked_is_not_taken_for_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends_well: bool
) -> None:
    """Between opening the folder and locking it another process gives it its name, or removes it."""
    out, part, lock = tmp_path / "run", tmp_path / "run.part", atomic_folder._take
    begun = []

    def late(descriptor: int, folder: Path) -> None:
        if not begun:
            begun.append(folder)
            if ends_well:
                (part / "manifest.json").write_text("of the other one")
                part.rename(out)
            else:
                part.rmdir()
        lock(descriptor, folder)

    monkeypatch.setattr(atomic_folder, "_take", late)
    if ends_well:
        with pytest.raises(DuagError, match="exists already"), new_folder(out, force=False):
            pytest.fail("there is a run")
        assert content(out) == {"manifest.json": "of the other one"}
    else:
        write(out, "new")
        assert content(out) == {"manifest.json": "new", "fused.mcap": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("begun", ["_opened", "_is_named", "_settle"])
def test_what_is_stopped_before_its_work_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: str
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic_folder, begun, stopped)
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "out", force=False):
        raise AssertionError("the work began")
    assert list(tmp_path.iterdir()) == []


def test_what_is_stopped_leaves_the_folder_that_another_process_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with new_folder(tmp_path / "out", force=False) as folder:
        is_taken = atomic_folder._is_taken

        def stopped(*of: object) -> None:
            monkeypatch.setattr(atomic_folder, "_is_taken", is_taken)
            raise KeyboardInterrupt

        monkeypatch.setattr(atomic_folder, "_is_taken", stopped)
        with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "out", force=False):
            raise AssertionError("the work began")
        (folder / "a").write_text("a")
    assert (tmp_path / "out" / "a").is_file()
