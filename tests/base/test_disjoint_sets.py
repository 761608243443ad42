"""Sets of elements that pairs connect."""

from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from duagc.pipeline.base.disjoint_sets import join, root_of

COUNT = 12


@given(st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(0, COUNT - 1)), max_size=20))
def test_joined_sets_are_the_connected_components_by_their_lowest_element(
    pairs: list[tuple[int, int]],
) -> None:
    parent = list(range(COUNT))
    joined = [join(parent, i, j) for i, j in pairs]
    roots = [root_of(parent, k) for k in range(COUNT)]
    i, j = zip(*pairs, strict=True) if pairs else ((), ())
    components, of = connected_components(
        coo_matrix(([1] * len(pairs), (i, j)), shape=(COUNT, COUNT)), directed=False
    )
    assert roots == [of.tolist().index(component) for component in of]
    assert sum(joined) == COUNT - components, "each join of two sets leaves one fewer"
