import math

import numpy as np
import pytest
import torch

from vpd_lightning.renderer.shadows import Shadows, _Beam, _lines_pass_near


def shadows(num_lights=3, softness=0.1, share=0.2, seed=0):
    """Lights in random upper directions, with random shares (some below zero) and widths."""
    generator = torch.Generator().manual_seed(seed)
    model = Shadows(num_lights=num_lights, softness=softness).double()
    with torch.no_grad():
        model.directions += 0.3 * torch.randn(num_lights, 3, generator=generator)
        model.shares.copy_(share * (1.3 * torch.rand(num_lights, 3, generator=generator) - 0.3))
        model.log_softness += 0.3 * torch.randn(num_lights, generator=generator)
        model.log_slope += 2 + 0.3 * torch.randn(num_lights, generator=generator)
    return model


def scene(batch=2, num_points=9, num_occluders=11, seed=0):
    """Points on the floor and occluders up to half a metre above it, a third of them padding with junk."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(batch, num_points, 3, generator=generator).double() * torch.tensor([1.0, 1.0, 0.05])
    occluders = torch.rand(batch, num_occluders, 3, generator=generator).double() * torch.tensor([1.0, 1.0, 0.5])
    mask = torch.rand(batch, num_occluders, generator=generator) > 0.33
    return points, torch.where(mask[..., None], occluders, 30.0), mask


def spacing_of(occluders):
    """The median distance to the fourth nearest, none where there are too few."""
    gaps = np.sort(np.linalg.norm(occluders[:, None] - occluders, axis=-1), axis=1)
    return np.sort(gaps[:, 4])[(len(gaps) - 1) // 2] if len(gaps) > 4 else None


def across(one, other, direction):
    return float(np.linalg.norm(np.cross(other - one, direction)))


def plain(model, points, occluders, mask):
    """Every light, point and occluder in turn, by the words of the class. NumPy, float64."""
    weights = {name: value.detach().numpy() for name, value in model.named_parameters()}
    softnesses, slopes = (np.exp(weights[f"log_{name}"]) for name in ("softness", "slope"))
    light = np.ones(points.shape)
    for member in range(len(points)):
        casting = occluders[member][mask[member]].numpy()
        spacing = spacing_of(casting)
        for number, direction in enumerate(weights["directions"]):
            direction = direction / np.linalg.norm(direction)
            reach = softnesses[number] if spacing is None else 0.4 * spacing
            width = reach if spacing is None else math.hypot(reach, softnesses[number])
            stacked = [
                sum(math.exp(-((across(one, other, direction) / reach) ** 2) / 2) for other in casting)
                for one in casting
            ]
            for i, point in enumerate(points[member].numpy()):
                hidden = 0.0
                for occluder, behind_one_another in zip(casting, stacked, strict=True):
                    towards = float((occluder - point) @ direction)
                    ahead = 1 / (1 + math.exp(2 - towards / (0.5 * width)))
                    square = width**2 + (slopes[number] * towards) ** 2
                    kernel = reach**2 / square * math.exp(-(across(point, occluder, direction) ** 2) / (2 * square))
                    hidden += kernel * ahead / behind_one_another
                light[member, i] -= np.maximum(weights["shares"][number], 0) * min(hidden, 1.0)
    return torch.from_numpy(np.maximum(light, 0.05))


@pytest.mark.parametrize("seed", range(3))
def test_light_is_what_plain_loops_give(seed):
    model, (points, occluders, mask) = shadows(seed=seed, share=0.6), scene(seed=seed)

    light, expected = model(points, occluders, mask), plain(model, points, occluders, mask)

    torch.testing.assert_close(light, expected, rtol=0, atol=1e-9)
    assert expected.min() < 0.8


def test_a_point_above_all_else_has_all_the_light():
    model, (points, occluders, _) = shadows(), scene()

    none = model(points, occluders[:, :0], torch.zeros(2, 0, dtype=torch.bool))
    masked = model(points, occluders, torch.zeros(2, 11, dtype=torch.bool))

    assert torch.equal(none, torch.ones_like(points)) and torch.equal(masked, torch.ones_like(points))


def test_a_shadow_is_as_dense_whatever_the_number_of_points():
    model = Shadows(num_lights=1, softness=0.02).double()  # straight up
    points = torch.tensor([[[0.0, 0.0, 0.0], [0.05, 0.02, 0.0], [0.2, 0.0, 0.0]]]).double()
    light = [
        model(points, disc([0.0, 0.0, 0.3], count=count)[None], torch.ones(1, count, dtype=torch.bool))
        for count in (100, 400)
    ]

    torch.testing.assert_close(light[0], light[1], rtol=0, atol=3e-3)
    assert light[0][0, :2].max() < 0.92 and light[0][0, 2].min() > 0.999


def half_plane(height, step=0.016, seed=0):
    """Points on a grid, moved at random by up to a third of its step, with positive x and wider than any edge."""
    generator = torch.Generator().manual_seed(seed)
    grid = torch.cartesian_prod(torch.arange(38) + 0.5, torch.arange(75) - 37.0).double()
    moved = step * (grid + 0.66 * (torch.rand(grid.shape, generator=generator).double() - 0.5))
    return torch.cat([moved, torch.full((len(grid), 1), height).double()], dim=1)


def darkness(model, occluders, reach=0.2):
    """Along a line on the floor below the edge of a half plane."""
    line = torch.zeros(1, 9, 3).double()
    line[0, :, 0] = torch.linspace(-reach, reach, 9)
    return line[0, :, 0], 1 - model(line, occluders[None], torch.ones(1, len(occluders), dtype=torch.bool))[0, :, 0]


@pytest.mark.parametrize("slope", [0.05, 0.2])
@pytest.mark.parametrize("num_sheets", [1, 2])
def test_the_edge_of_a_shadow_is_wider_the_higher_the_body_is(slope, num_sheets):
    """Below the edge of a half plane it is the normal distribution, whether the body has one side or two."""
    model = Shadows(num_lights=1, softness=0.002).double()  # straight up
    with torch.no_grad():
        model.log_slope.fill_(math.log(slope))
        model.shares.fill_(0.9)
    for height in (0.3, 0.6):
        sheets = torch.cat([half_plane(height + 0.01 * number, seed=number) for number in range(num_sheets)])
        place, dark = darkness(model, sheets)
        expected = torch.special.ndtr(place / (slope * height))
        torch.testing.assert_close(dark / dark[-1], expected / expected[-1], rtol=0, atol=0.1)
        assert dark[-1] > 0.8 * 0.9 * expected[-1]


def test_masked_occluders_cast_nothing():
    model, (points, occluders, mask) = shadows(), scene()
    junk = torch.where(mask[..., None], occluders, points.mean(dim=1, keepdim=True) + torch.tensor([0.0, 0.0, 0.3]))

    torch.testing.assert_close(model(points, junk, mask), model(points, occluders, mask), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("height", "lit"), [(0.5, False), (0.2, False), (-0.2, True), (-0.5, True)])
def test_only_what_is_above_a_point_casts_on_it(height, lit):
    model = Shadows(num_lights=1, softness=0.05).double()  # straight up
    model.log_slope.data -= 9.0
    point, occluders = torch.zeros(1, 1, 3).double(), torch.tensor([0.0, 0.0, height]).double().expand(1, 20, 3)

    light = model(point, occluders, torch.ones(1, 20, dtype=torch.bool))

    torch.testing.assert_close(light, torch.full_like(point, 1.0 if lit else 0.9), rtol=0, atol=1e-3)


def test_a_shadow_falls_on_the_side_away_from_the_light():
    model = Shadows(num_lights=1, softness=0.03).double()
    with torch.no_grad():
        model.directions.copy_(torch.tensor([[1.0, 0.0, 1.0]]))  # the light stands at the side of positive x
        model.log_slope -= 9.0
    points = torch.tensor([[[-0.4, 0.0, 0.0], [0.4, 0.0, 0.0], [0.0, 0.0, 0.0], [-0.4, 0.3, 0.0]]]).double()
    occluders = torch.tensor([0.0, 0.0, 0.4]).double().expand(1, 9, 3)

    light = model(points, occluders, torch.ones(1, 9, dtype=torch.bool))[0, :, 0]

    assert light[0] < 0.901 and (light[1:] > 0.999).all()


def test_shifting_everything_far_away_changes_nothing():
    model, (points, occluders, mask) = shadows().float(), scene()
    points, occluders = points.float(), occluders.float()
    shift = torch.tensor([200.0, -300.0, 100.0])

    light, shifted = model(points, occluders, mask), model(points + shift, occluders + shift, mask)

    # A place 300 m away is known to 3e-5 m in float32, against widths of 0.1 m.
    assert (light - shifted).abs().max() < 2e-3
    assert (light - model(points + shift, occluders, mask)).abs().max() > 0.05


def test_members_do_not_cast_on_each_other():
    model, (points, occluders, mask) = shadows(), scene()

    together = model(points, occluders, mask)

    for i in range(2):
        alone = model(points[i : i + 1], occluders[i : i + 1], mask[i : i + 1])
        torch.testing.assert_close(together[i : i + 1], alone, rtol=0, atol=1e-12)


def test_lights_without_a_share_do_nothing():
    model, (points, occluders, mask) = shadows(), scene()
    with torch.no_grad():
        model.shares[1] = torch.tensor([-0.3, 0.0, -0.1])
    fewer = Shadows(num_lights=2, softness=0.1).double()
    with torch.no_grad():
        for name, _ in fewer.named_parameters():
            getattr(fewer, name).copy_(getattr(model, name)[[0, 2]])

    torch.testing.assert_close(
        model(points, occluders, mask), fewer(points, occluders, mask), rtol=0, atol=1e-12
    )  # fmt: skip
    with torch.no_grad():
        model.shares.fill_(-1.0)
    assert torch.equal(model(points, occluders, mask), torch.ones_like(points))


def test_light_never_runs_out():
    model, (points, _, _) = shadows(share=5.0), scene()

    light = model(points, (points + torch.tensor([0.0, 0.0, 0.5])).repeat(1, 9, 1), torch.ones(2, 81, dtype=torch.bool))

    assert light.min().item() == pytest.approx(0.05)


def test_gradients_match_finite_differences(monkeypatch):
    # How many points lie behind one another is a constant for the gradient.
    monkeypatch.setattr(_Beam, "shares_of_outline", lambda beam, occluders, mask: 0.3 * mask.to(occluders.dtype))
    model, (points, occluders, mask) = shadows(num_lights=2, share=0.3), scene(batch=1, num_points=4, num_occluders=5)
    model.shares.data.abs_()  # at shares below zero the gradient goes through a clamp on purpose
    names = [name for name, _ in model.named_parameters()]

    def light(points, occluders, *weights):
        return torch.func.functional_call(model, dict(zip(names, weights, strict=True)), (points, occluders, mask))

    weights = [parameter.detach().clone().requires_grad_() for parameter in model.parameters()]
    inputs = (points.requires_grad_(), torch.where(mask[..., None], occluders, 1.0).requires_grad_(), *weights)
    assert torch.autograd.gradcheck(light, inputs, eps=1e-6, atol=1e-6)


def disc(center, radius=0.1, count=40):
    """Points spread over a level disc."""
    steps = torch.arange(count).double()
    angle, distance = 2.399963 * steps, radius * ((steps + 0.5) / count).sqrt()
    flat = torch.stack([distance * angle.cos(), distance * angle.sin(), torch.zeros_like(steps)], dim=-1)
    return flat + torch.tensor(center, dtype=torch.float64)


def cast(points, centers, direction, radius=0.1, width=0.02):
    """How much light a disc leaves: the line from a point to the light crosses the disc's height inside of it."""
    height = centers[:, None, 2:] / direction[2]
    crossing = points + height * direction
    gap = (crossing - centers[:, None])[..., :2].norm(dim=-1, keepdim=True) - radius
    return 1 - torch.tensor([0.3, 0.25, 0.2]).double() * torch.sigmoid(-gap / width)


@pytest.mark.parametrize("num_lights", [1, 4])
def test_the_direction_of_the_light_is_learned_from_shadows(num_lights):
    direction = torch.tensor([math.sin(math.radians(30)), 0.0, math.cos(math.radians(30))]).double()
    generator = torch.Generator().manual_seed(0)
    centers = torch.tensor([[0.0, 0.0, 0.2], [0.2, 0.1, 0.35], [-0.1, 0.2, 0.5]]).double()
    occluders = torch.stack([disc(center.tolist()) for center in centers])
    floor = (1.6 * torch.rand(3, 150, 3, generator=generator).double() - 0.8) * torch.tensor([1.0, 1.0, 0.0])
    target, mask = cast(floor, centers, direction), torch.ones(3, 40, dtype=torch.bool)
    model = Shadows(num_lights=num_lights, softness=0.1).double()
    # A share starts at 0.1 / num_lights: steps as large as that would end it before its light has found its place.
    slow = {"params": [model.shares], "lr": 0.003}
    optimizer = torch.optim.Adam([{"params": [model.directions, model.log_softness]}, slow], lr=0.03)

    for _ in range(120):
        optimizer.zero_grad()
        (model(floor, occluders, mask) - target).square().mean().backward()
        optimizer.step()

    main = model.directions[model.shares.sum(dim=1).argmax()]
    angle = torch.rad2deg(torch.acos((main @ direction / main.norm()).clamp(-1, 1)))
    assert angle < 5
    assert (model(floor, occluders, mask) - target).square().mean() < 0.1 * (1 - target).square().mean()


def test_parameters_are_part_of_the_picture_even_where_all_lights_went_out():
    """A training in several processes waits for the gradient of every parameter, be it zero."""
    model, (points, occluders, mask) = shadows(), scene()
    with torch.no_grad():
        model.shares.fill_(-0.01)

    light = model(points, occluders, mask)

    assert light.requires_grad
    light.sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name


def test_a_light_that_is_gone_has_gradients_of_zero_and_one_that_went_out_may_come_back():
    model, (points, occluders, mask) = shadows(), scene()
    with torch.no_grad():
        model.shares.copy_(torch.tensor([[0.2] * 3, [-0.05] * 3, [-0.4] * 3]))

    model(points, occluders, mask).sum().backward()

    assert model.shares.grad[1].abs().min() > 0
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter.grad[2], torch.zeros_like(parameter.grad[2])), name


@pytest.mark.parametrize(("num_lights", "softness"), [(0, 0.1), (2, 0.0), (1, -1.0)])
def test_wrong_settings_are_refused(num_lights, softness):
    with pytest.raises(ValueError, match="num_lights must be at least 1 and softness positive"):
        Shadows(num_lights=num_lights, softness=softness)


def far_apart(batch=3, num_points=40, seed=0):
    """Bodies metres apart, more of them than balls that decide which points to look at; one member has none."""
    generator = torch.Generator().manual_seed(seed)
    bodies = 6 * torch.rand(batch, 12, 1, 3, generator=generator).double() * torch.tensor([1.0, 1.0, 0.2])
    occluders = (bodies + 0.3 * torch.rand(batch, 12, 5, 3, generator=generator).double()).flatten(1, 2)
    mask = torch.rand(batch, 60, generator=generator) > 0.2
    mask[1] = False
    below = torch.tensor([1.0, 1.0, 0.0])
    near = occluders[:, torch.randint(60, (num_points,), generator=generator)] * below
    anywhere = 16 * torch.rand(batch, num_points, 3, generator=generator).double() * torch.tensor([1.0, 1.0, 0.4])
    return torch.cat([near, anywhere], dim=1), torch.where(mask[..., None], occluders, torch.nan), mask


@pytest.mark.parametrize("seed", range(3))
def test_points_that_are_left_out_would_have_had_all_the_light(seed):
    model, (points, occluders, mask) = shadows(share=0.6), far_apart(seed=seed)
    model.log_slope.data -= 2.0

    light, expected = model(points, occluders, mask), plain(model, points, occluders, mask)

    torch.testing.assert_close(light, expected, rtol=0, atol=1e-9)
    assert (expected[0] < 0.9).any() and (expected[0] == 1).all(dim=-1).any()
    assert (expected[1] == 1).all()
    with torch.no_grad():
        lights = zip(model.directions, model.log_softness.exp(), model.log_slope.exp(), strict=True)
        for direction, width, slope in lights:
            beam = _Beam(torch.nn.functional.normalize(direction, dim=0), width.expand(3), width.expand(3), slope)
            near = _lines_pass_near(points, torch.where(mask[..., None], occluders, 0.0), mask, beam)
            assert 0 < near[0].float().mean() < 0.9 and not near[1].any()


def test_gradients_are_those_of_every_pair(monkeypatch):
    found = {}
    for on in ("cpu", "any"):
        monkeypatch.setattr("vpd_lightning.renderer.shadows.is_traced", lambda on=on: on == "any")
        model, (points, occluders, mask) = shadows(share=0.6), far_apart()
        points, occluders = points.requires_grad_(), occluders.requires_grad_()
        model(points, occluders, mask).square().sum().backward()
        found[on] = [part.grad for part in (points, occluders, *model.parameters())]
    for one, other in zip(found["cpu"], found["any"], strict=True):
        torch.testing.assert_close(
            one.nan_to_num(0), other.nan_to_num(0), rtol=0, atol=1e-8 * other.abs().nan_to_num(0).max()
        )
        assert one.isfinite().all()
