"""Decimal seconds become nanoseconds without a detour over binary fractions."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from duagc.pipeline.base.decimal_seconds import nanoseconds_of


@given(st.integers(-(1 << 63), (1 << 63) - 1))
def test_every_nanosecond_comes_back_with_and_without_an_exponent(time_ns: int) -> None:
    assert nanoseconds_of(f"{time_ns}e-9") == time_ns
    sign, digits = "-" * (time_ns < 0), f"{abs(time_ns):010d}"
    assert nanoseconds_of(f"{sign}{digits[:-9]}.{digits[-9:]}") == time_ns


@pytest.mark.parametrize(
    ("text", "expected"), [(".5", 500_000_000), ("1.9999999999", 2_000_000_000), ("1e-99999", 0)]
)
def test_what_is_finer_is_rounded(text: str, expected: int) -> None:
    assert nanoseconds_of(text) == expected


@pytest.mark.parametrize("text", ["", "x", "nan", "snan", "inf", "-Infinity"])
def test_what_is_no_number_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is no(t finite| number)"):
        nanoseconds_of(text)


@pytest.mark.parametrize("text", ["1e999999", "9223372036.854775808", "-1e11"])
def test_what_does_not_fit_is_refused(text: str) -> None:
    with pytest.raises(OverflowError, match="no time of 64 bits"):
        nanoseconds_of(text)
