"""Numbers of bytes in words."""

_SHOWN_AS_ONE = 0.9995  # what three digits round up to the next prefix


def bytes_text(count: float) -> str:
    """Bytes with three digits and a decimal prefix: 1 kB is 1000 B.

    Args:
        count: number of bytes.
    """
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= _SHOWN_AS_ONE * size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} B" if float(count).is_integer() else f"{count:.1f} B"
