"""Sets without common elements, as a list in which every element names another one of its set, or itself."""


def root_of(parent: list[int], element: int) -> int:
    """The element that stands for a set; the ways to it become shorter.

    Args:
        parent: by element, one nearer to the root of its set; of a root itself.
        element: of the set.
    """
    while parent[element] != element:
        parent[element] = parent[parent[element]]
        element = parent[element]
    return element


def join(parent: list[int], a: int, b: int) -> bool:
    """Make one set of those of two elements, for which its lowest root stands; whether they were two.

    Args:
        parent: as of `root_of`; changed in place.
        a: an element.
        b: another.
    """
    low, high = sorted((root_of(parent, a), root_of(parent, b)))
    parent[high] = low
    return low != high
