import torch

from vpd_lightning.geometry.workspace import choose, inside_workspace


def test_bounds_belong_to_the_workspace_and_nan_does_not():
    points = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1.001, 0, 0], [float("nan"), 0, 0]])

    inside = inside_workspace(points, [-1, -1, -1], [1, 1, 1])

    assert inside.tolist() == [True, True, False, False]


def test_choice_is_without_replacement_and_repeats_with_the_generator():
    candidates = torch.arange(50) % 3 == 0

    index, valid = choose(candidates, 10, torch.Generator().manual_seed(1))
    again, _ = choose(candidates, 10, torch.Generator().manual_seed(1))

    assert valid.all() and candidates[index].all()
    assert len(set(index.tolist())) == 10
    assert torch.equal(index, again)


def test_too_few_candidates_are_padded():
    index, valid = choose(torch.tensor([False, True, True]), 5, torch.Generator().manual_seed(0))

    assert sorted(index[valid].tolist()) == [1, 2]
    assert valid.tolist() == [True, True, False, False, False]
