"""Which cases of a full cross product hold every pair of its factors' values."""

from collections.abc import Hashable, Mapping, Sequence
from heapq import heapify, heappop, heappush
from itertools import combinations


def covering(cases: Sequence[Mapping[str, Hashable]]) -> set[int]:
    """Choose cases so that every two values that meet in some case meet in a chosen one.

    Greedy: the case with the most pairs that are still missing comes next, the first of several. With fewer than three
    factors that differ nothing can be left out.

    Args:
        cases: of each case, the value of every factor.

    Returns:
        The places of the chosen cases.
    """
    met = [set(combinations(sorted(case.items(), key=lambda entry: entry[0]), min(2, len(case)))) for case in cases]
    missing = set().union(*met)
    queue = [(-len(pairs), place) for place, pairs in enumerate(met)]
    heapify(queue)
    chosen = set()
    while missing:
        expected, place = heappop(queue)
        gain = len(met[place] & missing)
        if gain == -expected:
            chosen.add(place)
            missing -= met[place]
        elif gain:  # it gains less than when it was put there: back in line
            heappush(queue, (-gain, place))
    return chosen
