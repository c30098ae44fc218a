"""What is left out of the matrix under ``-m "not exhaustive"`` holds no pair that is not in it elsewhere."""

from itertools import combinations, product

from tests.stability.covering import covering

FACTORS = {"scene": range(28), "mode": ("float32", "bf16", "float64"), "backend": "abcde", "k": (1, 16)}
CASES = [dict(zip(FACTORS, values, strict=True)) for values in product(*FACTORS.values())]


def pairs_of(cases: list[dict]) -> set:
    return {(*first, *second) for case in cases for first, second in combinations(case.items(), 2)}


def test_every_pair_of_values_is_kept_by_a_fraction_of_the_cases():
    chosen = covering(CASES)

    assert pairs_of([CASES[place] for place in chosen]) == pairs_of(CASES)
    assert 28 * 5 <= len(chosen) < 1.3 * 28 * 5  # as many as the two largest factors have pairs, and a few


def test_pairs_that_occur_nowhere_are_not_asked_for():
    cases = [case for case in CASES if case["k"] == 16 or case["backend"] != "a"]

    chosen = covering(cases)

    assert pairs_of([cases[place] for place in chosen]) == pairs_of(cases)


def test_two_factors_or_one_are_taken_whole():
    assert len(covering([{"scene": case["scene"], "mode": case["mode"]} for case in CASES[:300:5]])) > 1
    assert covering([{"scene": scene} for scene in range(5)]) == set(range(5))
    assert covering([{}]) == {0}
    assert covering([]) == set()
