"""The same seed gives the same bits, whoever reads the data; another seed gives others."""

from pathlib import Path

from tests.reliability.outcome import Outcome
from tests.reliability.trainings import differences, make_data, run, words

STEPS = 200


def determinism(work: Path) -> list[Outcome]:
    """Train four times: twice the same, once with loader workers, once with another seed."""
    data = make_data(work / "data")
    variants = {"again": [], "workers": ["data.num_workers=2"], "other_seed": ["seed=1"]}
    first = work / "same_first"
    run(words(data, first, STEPS))
    differ = {}
    for name, more in variants.items():
        run(words(data, work / f"same_{name}", STEPS, *more))
        differ[name] = differences(first, work / f"same_{name}")
    if "state_dict" not in differ.pop("other_seed"):
        raise RuntimeError("another seed gave the same weights: this check sees nothing")
    held = sum(not found for found in differ.values())
    seen = f"{STEPS} steps: weights, optimiser, schedules, metrics; also with two loader workers"
    return [Outcome("trainings with the same seed were bitwise equal", len(differ), held, seen)]
