"""Times that stand in files as decimal seconds."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation

LIMIT_NS = 1 << 63


def nanoseconds_of(text: str) -> int:
    """Decimal seconds as integer nanoseconds, exactly, also with an exponent; what is finer is rounded.

    Args:
        text: such as 1305031102.175304, or 1.305031102175304e+09, as numpy writes it.

    Raises:
        ValueError: it is no finite number.
        OverflowError: it does not fit 64 bits.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"{text!r} is no number") from None
    if not seconds.is_finite():
        raise ValueError(f"{text!r} is not finite")
    if not abs(seconds) < LIMIT_NS:  # before the product, which decimals refuse of large exponents
        raise OverflowError(f"{text!r} is no time of 64 bits")
    time_ns = int((seconds * 10**9).to_integral_value())
    if not -LIMIT_NS <= time_ns < LIMIT_NS:
        raise OverflowError(f"{text!r} is no time of 64 bits")
    return time_ns
