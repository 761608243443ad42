"""Values that two messages hold under one name, compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Unequal:
    """A field that differs.

    Attributes:
        name: dotted.
        place: of the first element that differs, as in "[3, 1]"; "" for a value that has no elements.
        first: the value there, on the first side, as text.
        second: on the other side.
        count: elements that differ.
        largest: absolute difference; None if that makes no sense.
        scale: absolute value on the first side where the difference is largest.
        gaps: absolute differences of the elements that differ, [count].
        sizes: their absolute values on the first side, [count].
    """

    name: str
    place: str
    first: str
    second: str
    count: int = 1
    largest: float | None = None
    scale: float = 0.0
    gaps: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)
    sizes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0), repr=False, compare=False)

    def within(self, absolute: float, relative: float) -> bool:
        """Whether no element differs by more than a tolerance.

        Args:
            absolute: part of the tolerance that is the same for all elements.
            relative: part of it by the absolute value of the element on the first side.
        """
        if self.largest is None:
            return False
        sizes = np.where(np.isfinite(self.sizes), self.sizes, 0.0)
        return bool((self.gaps <= absolute + relative * sizes).all())

    def text(self) -> str:
        """In words."""
        more = "" if self.count == 1 else f", {self.count} values differ"
        most = "" if self.largest is None or self.count == 1 else f", by {self.largest:.3g} at most"
        return f"{self.name}{self.place}: {self.first} and {self.second}{more}{most}"


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    """Values of a message by dotted name: dataclasses, protobuf messages and tables are opened.

    Args:
        value: a message, or a part of one.
        name: of it.
    """
    return dict(_leaves(value, name))


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    inner: list[tuple[str, Any]] | None = None
    if is_dataclass(value) and not isinstance(value, type):
        inner = [(f.name, getattr(value, f.name)) for f in fields(value)]
    elif hasattr(value, "ListFields"):
        inner = [(descriptor.name, part) for descriptor, part in value.ListFields()]
    elif isinstance(value, dict):
        inner = list(value.items())
    if inner is None:
        yield name, value
        return
    for key, part in inner:
        yield from _leaves(part, f"{name}.{key}" if name else str(key))


def unequal(first: Any, second: Any) -> list[Unequal]:
    """Fields that differ between two messages, in their order.

    Args:
        first: a message.
        second: another one of the same kind.
    """
    one, other = leaves(first), leaves(second)
    names = [*one, *(name for name in other if name not in one)]
    out = []
    for name in names:
        if name not in one or name not in other:
            sides = [_text(side[name]) if name in side else "absent" for side in (one, other)]
            out.append(Unequal(name, "", sides[0], sides[1]))
        elif (found := _compare(name, one[name], other[name])) is not None:
            out.append(found)
    return out


def _compare(name: str, first: Any, second: Any) -> Unequal | None:
    a, b = _array(first), _array(second)
    if a is None or b is None:
        return None if _plain(first) == _plain(second) else Unequal(name, "", _text(first), _text(second))
    if a.shape != b.shape:
        return Unequal(name, "", f"shape {list(a.shape)}", f"shape {list(b.shape)}")
    differ = ~((a == b) | _both_nan(a, b))
    if a.dtype == b.dtype and a.dtype.kind == "f":
        differ |= (np.signbit(a) != np.signbit(b)) & ~_both_nan(a, b)
    if not differ.any():
        return None
    place = tuple(int(i) for i in np.argwhere(differ)[0])
    largest, scale, gaps, sizes = None, 0.0, np.zeros(0), np.zeros(0)
    if a.dtype.kind in "fiu" and b.dtype.kind in "fiu":
        gap = np.where(differ, _gaps(a, b), 0.0)
        gap = np.where(np.isnan(gap), np.inf, gap)
        largest = float(gap.max())
        size = np.abs(a.astype(np.float64))
        scale = float(size.ravel()[int(gap.argmax())])
        gaps, sizes = gap[differ], size[differ]
    shown = f"[{', '.join(map(str, place))}]" if place else ""
    first_text, second_text = _text(a[place].item()), _text(b[place].item())
    count = int(differ.sum())
    return Unequal(
        name,
        shown,
        first_text,
        second_text,
        count=count,
        largest=largest,
        scale=scale,
        gaps=gaps,
        sizes=sizes,
    )


def _gaps(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    """Absolute differences; of whole numbers exact ones, for nanoseconds of a date have more digits than a float."""
    with np.errstate(invalid="ignore", over="ignore"):
        if a.dtype.kind == b.dtype.kind != "f":
            apart = np.asarray(np.maximum(a, b) - np.minimum(a, b))  # may wrap around
            return apart.view(f"u{apart.itemsize}").astype(np.float64)
        return np.asarray(np.abs(a.astype(np.float64) - b.astype(np.float64)))


def _both_nan(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    if a.dtype.kind == "f" and b.dtype.kind == "f":
        return np.isnan(a) & np.isnan(b)
    return np.zeros(a.shape, dtype=bool)


def _array(value: Any) -> NDArray[Any] | None:
    """Numbers, also a single one, as an array; None of anything else."""
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    if isinstance(value, np.ndarray):
        return value if value.dtype.kind in "fiub" else None
    if isinstance(value, bool | int | float | np.number):
        found = np.asarray(value)
        return found if found.dtype.kind in "fiub" else None
    if isinstance(value, str) or not hasattr(value, "__len__") or not len(value):
        return None
    if not all(isinstance(element, int | float) for element in value):
        return None
    found = np.asarray(value)
    return found if found.dtype.kind in "fiub" else None


def _plain(value: Any) -> Any:
    return list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value


def _text(value: Any) -> str:
    if isinstance(value, float):
        return repr(value)
    text = str(value).replace("\n", " ")
    return text if len(text) <= 60 else f"{text[:57]}..."
