"""The documentation: links resolve, commands and settings exist, generated pages are current, pages stay short."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli import app
from duagc.pipeline.config.base import Config
from duagc.pipeline.config.checks import ChecksConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.exchange.verification import Verdict
from duagc.pipeline.geometry import se3
from duagc.pipeline.messages import Odometry
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.runs import stages
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.ply import write_ply
from duagc.schemas import topics
from tests.docs import generate
from tests.docs.pages import DOCS, KINDS, ROOT, count_words, is_generated, kind, pages, prose

PAGE_WORDS, ALL_WORDS = 2_500, 20_000
BANNED = ("measured once", "not by a command", "its code is not in the project")
FRONT = (ROOT / "README.md", ROOT / "CONTRIBUTING.md")
CURRENT = [page for page in pages() if kind(page) != "lab"]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", pages(), ids=name)
def test_every_page_names_its_kind(page: Path) -> None:
    assert kind(page) in KINDS
    folder = page.relative_to(DOCS).parts[0]
    expected = {"howto": "how-to", "index.md": "reference"}.get(folder, folder)
    assert kind(page) == expected


# --- links


def anchors(page: Path) -> set[str]:
    """What a link may name in a page: its headings, in small letters, without signs, joined by dashes."""
    found: dict[str, int] = {}
    out = set()
    in_code = False
    for line in page.read_text(encoding="utf-8").splitlines():
        in_code ^= line.lstrip().startswith("```")
        if heading := re.match(r"#+ +(.*)", line) if not in_code else None:
            text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading[1]).replace("`", "")
            slug = re.sub(r"[^\w\- ]", "", text.strip().lower(), flags=re.ASCII).replace(" ", "-")
            out.add(f"{slug}-{found[slug]}" if slug in found else slug)
            found[slug] = found.get(slug, 0) + 1
    return out


@pytest.mark.parametrize("page", [*pages(), *FRONT], ids=name)
def test_links_resolve(page: Path) -> None:
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"`[^`\n]*`", "", text)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        if anchor and kind(page) != "lab":
            assert anchor in anchors(file), target


def test_every_current_page_is_linked() -> None:
    """From another page of the documentation, so that a reader can find it."""
    linked = set()
    for page in pages():
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if not re.match(r"[a-z]+:", target) and (file := (page.parent / target).resolve()) != page:
                linked.add(file)
    assert [name(page) for page in CURRENT if page not in linked and page != DOCS / "index.md"] == []


# --- length and words


@pytest.mark.parametrize("page", CURRENT, ids=name)
def test_pages_are_short(page: Path) -> None:
    assert count_words(page) <= PAGE_WORDS


def test_all_pages_together_are_short() -> None:
    assert sum(map(count_words, CURRENT)) <= ALL_WORDS


@pytest.mark.parametrize("page", CURRENT, ids=name)
def test_current_pages_have_no_figures_without_a_command(page: Path) -> None:
    text = " ".join(page.read_text(encoding="utf-8").lower().split())
    assert [phrase for phrase in BANNED if phrase in text] == []


@pytest.mark.parametrize("page", [p for p in CURRENT if not is_generated(p)], ids=name)
def test_one_sentence_a_line(page: Path) -> None:
    """Paragraphs only: cells of tables and points of lists may hold more than one."""
    for line in prose(page).splitlines():
        if re.match(r"[A-Z*`\[]", line) and not line.startswith("**"):
            sentences = re.findall(r"[a-z0-9)`*][.!?] +[A-Z]", re.sub(r"\b(e\.g|i\.e|vs|et al)\.", "", line))
            assert not sentences, line


# --- generated pages


@pytest.mark.parametrize("page", generate.pages(), ids=name)
def test_generated_pages_are_current(page: Path) -> None:
    assert page.read_text(encoding="utf-8") == generate.pages()[page], "run `python -m tests.docs.generate`"


def test_every_setting_is_on_its_page() -> None:
    text = (DOCS / "reference" / "config.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE))
    for path in (*settings(), *settings(ChecksConfig())):
        section, _, key = path.rpartition(".")
        if section:
            assert f"| `{key}` |" in sections[section], path


def test_every_metric_is_on_its_page() -> None:
    """Of the golden demo, which has ground truth and two robots, so that nothing is missing."""
    metrics = json.loads((ROOT / "tests" / "golden" / "demo.json").read_text(encoding="utf-8"))["metrics"]
    text = (DOCS / "reference" / "metrics.md").read_text(encoding="utf-8")
    spans = {span.rpartition(".")[2] for span in re.findall(r"`([^`]+)`", text)}
    stems = tuple(span[:-1] for span in spans if span.endswith("_*"))

    def documented(key: str) -> bool:
        base = re.sub(r"_(before_consensus|of_truth)$", "", key)
        return key in spans or base in spans or key.startswith(stems)

    keys = {
        path.rpartition(".")[2] for path in metrics if not path.startswith(("schema", "protocol", "reasons"))
    }
    assert len(keys) >= 50
    assert sorted(key for key in keys if not documented(key)) == []


# --- commands, settings, files and words that pages quote


def settings(config: Config | None = None, path: str = "") -> Iterator[str]:
    """Full name of every setting."""
    config = config or RunConfig()
    for key in type(config).model_fields:
        value = getattr(config, key)
        if isinstance(value, Config):
            yield from settings(value, f"{path}{key}.")
        else:
            yield f"{path}{key}"


def quoted(page: Path) -> list[str]:
    """What a page sets in code: spans and lines of blocks."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^ *```\w*\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    rest = re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
    indented = [line.strip() for line in rest.splitlines() if line.startswith("    ")]
    return [*re.findall(r"`([^`\n]+)`", rest), *indented, *(line for b in blocks for line in b.splitlines())]


def commands(page: Path) -> Iterator[list[str]]:
    """The words of every call of `duagc` that a page quotes."""
    for line in quoted(page):
        for part in re.split(r"\s#\s| > |; ", line)[:1]:
            words = part.strip().removeprefix(".venv/bin/")
            if re.match(r"duagc [a-z-]", words):
                yield shlex.split(words)[1:]


def test_the_reference_of_commands_says_what_a_value_looks_like() -> None:
    text = (DOCS / "reference" / "cli.md").read_text(encoding="utf-8")
    for option in ("--cover ROBOT:FIRST:FRAMES", "--gaussian ROBOT:ID", "--tile METERS", "--set a.b=VALUE"):
        assert f"`{option}`" in text


QUOTING = [page for page in [*CURRENT, *FRONT] if not (is_generated(page) and page.name == "api.md")]


@pytest.mark.parametrize("page", QUOTING, ids=name)
def test_quoted_commands_and_options_exist(page: Path) -> None:
    root: Any = typer.main.get_command(app)
    for words in commands(page):
        command = root
        while hasattr(command, "commands") and words:
            assert words[0] in command.commands, words
            command, words = command.commands[words[0]], words[1:]
        known = {option for p in command.params for option in (*p.opts, *p.secondary_opts)} | {"--help"}
        assert [w for w in words if w.startswith("-") and w not in known] == []


@pytest.mark.parametrize("page", QUOTING, ids=name)
def test_quoted_settings_exist(page: Path) -> None:
    known = set(settings())
    sections = {path.rpartition(".")[0] for path in known} | {
        path for setting in known for path in (".".join(setting.split(".")[:k]) for k in range(1, 5))
    }
    models = {"exchange.link.windows", "exchange.link.waypoints"}
    for text in quoted(page):
        for found in re.findall(r"(?<![\w.])(?:frontend|information|exchange|fusion)(?:\.[a-z_]+)+", text):
            if not re.search(r"\.(mcap|py|ply|tum|md|proto)$", found):
                assert found in known | sections | models, found


@pytest.mark.parametrize("page", QUOTING, ids=name)
def test_quoted_files_of_the_project_exist(page: Path) -> None:
    for text in quoted(page):
        for found in re.findall(
            r"(?<![\w/.~])(?:pipeline|converters|schemas|tests|examples)/[\w./*-]*\w", text
        ):
            assert list(ROOT.glob(found)) or "/speed" in found, found  # the stage of the how-to
        for module in re.findall(r"python -m ([\w.]+)", text):
            if module.startswith(("tests.", "duagc.")):
                path = ROOT / module.removeprefix("duagc.").replace(".", "/")
                assert path.is_dir() or path.with_suffix(".py").is_file(), module


def test_pages_that_the_code_names_exist() -> None:
    found = set()
    for folder in ("pipeline", "converters", "schemas", "tests", "examples"):
        for file in (ROOT / folder).rglob("*"):
            if file.suffix in (".py", ".proto", ".j2", ".h", ".cpp") and file.parent.name != "docs":
                found |= set(re.findall(r"docs/[\w/-]+\.md", file.read_text(encoding="utf-8")))
    assert len(found) >= 5
    assert sorted(page for page in found if not (ROOT / page).is_file()) == []


def test_the_tutorial_explains_every_verdict() -> None:
    text = (DOCS / "tutorial" / "your-bag.md").read_text(encoding="utf-8")
    verdicts = {verdict.value for verdict in Verdict}
    rows = re.findall(r"^bravo  alpha .*? (?:–|\d\.\d+)  +(.*?)  ", text, re.MULTILINE)
    assert len(rows) >= 3
    assert set(rows) <= verdicts
    assert set(re.findall(r"^\| ([^`|]*?) \|", text, re.MULTILINE)) >= verdicts - {Verdict.KEPT.value}


def test_the_example_stage_runs_and_keeps_to_its_declaration(tmp_path: Path) -> None:
    """Its function and its declaration, as they stand on the page, on a log of the front end."""
    function, declaration, _ = python_of(DOCS / "howto" / "stage.md")
    names: dict[str, Any] = {"Stage": stages.Stage, "topics": topics}
    exec(function, names)
    exec(declaration, names)
    odometry = topics.ODOMETRY.of("alpha")
    with LogWriter(tmp_path / "frontend.mcap", "alpha") as log:
        for k in range(3):
            T = se3.from_rotation_translation(np.eye(3), [0.1 * k, 0, 0])
            at_ns, still = k * 100_000_000, np.zeros((6, 6))
            log.write(
                odometry, Odometry(at_ns, "alpha", k, False, 0, T, T, still, "ok", 1.0, 0.0, 0.0), at_ns
            )
    arguments = tmp_path / "frontend.mcap", tmp_path / "speed.csv", "alpha"
    with names["SPEED"].running(tmp_path, "alpha"):
        names["run_speed"](*arguments)
    assert (tmp_path / "speed.csv").read_text().splitlines()[1:] == [
        "100000000,1.000000",
        "200000000,1.000000",
    ]
    blind = replace(names["SPEED"], reads=())
    with (
        blind.running(tmp_path, "alpha"),
        pytest.raises(DuagError, match="stage speed of alpha reads /alpha/odom"),
    ):
        names["run_speed"](*arguments)


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in QUOTING:
        for text in quoted(page):
            for target in re.findall(r"^make ([a-z-]+)", text):
                assert target in targets, f"{page}: make {target}"


# --- the README


def python_of(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def test_the_readme_fits_on_one_screen() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 60


def test_the_readme_example_runs(tmp_path: Path) -> None:
    """As it stands, on a map of one Gaussian where the demo would have written one."""
    (code,) = python_of(ROOT / "README.md")
    (path,) = re.findall(r"\"(outputs/[^\"]+\.ply)\"", code)
    (tmp_path / path).parent.mkdir(parents=True)
    gaussian = Gaussians(
        ids=np.array([0]),
        anchors=np.array([0]),
        means=np.array([[0, 0, 2]]),
        quats_wxyz=np.array([[1, 0, 0, 0]]),
        log_scales=np.full((1, 3), -1.0),
        colors=np.array([[0.9, 0.5, 0.1]]),
        opacity_logits=np.array([4.0]),
    )
    write_ply(tmp_path / path, gaussian)
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(480, 640, 3)"
