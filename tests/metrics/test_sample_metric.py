"""Metrics that keep every sample: the same numbers from one process and from several."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.psnr import psnr
from vpd_lightning.metrics.registry import metric
from vpd_lightning.metrics.sample_metric import SampleMetric
from vpd_lightning.metrics.true_images import TrueImages

SHAPE = (3, 2, 12, 14, 3)  # step view height width channel
NUM_SAMPLES = 5


def images(sample: int) -> tuple[Tensor, TrueImages]:
    generator = torch.Generator().manual_seed(sample)
    pred, colors = torch.rand(2, *SHAPE, generator=generator)
    return pred, TrueImages(colors, torch.rand(SHAPE[:-1], generator=generator) > 0.5, 3)


def filled(info: MetricInfo, samples: list[int], *, last_step_only: bool = False) -> SampleMetric:
    found = SampleMetric(info, last_step_only=last_step_only)
    for sample in samples:
        found.update(sample, *images(sample))
    return found


def points(sample: int) -> tuple[Tensor, list[Tensor]]:
    """Particles whose number differs between samples, and true points."""
    generator = torch.Generator().manual_seed(sample)
    draw = torch.rand(2, 4 + sample, 7, 3, generator=generator, dtype=torch.float64)
    return draw[0], list(draw[1])


def test_the_mean_is_that_of_the_samples_means() -> None:
    found = filled(metric("psnr"), [0, 1, 2])
    means = [psnr(pred, truth.colors).mean() for pred, truth in map(images, range(3))]
    assert torch.equal(found.compute(), (means[0] + means[1] + means[2]) / 3), "bit for bit"
    last = filled(metric("psnr"), [0, 1], last_step_only=True).compute()
    expected = [psnr(pred, truth.colors)[-1].mean() for pred, truth in map(images, range(2))]
    assert torch.equal(last, (expected[0] + expected[1]) / 2)


def test_a_sample_seen_twice_counts_once_and_the_order_does_not_matter() -> None:
    once, twice = filled(metric("ssim"), [0, 1, 2]), filled(metric("ssim"), [2, 0, 1, 0, 2])
    assert torch.equal(once.compute(), twice.compute()) and list(twice.by_sample()) == [0, 1, 2]


def test_all_parts_of_every_sample_are_kept_in_their_shapes() -> None:
    found = SampleMetric(metric("chamfer"))
    for sample in (3, 1):
        found.update(sample, *points(sample))
    values = found.by_sample()
    assert {sample: len(parts["mean"]) for sample, parts in values.items()} == {1: 5, 3: 7}
    direct = metric("chamfer").load()(*points(3))
    assert values[3].keys() == direct.keys() and all(torch.equal(values[3][part], direct[part]) for part in direct)


def test_what_is_not_known_does_not_count() -> None:
    found = SampleMetric(metric("psnr_moving"))
    for sample in (0, 1):
        pred, truth = images(sample)
        found.update(sample, pred, replace(truth, min_moving_pixels=10**6 if sample else 3))
    assert torch.equal(found.compute(), filled(metric("psnr_moving"), [0]).compute())
    with pytest.warns(UserWarning, match="before the ``update``"):
        assert torch.isnan(SampleMetric(metric("psnr")).compute())


def test_it_starts_anew_after_a_reset_and_stands_in_no_checkpoint() -> None:
    found = filled(metric("psnr"), [0])
    found.reset()
    found.update(1, *images(1))
    assert list(found.by_sample()) == [1] and found.state_dict() == {}


def shares(kind: str) -> list[list[int]]:
    """Samples of each of two processes; ``padded`` repeats the first one, as a distributed sampler does."""
    return {"padded": [[0, 2, 4], [1, 3, 0]], "uneven": [[4, 0, 3], [2, 1]], "one is idle": [[0, 1, 2, 3, 4], []]}[kind]


def measure_share(rank: int, folder: Path) -> None:
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    for kind in ("padded", "uneven", "one is idle"):
        scores = filled(metric("psnr_moving"), shares(kind)[rank])
        distances = SampleMetric(metric("chamfer"))
        for sample in shares(kind)[rank]:
            distances.update(sample, *points(sample))
        found = [scores.compute(), scores.by_sample(), distances.compute(), distances.by_sample()]
        torch.save(found, folder / f"{kind}_{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.ddp
def test_two_processes_measure_what_one_does_sample_by_sample(tmp_path: Path) -> None:
    # In a process that has computed nothing yet: a fork of one that has may hang.
    program = (
        "import sys; from tests.metrics.test_sample_metric import *; "
        "from torch.multiprocessing import start_processes; "
        "start_processes(measure_share, (Path(sys.argv[1]),), nprocs=2, start_method='fork')"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", program, str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    scores, distances = filled(metric("psnr_moving"), list(range(NUM_SAMPLES))), SampleMetric(metric("chamfer"))
    for sample in range(NUM_SAMPLES):
        distances.update(sample, *points(sample))
    alone = [scores.compute(), scores.by_sample(), distances.compute(), distances.by_sample()]
    for kind in ("padded", "uneven", "one is idle"):
        for rank in (0, 1):
            for value, expected in zip(torch.load(tmp_path / f"{kind}_{rank}.pt"), alone, strict=True):
                # Bit for bit: what is gathered is brought in one order before it is added.
                torch.testing.assert_close(value, expected, rtol=0, atol=0)
