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
