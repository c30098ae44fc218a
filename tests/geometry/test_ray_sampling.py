import pytest
import torch

from vpd_lightning.geometry.ray_sampling import even_quantiles, sample_pdf, stratified_samples


def test_without_noise_samples_are_evenly_spaced_from_near_to_far() -> None:
    t = stratified_samples(0.5, 2.5, 5, 3, None)
    torch.testing.assert_close(t, torch.tensor([0.5, 1.0, 1.5, 2.0, 2.5]).expand(3, 5))


def test_noise_keeps_each_sample_in_its_stratum() -> None:
    low = stratified_samples(0.5, 2.5, 5, 2, torch.zeros(2, 5, dtype=torch.float64))
    high = stratified_samples(0.5, 2.5, 5, 2, torch.ones(2, 5, dtype=torch.float64))
    assert low.dtype == torch.float64
    torch.testing.assert_close(low[0], torch.tensor([0.5, 0.75, 1.25, 1.75, 2.25], dtype=torch.float64))
    torch.testing.assert_close(high[0], torch.tensor([0.75, 1.25, 1.75, 2.25, 2.5], dtype=torch.float64))
    t = stratified_samples(0.5, 2.5, 5, 100, torch.rand(100, 5))
    assert bool((t.diff(dim=-1) >= 0).all()) and float(t.min()) >= 0.5 and float(t.max()) <= 2.5


def test_samples_follow_the_weights() -> None:
    bins = torch.tensor([[0.0, 1.0, 3.0, 4.0]])
    weights = torch.tensor([[1.0, 2.0, 5.0]])
    samples = sample_pdf(bins, weights, torch.rand(1, 200_000))
    shares = torch.histogram(samples[0], bins[0]).hist / 200_000
    # Three standard deviations of a share among 200,000 draws are below 0.0035.
    torch.testing.assert_close(shares, weights[0] / 8, rtol=0, atol=0.0035)


def test_samples_are_the_inverse_of_the_cumulated_weights() -> None:
    bins = torch.tensor([[0.0, 1.0, 3.0]], dtype=torch.float64)
    weights = torch.tensor([[1.0, 3.0]], dtype=torch.float64)
    u = torch.tensor([[0.0, 0.125, 0.25, 0.625]], dtype=torch.float64)
    # The padding of 1e-5 shifts the edge between the bins by less than 1e-5.
    torch.testing.assert_close(
        sample_pdf(bins, weights, u), torch.tensor([[0.0, 0.5, 1.0, 2.0]], dtype=torch.float64), rtol=0, atol=2e-5
    )


def test_samples_are_ascending_in_u_and_stay_within_the_bins() -> None:
    bins = torch.rand(64, 33).sort(dim=-1).values
    weights = torch.rand(64, 32) ** 8
    samples = sample_pdf(bins, weights, torch.rand(64, 100).sort(dim=-1).values)
    assert bool((samples.diff(dim=-1) >= 0).all())
    assert bool((samples >= bins[:, :1]).all()) and bool((samples <= bins[:, -1:]).all())


def test_all_zero_weights_are_sampled_uniformly() -> None:
    bins = torch.linspace(1, 3, 9).expand(2, 9)
    samples = sample_pdf(bins, torch.zeros(2, 8), even_quantiles(5, 2, bins.device))
    torch.testing.assert_close(samples[0], torch.tensor([1.0, 1.5, 2.0, 2.5, 3.0]), rtol=0, atol=1e-5)


def test_a_single_heavy_bin_takes_nearly_all_samples_also_among_many() -> None:
    bins = torch.linspace(0, 1, 1001)[None]
    weights = torch.zeros(1, 1000)
    weights[0, 700] = 1e6
    samples = sample_pdf(bins, weights, torch.rand(1, 1000))
    assert bool(((samples > 0.6999) & (samples < 0.7011)).all())


def test_bins_of_zero_width_are_allowed() -> None:
    bins = torch.tensor([[1.0, 1.0, 1.0, 2.0, 2.0]])
    samples = sample_pdf(bins, torch.ones(1, 4), torch.rand(1, 50))
    assert bool(torch.isfinite(samples).all()) and bool((samples >= 1).all()) and bool((samples <= 2).all())


def test_the_largest_u_below_one_stays_inside() -> None:
    u = torch.full((1, 1), 1.0 - torch.finfo(torch.float32).eps / 2)
    samples = sample_pdf(torch.linspace(0, 1, 128)[None], torch.rand(1, 127), u)
    assert float(samples) <= 1.0
    assert float(even_quantiles(7, 1, u.device).max()) < 1.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_are_constants(dtype: torch.dtype) -> None:
    weights = torch.rand(2, 8, dtype=dtype, requires_grad=True)
    samples = sample_pdf(torch.linspace(0, 1, 9, dtype=dtype).expand(2, 9), weights, torch.rand(2, 4, dtype=dtype))
    assert not samples.requires_grad and samples.dtype == dtype


def test_half_precision_weights_are_sampled_in_float32() -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        samples = sample_pdf(torch.linspace(0, 1, 9).expand(2, 9), torch.rand(2, 8).bfloat16(), torch.rand(2, 4))
    assert samples.dtype == torch.float32
