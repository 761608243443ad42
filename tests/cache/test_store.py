"""Results are computed once, whoever asks, and damage in a store is found."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cache import claims
from duagc.pipeline.cache.carrier import Carried, Carrier, NotStoredError, differing
from duagc.pipeline.cache.code_identity import CodeReader
from duagc.pipeline.cache.file_digests import FileDigests
from duagc.pipeline.cache.garbage import LEFTOVER_NS, collect
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import Store, default_store
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runs.stages import Stage
from duagc.pipeline.runs.timing import Timing
from tests.fixtures.commands import ROOT, assert_one_line, duagc_here
from tests.fixtures.full_disks import no_file_larger_than

STAGE = Stage(
    "sum",
    (),
    writes_files=("sum.txt",),
    settings=("seed", "exchange.link"),
    code="duagc.pipeline.base.errors:closest",
)


class Bench:
    """A run of one stage, which writes a number."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = Store(folder / "store")
        self.said: list[str] = []
        self.computed = 0
        self.runs = 0

    def carry(self, *overrides: str, inputs: str = "a", write: str = "", **options: object) -> Carried:
        """Do the stage in a folder of its own."""
        self.runs += 1
        run = self.folder / f"run{self.runs}"
        run.mkdir()
        config = load_config(RunConfig, overrides=overrides)
        carrier = Carrier(run, config, self.store, self.said.append)

        def compute(timing: Timing) -> str:
            with timing.stage(STAGE, run):
                self.computed += 1
                (run / "sum.txt").write_text(write or f"{inputs} {config.seed}")
            return "done"

        carried = replace(carrier, **options).carry(STAGE, None, {"terms": inputs}, compute)
        assert carried.entry.result == "done"
        assert (run / "sum.txt").is_file()
        return carried

    def object(self) -> Path:
        (path,) = (self.folder / "store" / "objects").rglob("*/*")
        return path


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_result_is_computed_once_and_going_back_is_free(bench: Bench) -> None:
    assert bench.carry().executed
    again = bench.carry()
    assert not again.executed
    assert (bench.folder / "run2" / "sum.txt").read_text() == "a 0"
    assert bench.carry("seed=1").executed
    assert bench.carry(inputs="b").executed
    assert not bench.carry().executed
    assert not bench.carry("exchange.max_rounds=7").executed  # not declared
    assert bench.carry("exchange.link.loss_probability=0.5").executed
    assert bench.computed == 4
    assert bench.said == []


def test_what_changed_is_named(bench: Bench) -> None:
    bench.carry()
    with pytest.raises(NotStoredError) as caught:
        bench.carry("seed=3", inputs="b", looking=True)
    carrier = Carrier(bench.folder, RunConfig(), bench.store, bench.said.append)
    key = caught.value.key
    assert carrier.changes(key) == ["settings: seed 0 -> 3", "inputs: terms changed"]
    other = replace(key, code=dict(key.code) | {"pipeline/new.py": "1"}, libraries={"numpy": "9"})
    assert "code: pipeline/new.py is new" in carrier.changes(other)
    assert carrier.changes(replace(key, robot="zulu")) == ["it was never computed"]


def test_a_setting_that_is_not_declared_cannot_be_read(bench: Bench) -> None:
    settings = Carrier(bench.folder, RunConfig(), None, bench.said.append).settings_of(STAGE)
    assert settings.exchange.link.loss_probability == RunConfig().exchange.link.loss_probability
    for name in ("frontend", "fusion"):
        with pytest.raises(ValueError, match=f"stage sum reads the setting {name}, expected one of its"):
            getattr(settings, name)
    with pytest.raises(ValueError, match=r"stage sum reads the setting exchange\.max_rounds"):
        _ = settings.exchange.max_rounds


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [flip, lambda path: path.write_bytes(b""), Path.unlink])
def test_a_damaged_object_is_named_and_computed_again(bench: Bench, damage: Callable[[Path], object]) -> None:
    bench.carry()
    damage(bench.object())
    assert bench.carry().executed
    (line,) = bench.said
    assert "/objects/" in line
    assert line.endswith("sum is computed again")
    assert not bench.carry().executed


@pytest.mark.parametrize("damage", [flip, lambda path: path.write_bytes(b"")])
def test_a_damaged_entry_is_named_and_computed_again(bench: Bench, damage: Callable[[Path], object]) -> None:
    bench.carry()
    (path,) = (bench.folder / "store" / "entries").rglob("*.json")
    damage(path)
    assert bench.carry().executed
    assert [line for line in bench.said if f"{path.name}: is damaged" in line] == bench.said != []
    assert not bench.carry().executed


def test_an_entry_that_this_process_cannot_read_stays(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    carried = bench.carry()
    (path,) = (bench.folder / "store" / "entries").rglob("*.json")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_text", Mock(side_effect=PermissionError(13, "Permission denied")))
        assert bench.store.find(carried.entry.key, bench.said.append) is None
    assert bench.said == [f"{path}: Permission denied, expected a stored result; computed again"]
    assert not bench.carry().executed


def test_results_of_code_that_is_edited_meanwhile_are_not_kept(bench: Bench) -> None:
    source = bench.folder / "package" / "pipeline" / "base" / "errors.py"
    source.parent.mkdir(parents=True)
    source.write_text("def closest():\n    return 1\n")

    def edit(key: StageKey, stored: bool) -> None:
        bench.store.checkpoints(key).mkdir(parents=True)
        source.write_text("def closest():\n    return 2\n")

    bench.store.code = CodeReader(root=bench.folder / "package")
    edited = bench.carry(begun=edit).entry
    assert bench.said == ["warning: sum: its source changed while it was computed; not kept"]
    assert bench.store.recent("sum", 10) == []
    assert list((bench.folder / "store" / "checkpoints").iterdir()) == []
    earlier = {"sum": edited.plain() | {"key": edited.key.digest}}
    for _ in range(2):  # a process that began with the old code, and one that begins now
        assert bench.carry(earlier=earlier, place=bench.folder / "run1").executed
        bench.store.code = CodeReader(root=bench.folder / "package")
    assert not bench.carry().executed


def test_a_run_goes_on_with_the_versions_that_it_began_with(bench: Bench) -> None:
    began = bench.store.code.version_of(STAGE.code)
    later = CodeReader(root=bench.folder)
    later.adopt(bench.store.code.versions)
    assert later.version_of(STAGE.code) == began
    assert later.has_changed(STAGE.code)
    assert not bench.store.code.has_changed(STAGE.code)


def test_a_claim_that_cannot_name_its_owner_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(claims, "this_process", lambda: {"host": "x" * 100_000})
    with no_file_larger_than(1000), pytest.raises(OSError, match="File too large"):
        claims.claim(tmp_path / "claim", lambda: False, lambda: None)
    assert list(tmp_path.iterdir()) == []


def test_no_room_for_what_the_store_has_is_told_with_its_place(bench: Bench) -> None:
    bench.carry(write="x" * 5000)
    with no_file_larger_than(1000), pytest.raises(OSError, match="File too large") as full:
        bench.carry(write="x" * 5000)
    assert full.value.filename == str(bench.folder / "run2" / "sum.txt")


def test_an_earlier_run_serves_where_the_store_forgot(bench: Bench) -> None:
    carried = bench.carry()
    bench.object().unlink()
    again = bench.carry(place=bench.folder / "run1")
    assert not again.executed
    assert again.entry.files == carried.entry.files
    assert bench.said == []


def test_other_bytes_from_the_same_are_reported(bench: Bench) -> None:
    bench.carry()
    assert bench.carry(again=frozenset({"sum"})).executed
    assert bench.said == []
    bench.carry(again=frozenset({"sum"}), write="else")
    (line,) = bench.said
    assert "warning: sum: sum.txt has digest" in line
    assert "as computed before from the same" in line


def test_views_of_the_same_have_other_bytes(bench: Bench) -> None:
    """Rerun gives chunks random numbers."""
    (sound,) = bench.carry().entry.files.values()
    first = replace(bench.carry().entry, files={"run.rrd": sound, "sum.txt": sound})
    second = replace(first, files=dict.fromkeys(first.files, replace(sound, content="else")))
    assert differing(first, second) == ["sum.txt"]
    assert differing(first, replace(first, files={"run.rrd": sound})) == ["sum.txt"]
    assert differing(first, first) == []


def test_a_store_that_cannot_be_written_stops_no_run(bench: Bench) -> None:
    (bench.folder / "store").mkdir()
    (bench.folder / "store" / "objects").write_text(
        ""
    )  # as good as a full or a read-only disk, for root as well
    assert bench.carry().executed
    (line,) = bench.said
    assert line.startswith("warning: ")
    assert line.endswith("sum is not kept")


def test_a_file_is_no_store(tmp_path: Path) -> None:
    (tmp_path / "store").write_text("mine")
    with pytest.raises(DuagError, match="is no folder, expected that of a store"):
        Store(tmp_path / "store")


def test_another_folder_is_no_store(tmp_path: Path) -> None:
    (tmp_path / "recording.json").write_text("{}")
    with pytest.raises(DuagError, match=r"holds recording\.json, expected a store or an empty folder"):
        Store(tmp_path)
    (tmp_path / "empty").mkdir()
    Store(tmp_path / "empty")


def test_a_store_can_be_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DUAGC_STORE", raising=False)
    assert default_store(tmp_path / "run") == tmp_path / ".duagc-store"
    monkeypatch.setenv("DUAGC_STORE", str(tmp_path / "all"))
    assert default_store(tmp_path / "run") == tmp_path / "all"


def test_a_changed_file_has_another_digest_and_an_unchanged_one_is_not_read(tmp_path: Path) -> None:
    path, digests = tmp_path / "a.tum", FileDigests(tmp_path / "files")
    path.write_text("one")
    old_ns = path.stat().st_mtime_ns - 10_000_000_000
    first = digests.of(path)
    assert not list((tmp_path / "files").iterdir())  # written a moment ago: it may change again unseen
    time.sleep(0.05)
    assert digests.of(path) == first
    assert list((tmp_path / "files").iterdir())
    (kept,) = (tmp_path / "files").iterdir()
    kept.write_text(kept.read_text().replace(first.raw, "0" * 64))
    assert digests.of(path).raw == "0" * 64  # from what is kept
    path.write_text("two")
    os.utime(path, ns=(old_ns, old_ns))  # the time of a change of times cannot be set
    assert digests.of(path).raw != first.raw
    assert digests.of(path).size == 3


CLAIMANT = """
import sys, time
from pathlib import Path
from unittest.mock import Mock
from duagc.pipeline.cache.claims import claim
folder = Path(sys.argv[1])
with claim(folder, lambda: False, lambda: None):
    time.sleep(float(sys.argv[2]))
"""


def claimant(folder: Path, seconds: float) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", CLAIMANT, str(folder), str(seconds)], cwd=ROOT)
    while not (folder / "owner.json").is_file():
        assert process.poll() is None
        time.sleep(0.01)
    return process


def test_a_claim_is_waited_for_and_that_of_a_killed_process_is_taken(tmp_path: Path) -> None:
    from duagc.pipeline.cache.claims import claim

    announced: list[str] = []
    process = claimant(tmp_path / "claim", 0.3)
    taken = claim(tmp_path / "claim", lambda: False, lambda: announced.append("waiting"))
    assert process.wait() == 0
    assert announced == ["waiting"]
    assert taken is not None
    with taken:
        assert claim(tmp_path / "claim", lambda: True, lambda: None) is None  # done meanwhile
    assert list(tmp_path.iterdir()) == []
    process = claimant(tmp_path / "claim", 60)
    process.kill()
    process.wait()
    assert (tmp_path / "claim").is_dir()
    taken = claim(tmp_path / "claim", lambda: False, lambda: None)
    assert taken is not None
    with taken:
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
def test_a_process_may_have_a_name_that_is_cut_in_a_letter() -> None:
    code = (
        "import ctypes; ctypes.CDLL(None).prctl(15, 'größe'.encode()[:3])\n"
        "from duagc.pipeline.base.workers import peak_memory_bytes\n"
        "from duagc.pipeline.cache.claims import has_ended, this_process\n"
        "print(peak_memory_bytes() > 0, has_ended(this_process()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("True False\n", "")


def test_gc_removes_what_was_not_used_for_longest(bench: Bench) -> None:
    store = bench.folder / "store"
    for k, letter in enumerate("abc"):
        bench.carry(inputs=letter, write=letter * 1000)
        (path,) = [p for p in (store / "entries").rglob("*.json") if p.stat().st_mtime_ns > 10**18]
        os.utime(path, ns=(k, k))
    bench.carry(inputs="a")  # used again
    leftover = store / "objects" / "half.part"
    leftover.write_text("half")
    dry = collect(store, 2000, dry=True)
    assert collect(store, 2000) == dry
    assert (dry.entries, dry.kept_entries, dry.kept_bytes, dry.freed_bytes) == (1, 2, 2000, 1000)
    assert leftover.exists()
    os.utime(leftover, ns=(0, leftover.stat().st_mtime_ns - 2 * LEFTOVER_NS))
    assert collect(store, 2000).freed_bytes == 4
    assert not leftover.exists()
    assert not bench.carry(inputs="a").executed
    assert not bench.carry(inputs="c").executed
    assert bench.carry(inputs="b").executed
    assert bench.said == []
    result = duagc_here("gc", "--store", store, "--max", "0")
    assert "3 results removed" in result.stdout
    assert not list((store / "objects").rglob("*/*"))


def test_gc_removes_where_a_computation_was_that_nobody_goes_on_with(bench: Bench) -> None:
    key = bench.carry().entry.key
    for name, old in (("old", True), ("new", False)):
        other = bench.store.checkpoints(replace(key, inputs={"terms": name}))
        other.mkdir(parents=True)
        (other / "tracking.state").write_bytes(bytes(1000))
        if old:
            long_ago_ns = time.time_ns() - 2 * LEFTOVER_NS
            os.utime(other / "tracking.state", ns=(long_ago_ns, long_ago_ns))
    assert collect(bench.store.folder, 10**9, dry=True).freed_bytes == 1000
    assert collect(bench.store.folder, 10**9).freed_bytes == 1000
    assert len(list((bench.store.folder / "checkpoints").iterdir())) == 1


def test_a_stage_that_is_finished_leaves_no_checkpoint(bench: Bench) -> None:
    key = bench.carry().entry.key
    places = [bench.store.checkpoints(k) for k in (key, replace(key, inputs={"terms": "b"}))]
    for place in places:
        place.mkdir(parents=True)
    bench.carry()
    assert not places[0].exists()
    bench.carry(inputs="b")
    assert not places[1].exists()


def test_gc_of_no_store_is_one_line(tmp_path: Path) -> None:
    assert_one_line(duagc_here("gc", "--store", tmp_path), "expected a store")
    for size in ("much", "-5G", "-1"):
        assert duagc_here("gc", "--store", tmp_path, f"--max={size}").returncode == 2


def test_an_entry_says_what_it_was_computed_from(bench: Bench) -> None:
    bench.carry("seed=5")
    (path,) = (bench.folder / "store" / "entries" / "sum" / "team").iterdir()
    content = json.loads(path.read_text().partition("\n")[2])
    assert content["key"]["settings"]["seed"] == 5
    assert content["key"]["inputs"] == {"terms": "a"}
    assert content["timing"]["stage"] == "sum"
