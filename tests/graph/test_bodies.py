"""Islands of convexly connected particles: one label for each body, whatever the numbers are."""

import pytest
import torch

from tests.dynamics.solids import ball, cube, even_ball, even_cube, random_rotation
from vpd_lightning.graph.bodies import label_bodies

SETTINGS = {"num_bodies": 6, "link": 1.7, "max_concavity": 0.15, "max_concave_share": 0.35}


def labelled(positions, normals, mask=None, colors=None, **changes):
    """Label the particles of one scene; without colours the bodies are motley, and colour says nothing."""
    mask = torch.ones(len(positions), dtype=torch.bool) if mask is None else mask
    colors = motley(positions) if colors is None else colors
    return label_bodies(positions[None], normals[None], colors[None], mask[None], **{**SETTINGS, **changes})[0]


def motley(positions):
    """Red, green or blue, by the order of the particles."""
    return torch.eye(3, dtype=positions.dtype)[torch.arange(len(positions)) % 3]


def joined(*bodies):
    """Points and normals of bodies at their places, and to which each belongs."""
    positions = torch.cat([points + torch.tensor(at, dtype=torch.float64) for points, _, at in bodies])
    normals = torch.cat([normals for _, normals, _ in bodies])
    return positions, normals, torch.cat([torch.full((len(b[0]),), number) for number, b in enumerate(bodies)])


def agreement(labels, truth):
    """The share of particles whose label is that of most of their body, where bodies have labels of their own."""
    names = [labels[truth == body].mode().values.item() for body in truth.unique()]
    if len(set(names)) < len(names) or len(labels.unique()) != len(names):
        return 0.0
    return sum((labels[truth == body] == name).sum().item() for body, name in enumerate(names)) / len(labels)


def random_cube(count, seed, half=0.15):
    positions, _, normals = cube(count, seed, half, num_faces=6)
    return positions, normals


def random_ball(count, seed, radius=0.15):
    positions, _, normals = ball(count, seed, radius)
    return positions, normals


@pytest.mark.parametrize("make", [lambda: random_cube(200, 1), lambda: random_ball(150, 2), lambda: even_cube(6)])
def test_one_convex_body_is_one(make):
    assert (labelled(*make()) == 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_two_cubes_apart_are_two_exactly(seed):
    turn = random_rotation(seed)
    positions, normals, truth = joined(
        (*random_cube(200, seed), (0, 0, 0.15)), (*random_cube(150, seed + 9), (0.5, 0.1, 0.15))
    )

    labels = labelled(positions @ turn.T, normals @ turn.T)

    assert torch.equal(labels, truth)  # the first has more particles


def side_by_side(seed):
    """Two cubes face to face, shifted along the face that they share; what lies between them cannot be seen."""
    positions, normals, truth = joined(
        (*random_cube(300, seed), (0, 0, 0)), (*random_cube(300, seed + 20), (0.3, 0.12, 0.1))
    )
    seen = (positions[:, 0] - 0.15).abs() > 1e-9
    return positions[seen], normals[seen], truth[seen]


def stacked(seed):
    positions, normals, truth = joined(
        (*random_cube(400, seed, half=0.2), (0, 0, 0)), (*random_cube(200, seed + 20, half=0.12), (0.03, -0.02, 0.32))
    )
    hidden = (normals[:, 2].abs() > 0.5) & ((positions[:, 2] - 0.2).abs() < 1e-9)
    hidden &= ((positions[:, :2] - torch.tensor([0.03, -0.02])).abs() < 0.12).all(dim=-1)
    return positions[~hidden], normals[~hidden], truth[~hidden]


def kissing(seed):
    return joined((*random_ball(300, seed), (0, 0, 0)), (*random_ball(300, seed + 20), (0.3, 0, 0)))


def seen_from_above(positions, normals, truth):
    """What two cameras see."""
    directions = torch.tensor([[0.6, 0.2, 0.7], [-0.5, 0.4, 0.7]], dtype=torch.float64)
    seen = (normals @ directions.T > 0).any(dim=-1)
    return positions[seen], normals[seen], truth[seen]


def share_parted(make, **changes):
    """In which share of random drawings two bodies that touch are separated, as two cameras from above see them."""
    parted = []
    for seed in range(12):
        positions, normals, truth = seen_from_above(*make(seed))
        parted.append(agreement(labelled(positions, normals, **changes), truth) > 0.93)
    return sum(parted) / len(parted)


# Measured with exact normals and hundreds of random points: 12, 8 and 11 of 12 with a hollow share of 0.05; 12, 0 and 3
# with the 0.35 of conf/. Where one chain of pairs is not hollow, the two are one.
@pytest.mark.parametrize(("make", "least"), [(side_by_side, 0.75), (stacked, 0.4), (kissing, 0.75)])
def test_bodies_that_touch_are_mostly_told_apart_where_hardly_any_hollow_pair_is_borne(make, least):
    assert share_parted(make, max_concave_share=0.05) >= least


def test_cubes_side_by_side_are_told_apart_with_the_settings_of_conf():
    assert share_parted(side_by_side) >= 0.75


@pytest.mark.xfail(strict=True, reason="with max_concave_share of 0.35 a few pairs around the touch join two bodies")
@pytest.mark.parametrize("make", [stacked, kissing])
def test_a_cube_on_a_cube_and_two_balls_are_told_apart_with_the_settings_of_conf(make):
    assert share_parted(make) >= 0.5


def test_neighbours_of_one_colour_are_parts_of_one_body_and_others_are_not():
    positions, normals, truth = seen_from_above(*side_by_side(0))
    red, pink, blue = (
        torch.tensor(color, dtype=torch.float64) for color in ([0.8, 0.1, 0.1], [0.56, 0.07, 0.07], [0.1, 0.1, 0.8])
    )

    def with_colors(first, second):
        return labelled(positions, normals, colors=torch.where((truth == 0)[:, None], first, second))

    assert len(with_colors(red, red).unique()) == 1
    assert len(with_colors(red, pink).unique()) == 1  # in the shade
    assert len(with_colors(red, blue).unique()) == 2
    assert len(labelled(positions, normals).unique()) == 2


def test_bodies_of_one_colour_apart_are_two():
    positions, normals, truth = joined((*random_cube(200, 0), (0, 0, 0.15)), (*random_cube(150, 9), (0.5, 0.1, 0.15)))

    labels = labelled(positions, normals, colors=torch.full_like(positions, 0.5))

    assert torch.equal(labels, truth)


def test_bodies_beyond_the_wanted_number_join_the_nearest():
    bodies = [(*random_ball(80 - 8 * number, number), (float(number), 0, 0)) for number in range(4)]
    positions, normals, truth = joined(*bodies)

    assert torch.equal(labelled(positions, normals, num_bodies=4), truth)
    assert torch.equal(labelled(positions, normals, num_bodies=2), truth.clamp(max=1))
    assert (labelled(positions, normals, num_bodies=1) == 0).all()


def test_the_body_of_most_particles_comes_first():
    positions, normals, truth = joined((*random_ball(60, 0), (0, 0, 0)), (*random_ball(120, 1), (1, 0, 0)))

    assert torch.equal(labelled(positions, normals), 1 - truth)


def test_a_few_strays_join_the_nearest_body():
    strays = torch.tensor([[0.2, 0.0, 0.0], [0.8, 0.0, 0.0]], dtype=torch.float64)
    positions, normals, truth = joined((*random_ball(120, 1), (0, 0, 0)), (*random_ball(60, 0), (1, 0, 0)))
    positions, normals = torch.cat([positions, strays]), torch.cat([normals, torch.zeros_like(strays)])

    assert torch.equal(labelled(positions, normals), torch.cat([truth, torch.tensor([0, 1])]))


@pytest.mark.parametrize("number", [1, 5])
def test_strays_farther_than_a_body_is_long_belong_to_none(number):
    strays = torch.tensor([10.0, 0.0, 0.0], dtype=torch.float64) + 0.01 * torch.eye(5, 3, dtype=torch.float64)[:number]
    positions, normals, truth = joined((*random_ball(120, 1), (0, 0, 0)), (*random_ball(60, 0), (1, 0, 0)))
    positions, normals = torch.cat([strays, positions]), torch.cat([torch.zeros_like(strays), normals])

    assert torch.equal(labelled(positions, normals), torch.cat([torch.full((number,), -1), truth]))


def test_a_distant_island_is_a_body():
    distant = torch.tensor([10.0, 0.0, 0.0], dtype=torch.float64) + random_ball(60, 0)[0]
    positions, normals, truth = joined((*random_ball(120, 1), (0, 0, 0)))
    both = torch.cat([positions, distant]), torch.cat([normals, random_ball(60, 0)[1]])

    assert torch.equal(labelled(*both), torch.cat([truth, torch.full((60,), 1)]))


def scenes():
    return [
        joined((*random_cube(150, 1), (0, 0, 0)), (*random_cube(100, 2), (0.5, 0.1, 0.2))),
        joined((*random_ball(150, 3), (0, 0, 0)), (*random_ball(120, 4), (0.3, 0, 0))),
    ]


@pytest.mark.parametrize("scene", [0, 1])
def test_order_place_and_scale_of_the_particles_do_not_matter(scene):
    positions, normals, _ = scenes()[scene]
    expected = labelled(positions, normals)
    order = torch.randperm(len(positions), generator=torch.Generator().manual_seed(0))
    shift = torch.tensor([8.0, -4.0, 16.0], dtype=torch.float64)

    assert torch.equal(labelled(positions[order], normals[order]), expected[order])
    assert torch.equal(labelled(positions + shift, normals), expected)
    assert torch.equal(labelled(1024 * positions, normals), expected)
    assert torch.equal(labelled(positions / 1024, normals), expected)


@pytest.mark.parametrize("scene", [0, 1])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_turning_the_world_does_not_matter(scene, seed):
    positions, normals, _ = scenes()[scene]
    turn = random_rotation(seed)

    assert torch.equal(labelled(positions @ turn.T, normals @ turn.T), labelled(positions, normals))


@pytest.mark.parametrize("order", ["as it is", "turned round"])
def test_equal_bodies_are_numbered_by_place_not_by_order(order):
    positions, normals, truth = joined((*even_ball(80), (0, 0, 0)), (*even_ball(80), (1, 0, 0)))
    index = torch.arange(160) if order == "as it is" else torch.arange(159, -1, -1)

    labels = labelled(positions[index], normals[index])

    first = labels[positions[index][:, 0] < 0.5].unique()
    assert len(first) == 1
    assert first.item() == labelled(positions, normals)[0].item()


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_few_particles_are_one_body(count):
    positions, normals = random_cube(8, 3)
    mask = torch.arange(8) < count

    labels = labelled(positions, normals, mask)

    assert torch.equal(labels, torch.where(mask, 0, -1))


def test_coincident_particles_are_one_body():
    positions, normals = torch.zeros(20, 3, dtype=torch.float64), torch.zeros(20, 3, dtype=torch.float64)
    assert (labelled(positions, normals) == 0).all()


def test_padding_is_no_body_and_members_do_not_see_each_other():
    positions, normals, truth = scenes()[0]
    mask = torch.rand(len(positions), generator=torch.Generator().manual_seed(5)) < 0.8
    positions[~mask], normals[~mask] = float("nan"), 1e6
    empty = torch.zeros_like(mask)

    both = [torch.stack([values, values]) for values in (positions, normals, motley(positions))]
    labels = label_bodies(*both, torch.stack([mask, empty]), **SETTINGS)

    assert labels.shape == (2, len(mask)) and labels.dtype == torch.int64
    assert torch.equal(labels[0], torch.where(mask, truth, -1))
    assert (labels[1] == -1).all()


def test_single_precision_tells_the_same():
    positions, normals, truth = scenes()[0]
    assert torch.equal(labelled(positions.float(), normals.float()), truth)


def test_unknown_normals_join_what_is_near():
    positions, normals, truth = scenes()[0]
    unknown = torch.rand(len(positions), generator=torch.Generator().manual_seed(5)) < 0.1
    normals[unknown] = 0.0

    assert agreement(labelled(positions, normals), truth) == 1.0


def test_labels_carry_no_gradient():
    positions, normals, _ = scenes()[0]
    assert not labelled(positions.requires_grad_(), normals).requires_grad
