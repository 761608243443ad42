"""Numbers of bytes in words."""

import pytest

from duagc.pipeline.base.byte_counts import bytes_text


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (17, "17 B"),
        (999.4, "999.4 B"),
        (4_321, "4.32 kB"),
        (999_499, "999 kB"),
        (999_500, "1 MB"),
        (13_259_562, "13.3 MB"),
        (999_700_000, "1 GB"),
        (1_234_567_890_123, "1.23 TB"),
    ],
)
def test_three_digits_and_a_prefix(count: float, text: str) -> None:
    assert bytes_text(count) == text
