"""The version of the code of a stage: of its entry, and of everything in this package that it imports.

A module counts by its syntax tree without docstrings, so comments, layout and documentation change nothing. Imports are
followed from the text, those inside functions included; of the module of the entry only what the entry itself uses.
Compiled modules count by their bytes, and files that a package reads, such as templates, too.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from dataclasses import dataclass
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import duagc
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.library_versions import PYTHON, library_version
from duagc.pipeline.cache.publish import publish

PACKAGE = "duagc"
DATA_SUFFIXES = (".binpb", ".j2", ".css")
SHOWN_ONLY = frozenset({"rich", "typer", "lazy_loader", "tomlkit"})
"""Libraries that no result depends on."""
_RULES = f"2 {PYTHON}"  # of what is counted; part of every stored digest


@dataclass(frozen=True)
class CodeVersion:
    """What a computation was done with.

    Attributes:
        modules: digest of every module and data file, by its path in the package.
        libraries: versions of the libraries that these modules import, and of Python.
    """

    modules: dict[str, str]
    libraries: dict[str, str]


@dataclass(frozen=True)
class _Text:
    """What counts of a piece of code: its digest, the modules that it may name, and libraries."""

    digest: str
    names: tuple[str, ...]
    libraries: tuple[str, ...]


class CodeReader:
    """Reads versions of code. What it parsed once it finds again, by the digest of the file."""

    def __init__(self, known: Path | None = None, root: Path | None = None) -> None:
        """Load what earlier processes parsed; no version is read yet.

        Args:
            known: file in which parsed modules are kept between processes; None: nothing is kept.
            root: folder of the package, if it is not the one that runs.
        """
        self.root = Path(duagc.__file__).parent if root is None else root
        self._known = known
        self._parsed = _stored(known)
        self._new = False
        self._texts: dict[Path, _Text] = {}
        self._paths: dict[str, Path | None] = {}
        self._files: dict[tuple[str, ...], set[Path]] = {}
        self._data: dict[Path, list[Path]] = {}
        self._versions: dict[str, CodeVersion] = {}

    def version_of(self, entry: str) -> CodeVersion:
        """The version of a function and of everything that it imports.

        Args:
            entry: `module:function`.

        Raises:
            DuagError: there is no such module, or no such function in it.
        """
        if entry not in self._versions:
            self._versions[entry] = self._version_of(entry)
        return self._versions[entry]

    @property
    def versions(self) -> dict[str, CodeVersion]:
        """What was asked for until now, by entry."""
        return dict(self._versions)

    def adopt(self, versions: dict[str, CodeVersion]) -> None:
        """Take versions over that another process of the same run has read, whatever the files are by now.

        Args:
            versions: by entry.
        """
        self._versions |= versions

    def has_changed(self, entry: str) -> bool:
        """Whether files are other than when the version of a function was read.

        Args:
            entry: `module:function`, which was asked for before.
        """
        try:
            return CodeReader(self._known, self.root).version_of(entry) != self._versions[entry]
        except (DuagError, OSError):  # somebody edits it now
            return True

    def _version_of(self, entry: str) -> CodeVersion:
        module, _, function = entry.partition(":")
        path = self._path_of(module)
        if path is None:
            raise DuagError(f"{module}: no such module of the package, expected the code of a stage")
        first = _function(path, function)
        digests, libraries = {f"{self._label(path)}:{function}": first.digest}, set[str]()
        queue, seen = [first], {path}
        while queue:
            text = queue.pop()
            libraries.update(text.libraries)
            for found in self._files_of(text.names) - seen:
                seen.add(found)
                if found.suffix == ".py":
                    queue.append(self._text(found))
                    digests[self._label(found)] = queue[-1].digest
                else:
                    digests[self._label(found)] = _digest(found.read_bytes())
        self._save()
        versions = {name: version for name in sorted(libraries) if (version := library_version(name))}
        return CodeVersion(dict(sorted(digests.items())), {"python": PYTHON} | versions)

    def _label(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def _path_of(self, module: str) -> Path | None:
        """The file of a module of the package; None if it is none of its modules."""
        if module not in self._paths:
            base = self.root.joinpath(*module.split(".")[1:])
            candidates = [base / "__init__.py"]
            if base != self.root:
                candidates.append(base.with_suffix(".py"))
                candidates += [base.with_name(base.name + suffix) for suffix in EXTENSION_SUFFIXES]
            self._paths[module] = next((path for path in candidates if path.is_file()), None)
        return self._paths[module]

    def _files_of(self, names: tuple[str, ...]) -> set[Path]:
        """Files of modules, of the packages that they are in, and the data files of these packages."""
        if names not in self._files:
            modules = set[str]()
            for name in names:
                words = name.split(".")
                modules |= {".".join(words[:end]) for end in range(1, len(words) + 1)}
            files = {path for module in modules if (path := self._path_of(module)) is not None}
            packages = {path.parent for path in files if path.name == "__init__.py"} - {self.root}
            self._files[names] = files | {path for folder in packages for path in self._data_of(folder)}
        return self._files[names]

    def _data_of(self, folder: Path) -> list[Path]:
        if folder not in self._data:
            self._data[folder] = [path for path in folder.iterdir() if path.suffix in DATA_SUFFIXES]
        return self._data[folder]

    def _text(self, path: Path) -> _Text:
        if path not in self._texts:
            raw = path.read_bytes()
            key = _digest(raw)
            if key not in self._parsed:
                found = _count(_tree(path, raw).body)
                self._parsed[key] = [found.digest, found.names, found.libraries]
                self._new = True
            digest, names, libraries = self._parsed[key]
            self._texts[path] = _Text(digest, tuple(names), tuple(libraries))
        return self._texts[path]

    def _save(self) -> None:
        """Keep what was parsed; of several processes that do so the last one wins."""
        if self._known is None or not self._new:
            return
        self._new = False
        try:
            publish(self._known, json.dumps({"rules": _RULES, "parsed": self._parsed}).encode())
        except OSError:
            self._known = None  # a store that can only be read


def _stored(known: Path | None) -> dict[str, Any]:
    """What an earlier process parsed; nothing where that is damaged or was made by other rules."""
    try:
        content = json.loads(known.read_bytes()) if known is not None else {}
        return dict(content["parsed"]) if content["rules"] == _RULES else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _function(path: Path, name: str) -> _Text:
    """A function with what it uses of its module: other functions, classes, constants, imports."""
    body = _tree(path, path.read_bytes()).body
    defined = {n.name: n for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    if name not in defined:
        raise DuagError(f"{path}: found no function {name!r}, expected the code of a stage")
    used, queue = {name}, [name]
    while queue:
        for node in ast.walk(defined[queue.pop()]):
            if isinstance(node, ast.Name) and node.id in defined and node.id not in used:
                used.add(node.id)
                queue.append(node.id)
    unused = [node for name, node in defined.items() if name not in used]
    return _count([node for node in body if node not in unused])


def _tree(path: Path, raw: bytes) -> ast.Module:
    try:
        return ast.parse(raw)
    except SyntaxError as error:
        raise DuagError(f"{path}: line {error.lineno}: {error.msg}, expected Python") from error


def _count(body: list[ast.stmt]) -> _Text:
    """Digest and imports of statements."""
    counted = _Counted()
    counted.add_all(body)
    libraries = counted.libraries - {PACKAGE, *SHOWN_ONLY, *sys.stdlib_module_names}
    digest = _digest("\n".join(counted.parts).encode())
    return _Text(digest, tuple(sorted(counted.names)), tuple(sorted(libraries)))


class _Counted:
    """Syntax trees as text, one part after another, without what computes nothing; and what they import.

    One pass in place of a transformer, `ast.dump` and a walk: every run begins with it.
    """

    def __init__(self) -> None:
        self.parts: list[str] = []
        self.names, self.libraries = set[str](), set[str]()

    def add_all(self, values: list[Any]) -> None:
        """Add the nodes or plain values of a list that compute something.

        Args:
            values: of one field of a node.
        """
        self.parts.append("[")
        for value in values:
            if not _computes_nothing(value):
                self._add(value)
        self.parts.append("]")

    def _add(self, value: Any) -> None:
        if type(value) is list:
            self.add_all(value)
        elif not isinstance(value, ast.AST):
            self.parts.append(repr(value))
        else:
            if isinstance(value, ast.Import | ast.ImportFrom):
                self._note_import(value)
            self.parts.append(type(value).__name__)
            for name in value._fields:
                self._add(getattr(value, name, None))

    def _note_import(self, node: ast.Import | ast.ImportFrom) -> None:
        found = [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            found = [f"{node.module}.{name}" for name in found] if node.module else []
        self.names.update(name for name in found if name.split(".")[0] == PACKAGE)
        self.libraries.update(name.split(".")[0] for name in found)


def _computes_nothing(node: Any) -> bool:
    """Whether a statement is a text that stands alone, or what only type checkers read."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    if isinstance(node, ast.If):
        return isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING" and not node.orelse
    return False


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
