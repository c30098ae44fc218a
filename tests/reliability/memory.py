"""Memory stays as it is, however long a training or a series of rollouts is."""

import json
import statistics
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.reliability.outcome import Outcome
from tests.reliability.trainings import make_data, start, words

MODELS = ("vpd", "inertial")
MAX_GROWTH = 0.01


def memory(work: Path, *, num_steps: int = 1000, num_rollouts: int = 500) -> list[Outcome]:
    """Compare the second tenth of a long run with its last tenth, for each model; two models at a time."""
    data = make_data(work / "data")
    with ThreadPoolExecutor(len(MODELS)) as pool:
        jobs = [pool.submit(_of_model, model, data, work, num_steps, num_rollouts) for model in MODELS]
        trained, rolled = zip(*(job.result() for job in jobs), strict=True)
    return [
        _outcome(f"memory was flat over {num_steps:,} training steps", trained),
        _outcome(f"memory was flat over {num_rollouts} rollouts", rolled),
    ]


def _of_model(model: str, data: Path, work: Path, num_steps: int, num_rollouts: int) -> tuple[float, float]:
    folder = work / f"memory_{model}"
    # No validation and one checkpoint at the end: what a step holds, not what a validation adds.
    training = words(data, folder, num_steps, f"model={model}", "callbacks.keep_checkpoints.every_n_steps=100000")
    training.append("trainer.val_check_interval=100000")
    trained = _growth(_measured("train", num_steps, *training))
    return trained, _growth(_measured("rollouts", num_rollouts, str(folder), str(data)))


def _measured(what: str, count: int, *rest: str) -> list[int]:
    process = start([what, str(count), *rest], "tests.reliability.memory_child")
    output, _ = process.communicate(timeout=1800)
    if process.returncode != 0:
        raise RuntimeError(f"{what} ended with {process.returncode}:\n{output[-3000:]}")
    return json.loads(output.strip().splitlines()[-1])


def _growth(found: list[int]) -> float:
    """Return the growth from the second tenth, when all is warm, to the last."""
    tenth = len(found) // 10
    return statistics.median(found[-tenth:]) / statistics.median(found[tenth : 2 * tenth]) - 1


def _outcome(promise: str, growths: Sequence[float]) -> Outcome:
    seen = ", ".join(f"{model} {100 * growth:+.2f} %" for model, growth in zip(MODELS, growths, strict=True))
    return Outcome(promise, len(growths), sum(growth < MAX_GROWTH for growth in growths), seen)
