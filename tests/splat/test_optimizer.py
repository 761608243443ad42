"""Adam: the textbook's steps, per Gaussian."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.training import LearningRates
from duagc.pipeline.kernels import CompiledAdam, Gradients, available_isas
from duagc.pipeline.kernels.training import ScaleLimits, step_in_place
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.optimizer import BETA_1, BETA_2, Adam, sizes, smoothstep_decay

NAMES = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")


def some(n: int) -> Gaussians:
    r = np.random.default_rng(0)
    arrays: dict[str, Any] = {
        name: r.normal(size=(n, k)) for name, k in zip(NAMES, (3, 4, 3, 3), strict=False)
    }
    return Gaussians(ids=np.arange(n), anchors=np.zeros(n), opacity_logits=r.normal(size=n), **arrays)


def gradients(n: int, seed: int) -> Gradients:
    r = np.random.default_rng(seed)
    f = np.float32
    return Gradients(
        *(r.normal(size=(n, k)).astype(f) for k in (3, 4, 3, 3)), opacity_logits=r.normal(size=n).astype(f)
    )


@pytest.mark.parametrize("adam_of", [Adam, CompiledAdam])
def test_steps_are_the_textbooks(adam_of: type[Adam]) -> None:
    rates = LearningRates(means=0.01, quats_wxyz=0.02, log_scales=0.03, colors=0.04, opacity_logits=0.05)
    gaussians, adam = some(4), adam_of(4)
    expected = {name: getattr(gaussians, name).astype(np.float64) for name in NAMES}
    m = {name: np.zeros_like(value) for name, value in expected.items()}
    v = {name: np.zeros_like(value) for name, value in expected.items()}
    for t in range(1, 6):
        g = gradients(4, t)
        of_size = {"means": sizes(gaussians.log_scales).astype(np.float64)[:, None]}
        gaussians = adam.step(gaussians, g, rates)
        for name in NAMES:
            m[name] = BETA_1 * m[name] + (1 - BETA_1) * getattr(g, name)
            v[name] = BETA_2 * v[name] + (1 - BETA_2) * getattr(g, name).astype(np.float64) ** 2
            unbiased = m[name] / (1 - BETA_1**t), v[name] / (1 - BETA_2**t)
            step = getattr(rates, name) * of_size.get(name, 1.0)
            expected[name] = expected[name] - step * unbiased[0] / np.sqrt(unbiased[1])
    for name in NAMES:  # float32 against float64 over five steps of at most 0.05
        np.testing.assert_allclose(getattr(gaussians, name), expected[name], atol=2e-6)


def test_sizes_are_means_of_the_two_larger_deviations() -> None:
    scales = np.exp(np.random.default_rng(3).uniform(-12, 4, (2000, 3)))
    larger = np.sort(scales, axis=1)[:, 1:]
    ratio = sizes(np.log(scales).astype(np.float32)) / np.sqrt(larger.prod(axis=1))
    assert ratio.min() > 0.999
    assert ratio.max() < 1.063


@pytest.mark.parametrize("adam_of", [Adam, CompiledAdam])
def test_a_scene_four_times_as_large_is_trained_alike(adam_of: type[Adam]) -> None:
    """Scales are powers of two and so is the factor, so that only the logarithms are rounded."""
    gaussians = some(50)
    powers = np.random.default_rng(5).integers(-6, 2, (50, 3))
    small = gaussians.replace(
        log_scales=np.log(2.0**powers).astype(np.float32), means=np.zeros((50, 3), np.float32)
    )
    large = small.replace(log_scales=np.log(2.0 ** (powers + 2)).astype(np.float32))
    g, rates = gradients(50, 1), LearningRates()
    moved = [adam_of(50).step(g_, g, rates).means for g_ in (small, large)]
    np.testing.assert_allclose(moved[1], 4 * moved[0], rtol=1e-5)
    assert (moved[0] != 0).all()


@pytest.mark.parametrize("adam_of", [Adam, CompiledAdam])
def test_what_a_view_does_not_touch_stays(adam_of: type[Adam]) -> None:
    gaussians, adam = some(5), adam_of(5)
    full = gradients(5, 1)
    seen = np.array([True, False, True, False, True])
    g = Gradients(
        *(np.where(seen.reshape(-1, *[1] * (x.ndim - 1)), x, 0) for x in (getattr(full, n) for n in NAMES))
    )
    after = adam.step(adam.step(gaussians, full, LearningRates()), g, LearningRates())
    once = adam_of(5).step(gaussians, full, LearningRates())
    for name in NAMES:
        np.testing.assert_array_equal(getattr(after, name)[~seen], getattr(once, name)[~seen])
        assert (getattr(after, name)[seen] != getattr(once, name)[seen]).any()


@pytest.mark.parametrize("adam_of", [Adam, CompiledAdam])
def test_a_gaussian_does_not_depend_on_its_neighbors(adam_of: type[Adam]) -> None:
    gaussians, order = some(6), np.array([4, 0, 5, 2])
    all_of_them, some_of_them = adam_of(6), adam_of(6)
    some_of_them.select(order)
    whole, part = gaussians, gaussians.select(order)
    for t in range(3):
        g = gradients(6, t)
        whole = all_of_them.step(whole, g, LearningRates())
        part = some_of_them.step(part, Gradients(*(getattr(g, n)[order] for n in NAMES)), LearningRates())
    for name in NAMES:
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[order])


@pytest.mark.parametrize("adam_of", [Adam, CompiledAdam])
def test_a_stable_gaussian_stays_until_it_is_freed(adam_of: type[Adam]) -> None:
    gaussians, adam = some(3), adam_of(2)
    first = gaussians.select([0, 1])
    adam.freeze_after(2)
    for k in range(2):
        first = adam.step(first, gradients(2, k), LearningRates())
    adam.extend(1)
    both = Gaussians.concatenate([first, gaussians.select([2])])
    after = adam.step(both, gradients(3, 5), LearningRates())
    for name in NAMES:
        np.testing.assert_array_equal(getattr(after, name)[:2], getattr(first, name))
        assert (getattr(after, name)[2] != getattr(gaussians, name)[2]).all()
    adam.freeze_after(None)
    freed = adam.step(after, gradients(3, 6), LearningRates())
    assert all((getattr(freed, name)[:2] != getattr(first, name)).all() for name in NAMES)


@pytest.mark.parametrize("adam_of", [Adam, CompiledAdam])
def test_a_new_gaussian_starts_afresh(adam_of: type[Adam]) -> None:
    gaussians, adam = some(3), adam_of(2)
    first = gaussians.select(slice(2))
    for t in range(4):
        first = adam.step(first, gradients(2, t), LearningRates())
    adam.extend(1)
    g = gradients(3, 9)
    together = adam.step(Gaussians.concatenate([first, gaussians.select([2])]), g, LearningRates())
    alone = adam_of(1).step(
        gaussians.select([2]), Gradients(*(getattr(g, n)[2:] for n in NAMES)), LearningRates()
    )
    np.testing.assert_array_equal(together.means[2], alone.means[0])
    assert len(adam) == 3


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("isa", available_isas())
def test_the_compiled_steps_are_the_same_bits(isa: str, threads: int) -> None:
    n = 1000  # not whole groups of 64; a third of them without anything touched
    gaussians, r = some(n), np.random.default_rng(7)
    plain, compiled = Adam(n), CompiledAdam(n, isa, threads)
    expected = found = gaussians
    for t in range(30):
        scale = 10.0 ** r.integers(-30, 3)  # squares down to subnormal numbers and zero
        seen = np.repeat(r.random(16) < 0.7, 64)[:n] & (r.random(n) < 0.8)
        g = Gradients(
            *(
                np.where(seen.reshape(-1, *[1] * (x.ndim - 1)), x * np.float32(scale), 0).astype(np.float32)
                for x in (getattr(gradients(n, t), name) for name in NAMES)
            )
        )
        expected = plain.step(expected, g, LearningRates())
        found = compiled.step(found, g, LearningRates())
    for name in NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_steps_are_counted_to_the_end_only() -> None:
    gaussians = some(2)
    plain, compiled = Adam(2), CompiledAdam(2)
    expected = found = gaussians
    for t in range(1030):
        expected = plain.step(expected, gradients(2, t), LearningRates())
        found = compiled.step(found, gradients(2, t), LearningRates())
    np.testing.assert_array_equal(found.means, expected.means)


def test_what_does_not_fit_is_refused() -> None:
    gaussians, g, adam = some(3), gradients(3, 0), CompiledAdam(3)
    with pytest.raises(ValueError, match="gaussians are 2, expected 3"):
        adam.step(gaussians.select(slice(2)), g, LearningRates())
    with pytest.raises(ValueError, match=r"gradients\.means has shape \(2, 3\), expected \(3, 3\)"):
        adam.step(gaussians, replace(g, means=g.means[:2]), LearningRates())
    with pytest.raises(ValueError, match=r"gradients\.colors is float64, expected an array of float32"):
        adam.step(gaussians, replace(g, colors=g.colors.astype(np.float64)), LearningRates())


def test_rates_fall_from_one_to_the_last_and_never_rise() -> None:
    shares = np.array([smoothstep_decay(step, 101, 0.03) for step in range(101)])
    assert shares[0] == 1.0
    assert shares[-1] == pytest.approx(0.03)
    assert shares[50] == pytest.approx((1.0 + 0.03) / 2)
    assert (np.diff(shares) < 0).all()
    assert smoothstep_decay(0, 1, 0.03) == 1.0


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("of_each", [False, True])
@pytest.mark.parametrize("some_rows", [False, True])
@pytest.mark.parametrize("some_chosen", [False, True])
def test_a_step_in_place_is_the_plain_one_within_limits(
    threads: int, isa: str, of_each: bool, some_rows: bool, some_chosen: bool
) -> None:
    n = 401
    random = np.random.default_rng(2)
    least = random.uniform(-2, -1, (n, 3)).astype(np.float32) if of_each else np.float32(-1.5)
    limits = ScaleLimits(least, np.float32(1.5))
    rows = random.permutation(n)[:231] if some_rows else np.arange(n)
    chosen = random.random(n) < 0.6 if some_chosen else np.ones(n, bool)
    begun = some(n)
    begun = begun.replace(opacity_logits=np.where(random.random(n) < 0.1, 9, begun.opacity_logits))
    expected, plain, found, adam = begun, Adam(n), begun.copy(), CompiledAdam(n, isa, threads)
    changed = np.isin(np.arange(n), rows) & chosen
    for k in range(3):
        g = gradients(n, k)
        untouched = random.random(n) < 0.3
        untouched[200:240] = True  # whole groups of the kernel
        for array in (g.colors, g.opacity_logits):
            array[untouched] = 0
        of_changed = Gradients(
            *(
                np.where(changed.reshape(-1, *[1] * (x.ndim - 1)), x, 0)
                for x in (getattr(g, m) for m in NAMES)
            )
        )
        stepped = plain.step(expected, of_changed, LearningRates())
        scales = np.clip(stepped.log_scales, least, limits.greatest)
        expected = stepped.replace(
            log_scales=np.where(changed[:, None], scales, stepped.log_scales),
            opacity_logits=np.where(changed, np.clip(stepped.opacity_logits, -6, 6), stepped.opacity_logits),
        )
        step_in_place(
            found,
            adam,
            g.of_rows(rows),
            rates=LearningRates(),
            limits=limits,
            rows=rows if some_rows else None,
            chosen=chosen if some_chosen else None,
        )
        for name in NAMES:
            assert np.array_equal(getattr(found, name), getattr(expected, name))
            for a, b in zip(adam.state()[:2], plain.state()[:2], strict=True):
                assert np.array_equal(a[name], b[name])
        assert np.array_equal(adam.state()[2], plain.state()[2])
    assert np.abs(found.opacity_logits[changed]).max() <= 6
    assert (found.log_scales[changed] <= 1.5).all()
    for name in NAMES:
        assert np.array_equal(getattr(found, name)[~changed], getattr(begun, name)[~changed])


def test_a_step_of_no_row_changes_nothing() -> None:
    gaussians, adam, none = some(6), CompiledAdam(6), np.zeros(0, np.int64)
    g, limits = gradients(6, 0).of_rows(none), ScaleLimits(np.float32(-0.1))
    before = gaussians.copy()
    step_in_place(gaussians, adam, g, rates=LearningRates(), limits=limits, rows=none)
    assert all(np.array_equal(getattr(gaussians, name), getattr(before, name)) for name in NAMES)


@pytest.mark.parametrize(
    ("rows", "message"),
    [([-1, 2], "rows are -1 to 2, expected 0 to 5"), ([0, 6], "rows are 0 to 6, expected 0 to 5")],
)
def test_rows_that_are_none_are_refused(rows: list[int], message: str) -> None:
    limits = ScaleLimits(np.float32(-7))
    with pytest.raises(ValueError, match=message):
        step_in_place(
            some(6),
            CompiledAdam(6),
            gradients(2, 0),
            rates=LearningRates(),
            limits=limits,
            rows=np.array(rows),
        )


@pytest.mark.parametrize("chosen", [np.ones(5, bool), np.ones(6, np.uint8)])
def test_a_choice_that_is_none_is_refused(chosen: np.ndarray) -> None:
    limits = ScaleLimits(np.float32(-7))
    with pytest.raises(ValueError, match=r"chosen is .*, expected bool \(6,\)"):
        step_in_place(
            some(6), CompiledAdam(6), gradients(6, 0), rates=LearningRates(), limits=limits, chosen=chosen
        )


def test_a_state_that_would_be_changed_in_a_copy_is_refused() -> None:
    gaussians, adam = some(6), CompiledAdam(6)
    every_second = CompiledAdam()
    first, second, steps, corrections = adam.state()
    strided = [{name: array[::2] for name, array in of.items()} for of in (first, second)]
    every_second.go_on((*strided, steps[::2], corrections))
    with pytest.raises(ValueError, match="expected contiguous"):
        every_second.step(gaussians.select(slice(None, None, 2)), gradients(3, 0), LearningRates())
