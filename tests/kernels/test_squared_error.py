"""Squared errors in an exposure: the compiled pass computes what numpy defines, to the bit."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.kernels import available_isas, squared_error_definition
from duagc.pipeline.kernels.squared_error import squared_error
from duagc.pipeline.kernels.squared_error_definition import ExposedRender

SIZES = {"one pixel": (1, 1), "small": (7, 13), "a part of a row": (3, 256), "wide": (5, 700)}
COLUMNS = {"all": slice(None), "left": slice(0, 5), "right": slice(5, None), "none": slice(4, 4)}


def images_of(size: str) -> tuple[ExposedRender, np.ndarray, np.ndarray]:
    r = np.random.default_rng(5)
    alpha = r.uniform(0, 1, SIZES[size]).astype(np.float32)
    color, seen = (r.uniform(-0.1, 1.1, (*SIZES[size], 3)).astype(np.float32) for _ in range(2))
    gain, offset = np.array([0.8, 1.0, 1.4], np.float32), np.array([0.05, -0.1, 0.0], np.float32)
    return ExposedRender(color, alpha, gain, offset), seen, r.uniform(0, 1, SIZES[size]) < 0.6


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("columns", COLUMNS)
@pytest.mark.parametrize("size", SIZES)
def test_sums_are_those_of_the_definition(size: str, columns: str, isa: str) -> None:
    render, seen, mask = images_of(size)
    some = slice(*COLUMNS[columns].indices(seen.shape[1])[:2])
    for counted in (None, mask):
        found = squared_error(render, seen, counted, COLUMNS[columns], isa=isa)
        assert found == squared_error_definition.squared_error(render, seen, counted, some)


def test_the_sum_is_that_of_the_squares() -> None:
    render, seen, mask = images_of("wide")
    exposed = render.gain * render.color.astype(np.float64) + render.offset * render.alpha[..., None]
    squares = (np.clip(exposed, 0, 1) - seen) ** 2
    assert squared_error(render, seen) == pytest.approx(squares.sum(), rel=1e-6)
    assert squared_error(render, seen, mask) == pytest.approx(squares[mask].sum(), rel=1e-6)
    halves = [squared_error(render, seen, mask, half) for half in (slice(0, 333), slice(333, None))]
    assert sum(halves) == pytest.approx(squares[mask].sum(), rel=1e-6)


def test_what_does_not_belong_together_is_refused() -> None:
    render, seen, mask = images_of("small")
    for given, name in (
        ((replace(render, color=render.color[1:]), seen), "color"),
        ((replace(render, alpha=render.alpha[1:]), seen), "alpha"),
        ((replace(render, gain=render.gain[1:]), seen), "gain"),
        ((replace(render, offset=render.offset[:1]), seen), "offset"),
        ((render, seen[..., 0]), "seen"),
        ((render, seen, mask[1:]), "mask"),
    ):
        with pytest.raises(ValueError, match=f"{name} has shape"):
            squared_error(*given)
    with pytest.raises(ValueError, match="step of 2"):
        squared_error(render, seen, mask, slice(0, 4, 2))
