import math

import numpy as np
import pytest
import torch

from vpd_lightning.geometry.cameras import pixel_rays, rays_through, unproject
from vpd_lightning.renderer.scenery_layer import SceneryLayer
from vpd_lightning.types import Cameras, Rays, Scenery

NEAR = 0.1


def layer(num_candidates, **changes):
    settings = {
        "num_candidates": num_candidates,
        "near": NEAR,
        "backend": "torch",
        "elliptic": True,
        "far_pixels": True,
        "seen_through": True,
    }
    return SceneryLayer(**settings | changes).double()


def scenery(positions, colors, normals, views, sizes, mask=None):
    batch, count = sizes.shape
    return Scenery(
        positions=positions,
        colors=colors,
        normals=normals,
        views=views,
        sizes=sizes,
        mask=torch.ones(batch, count, dtype=torch.bool) if mask is None else mask,
        occluders=positions.new_zeros(batch, 0, 3),
        occluder_mask=torch.zeros(batch, 0, dtype=torch.bool),
    )


def unit(vectors):
    return vectors / vectors.norm(dim=-1, keepdim=True)


def random_scene(batch=2, count=30, num_rays=25, seed=0):
    """Points before, beside and behind the camera, a third of them without a normal, and rays among them."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    positions = torch.cat([0.12 * noise(batch, count, 2), 3.0 * uniform(batch, count, 1) - 0.5], dim=-1)
    normals = unit(noise(batch, count, 3) - torch.tensor([0.0, 0.0, 1.0])) * (uniform(batch, count, 1) > 0.33)
    views = unit(0.3 * noise(batch, count, 3) + torch.tensor([0.0, 0.0, 1.0]))
    sizes = 0.01 + 0.04 * uniform(batch, count)
    directions = unit(torch.cat([0.2 * noise(batch, num_rays, 2), torch.ones(batch, num_rays, 1).double()], dim=-1))
    rays = Rays(0.02 * noise(batch, num_rays, 3), directions)
    return scenery(positions, uniform(batch, count, 3), normals, views, sizes, uniform(batch, count) > 0.2), rays


def plain_ray(points, origin, direction, width, angle, elliptic, seen_through):
    """One ray past points (dictionaries), by the words of the class: colour, distance, opacity. NumPy, float64."""
    usable = []
    for point in points:
        offset = point["position"] - origin
        along = float(offset @ direction)
        facing = float(point["normal"] @ direction)
        known = bool(point["normal"] @ point["normal"] > 0.5)
        if not point["there"] or along <= NEAR or (known and facing > 0):
            continue
        beside = float(np.linalg.norm(np.cross(offset, direction)))
        met, reach = along, point["size"]
        if known and not elliptic:
            reach = point["size"] / max(abs(float(point["normal"] @ point["view"])), 0.25)
        if known and facing < -0.05:
            on_plane = float(offset @ point["normal"]) / facing
            met = along + min(max(on_plane - along, -16 * point["size"]), 16 * point["size"])
            if elliptic:
                between = met * direction - offset
                beside = max(np.linalg.norm(np.cross(between, point["view"])), np.linalg.norm(between) / 8)
        usable.append((point, beside, met, reach))
    if not usable:
        return np.zeros(3), 0.0, 0.0
    most = 1.5 if elliptic else 2.0
    turns = [float(np.sum((point["view"] - direction) ** 2)) for point, *_ in usable]
    apart = [beside / reach for _, beside, _, reach in usable]
    closest = min(one + turn / 0.2**2 for one, turn in zip(apart, turns, strict=True))
    meets = [not seen_through or one < closest + 0.3 for one in apart]
    reached = [met + 2 * max(beside - most * reach, 0.0) for _, beside, met, reach in usable]
    first = min((met for met, does in zip(reached, meets, strict=True) if does), default=math.inf)
    logs = []
    for (point, beside, met, _), does, turn in zip(usable, meets, turns, strict=True):
        if not does and met <= first - 3 * point["size"]:
            logs.append(-1e30)
            continue
        # the logarithm of a sigmoid, for any size of its argument
        in_front = -np.logaddexp(0.0, -(first + 3 * point["size"] - met) / (0.9 * point["size"]))
        logs.append(
            in_front
            - 0.5 * (beside / (width * point["size"])) ** 2
            - 0.5 * turn / angle**2
            - 2 * math.log(point["size"])
        )
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    color = sum(weight * point["color"] for weight, (point, *_) in zip(weights, usable, strict=True))
    distance = sum(weight * met for weight, (_, _, met, _) in zip(weights, usable, strict=True))
    nearest = min(beside / reach for _, beside, _, reach in usable)
    return color, distance, 1 / (1 + math.exp(min((-16 if elliptic else -8) * (most - nearest), 700)))


def plain(model, scene, rays):
    parts = {
        "position": scene.positions,
        "color": scene.colors,
        "normal": scene.normals,
        "view": scene.views,
        "size": scene.sizes,
        "there": scene.mask,
    }
    width, angle = math.exp(model.log_width.item()), math.exp(model.log_angle.item())
    found = []
    for member in range(len(scene.sizes)):
        arrays = {name: values[member].numpy() for name, values in parts.items()}
        points = [{name: values[i] for name, values in arrays.items()} for i in range(scene.sizes.shape[1])]
        for origin, direction in zip(rays.origins[member].numpy(), rays.directions[member].numpy(), strict=True):
            found.append(plain_ray(points, origin, direction, width, angle, model.elliptic, model.seen_through))
    shape = rays.origins.shape[:2]
    return [torch.tensor(np.array(values)).unflatten(0, shape) for values in zip(*found, strict=True)]


@pytest.mark.parametrize(("elliptic", "seen_through"), [(True, True), (True, False), (False, True), (False, False)])
@pytest.mark.parametrize("seed", range(3))
def test_rays_see_what_plain_loops_see(seed, elliptic, seen_through):
    model, (scene, rays) = layer(40, elliptic=elliptic, seen_through=seen_through), random_scene(seed=seed)
    with torch.no_grad():
        model.log_width.fill_(math.log(0.8))
        model.log_angle.fill_(math.log(0.3))

    seen, expected = model(scene, rays), plain(model, scene, rays)

    for fast, slow in zip(seen[:3], expected, strict=True):  # float64; sums of 30 terms in another order
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-9)
    opacities = expected[2]
    assert (opacities > 0.9).sum() > (2 if elliptic else 10) and (
        opacities < 0.9
    ).sum() > 0  # the scene tells hits from misses


def camera(size=16, focal=20.0):
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(intrinsics, torch.eye(4, dtype=torch.float64), size, size)


def tilted_plane(distance=2.0, tilt=0.6, size=16):
    """Return a plane as every pixel of a camera saw it, and the plane itself (normal, offset)."""
    cameras = camera(size)
    normal = torch.tensor([0.3 * math.sin(tilt), math.sin(tilt), -math.cos(tilt)], dtype=torch.float64)
    normal = unit(normal)
    offset = -normal[2].abs() * distance
    rays = pixel_rays(cameras).directions
    depth = offset / (rays @ normal) * rays[..., 2]
    points = unproject(depth, cameras).flatten(0, 1)
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(1, len(points), 3, generator=generator, dtype=torch.float64)
    views, sizes = unit(points)[None], depth.flatten()[None] / cameras.intrinsics[0, 0]
    return scenery(points[None], colors, normal.expand(1, len(points), 3), views, sizes), normal, offset


def through(pixels, size=16):
    rays = rays_through(camera(size), torch.as_tensor(pixels, dtype=torch.float64))
    return Rays(rays.origins[None], rays.directions[None])


def test_rays_between_pixels_meet_the_plane_exactly():
    scene, normal, offset = tilted_plane()
    x, y = torch.meshgrid(torch.arange(3.0, 13.0), torch.arange(3.0, 13.0), indexing="ij")  # corners of pixels
    rays = through(torch.stack([x, y + 0.2], dim=-1).flatten(0, 1))

    seen = layer(12)(scene, rays)

    exact = offset / (rays.directions @ normal)
    assert ((seen.distances - exact) / exact).abs().max() < 1e-6
    assert seen.opacities.min() > 0.99


@pytest.mark.parametrize(("elliptic", "bound"), [(False, 2e-3), (True, 5e-3)])  # ellipses reach farther up the slope
def test_rays_of_the_pixels_get_their_colours_back(elliptic, bound):
    scene, _, _ = tilted_plane()
    inner = torch.arange(256).view(16, 16)[2:-2, 2:-2].flatten()
    pixels = torch.stack([inner % 16, inner // 16], dim=-1) + 0.5
    model = layer(12, elliptic=elliptic)
    ramp = scene.positions @ torch.tensor([[0.1, 0.2, 0.3], [0.3, -0.1, 0.2], [0.0, 0.1, 0.1]]).double()
    smooth = scenery(scene.positions, ramp, scene.normals, scene.views, scene.sizes)

    blurred = model(smooth, through(pixels)).colors
    with torch.no_grad():
        model.log_width.fill_(math.log(0.15))
    sharp = model(scene, through(pixels)).colors

    assert (blurred - ramp[:, inner]).abs().max() < bound  # what lies around a pixel evens out
    assert (sharp - scene.colors[:, inner]).abs().max() < 1e-4


def test_past_the_edge_nothing_is_seen():
    scene, _, _ = tilted_plane(tilt=0.0)

    seen = layer(12)(scene, through([[-2.6, 8.0], [8.0, 18.6], [19.0, 19.0]]))
    within = layer(12)(scene, through([[-0.5, 8.0], [8.0, 16.5]]))

    assert seen.opacities.max() < 1e-2
    assert within.opacities.min() > 0.99


def low_floor():
    """A floor 0.3 m below a level camera of 16 x 16 pixels: it ends at the eleventh row, seen at 7 degrees."""
    cameras = camera()
    rays = pixel_rays(cameras).directions.flatten(0, 1)
    rows = torch.arange(256) // 16 >= 10
    depth = (0.3 / rays[:, 1] * rays[:, 2])[rows]
    points = rays[rows] / rays[rows][:, 2:] * depth[:, None]
    colors = torch.stack([points[:, 0], points[:, 2], points[:, 2]], dim=-1) / 5
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64).expand_as(points)
    sizes = depth[None] / cameras.intrinsics[0, 0]
    return scenery(points[None], colors[None], up[None], unit(points)[None], sizes)


def test_above_the_end_of_a_floor_nothing_of_it_is_seen():
    columns = torch.arange(4.5, 12.0)

    def at(row):
        return through(torch.stack([columns, torch.full_like(columns, row)], dim=-1))

    above, end = (layer(12)(low_floor(), at(row)).opacities for row in (8.5, 10.5))
    round_ones = layer(12, elliptic=False)(low_floor(), at(8.5)).opacities
    assert above.max() < 0.05 and end.min() > 0.95
    assert round_ones.min() > 0.95, "what discs do"


def test_from_above_a_floor_seen_at_a_grazing_angle_has_no_holes():
    floor = low_floor()
    depths = floor.positions[0, :, 2].mul(1e6).round().unique() / 1e6
    z = (depths[1:] + depths[:-1]) / 2  # half way between the rows that were seen
    places = torch.stack([torch.zeros_like(z), torch.full_like(z, 0.3), z], dim=-1)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(places)
    rays = Rays((places - 2 * down)[None], down[None])

    seen = layer(12)(floor, rays)

    assert seen.opacities.min() > 0.95
    gaps = (seen.colors[0, :, 1] - z / 5).abs()
    assert (gaps < 0.3 * (depths[1:] - depths[:-1]) / 5).all(), "between the rows on either side"


def wall(distance, color, size=16, facing=-1.0):
    scene, _, _ = tilted_plane(distance, 0.0, size)
    colors = torch.tensor(color, dtype=torch.float64).expand_as(scene.colors)
    normals = torch.tensor([0.0, 0.0, facing], dtype=torch.float64).expand_as(scene.normals)
    return scenery(scene.positions, colors, normals, scene.views, scene.sizes.abs())


def joined(one, other):
    return Scenery(**{name: torch.cat([getattr(one, name), getattr(other, name)], dim=1) for name in vars(one)})


RED, BLUE = [0.9, 0.1, 0.1], [0.1, 0.2, 0.9]


@pytest.mark.parametrize("num_candidates", [12, 600])
def test_a_near_surface_hides_a_far_one(num_candidates):
    rays, model = through([[8.0, 8.0], [5.3, 9.1]]), layer(num_candidates)

    for both in (joined(wall(1.5, RED), wall(3.0, BLUE)), joined(wall(3.0, BLUE), wall(1.5, RED))):
        seen = model(both, rays)

        torch.testing.assert_close(seen.colors, model(wall(1.5, RED), rays).colors, rtol=0, atol=1e-4)
        torch.testing.assert_close(seen.distances, 1.5 / rays.directions[..., 2], rtol=1e-3, atol=0)


@pytest.mark.parametrize("hidden", ["behind the camera", "masked", "facing away"])
def test_what_cannot_be_seen_is_not(hidden):
    rays, far = through([[8.0, 8.0], [5.3, 9.1]]), wall(3.0, BLUE)
    near = wall(-1.5 if hidden == "behind the camera" else 1.5, RED, facing=1.0 if hidden == "facing away" else -1.0)
    if hidden == "masked":
        near = scenery(near.positions, near.colors, near.normals, near.views, near.sizes, near.mask & False)

    alone, both = layer(600)(near, rays), layer(600)(joined(near, far), rays)

    assert alone.opacities.max() < 1e-3 and torch.isfinite(alone.colors).all() and torch.isfinite(alone.distances).all()
    for one, other in zip(both, layer(600)(far, rays), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9)


@pytest.mark.parametrize("num_candidates", [6, 60])
def test_junk_in_padding_changes_nothing(num_candidates):
    model, (scene, rays) = layer(num_candidates), random_scene()
    parts = {name: getattr(scene, name) for name in ("positions", "colors", "normals", "views", "sizes")}
    junk = {name: torch.where(scene.mask.view(*scene.mask.shape, *[1] * (v.ndim - 2)), v, -7.0) for name, v in
            parts.items()}  # fmt: skip
    wide = {name: torch.cat([torch.full_like(v, 40.0), torch.full_like(v, 40.0), v], dim=1) for name, v in junk.items()}
    padded = scenery(**wide, mask=torch.cat([torch.zeros(2, 60, dtype=torch.bool), scene.mask], dim=1))

    for one, other in zip(model(scene, rays), model(padded, rays), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)


def test_missing_normals_leave_no_holes():
    scene, normal, offset = tilted_plane()
    some = torch.arange(256).view(1, 256, 1) % 3 > 0
    rays = through([[8.0, 8.0], [5.3, 9.1], [10.5, 6.5]])
    exact = offset / (rays.directions @ normal)

    for known, tolerance in ((some, 0.02), (torch.zeros_like(some), 0.02)):
        bare = scenery(scene.positions, scene.colors, scene.normals * known, scene.views, scene.sizes)
        seen = layer(12)(bare, rays)
        assert seen.opacities.min() > 0.99
        assert ((seen.distances - exact) / exact).abs().max() < tolerance


def test_the_camera_that_saw_a_surface_from_there_counts_most():
    here, other = wall(2.0, RED), wall(2.0, BLUE)
    turned = unit(other.views + torch.tensor([0.8, 0.0, 0.0]))
    other = scenery(other.positions, other.colors, other.normals, turned, other.sizes)
    coarse = scenery(here.positions, other.colors, here.normals, here.views, 4 * here.sizes)
    rays = through([[8.0, 8.0], [5.3, 9.1]])

    by_angle, by_size = (layer(600)(joined(here, less), rays).colors for less in (other, coarse))

    expected = torch.tensor(RED, dtype=torch.float64)
    assert (by_angle - expected).abs().max() < 0.01
    assert (by_size - expected).abs().max() < (by_size - torch.tensor(BLUE).double()).abs().max()


def test_members_of_a_batch_do_not_share_how_fine_their_scenery_is():
    """The search among more points than candidates ranks by a width; each member has its own."""
    fine, rays = random_scene(batch=1, count=200, num_rays=40, seed=3)
    coarse, _ = random_scene(batch=1, count=200, num_rays=40, seed=4)
    coarse = scenery(coarse.positions, coarse.colors, coarse.normals, coarse.views, 5 * coarse.sizes, coarse.mask)
    both = Scenery(**{name: torch.cat([getattr(fine, name), getattr(coarse, name)]) for name in vars(fine)})
    twice = Rays(rays.origins.expand(2, -1, -1), rays.directions.expand(2, -1, -1))

    together = layer(6)(both, twice)

    for member, alone in enumerate((fine, coarse)):
        for one, other in zip(together, layer(6)(alone, rays), strict=True):
            torch.testing.assert_close(one[member], other[0], rtol=0, atol=1e-9)


def test_gradients_match_finite_differences():
    model, (scene, rays) = layer(12), random_scene(batch=1, count=12, num_rays=6)

    def seen(colors, log_width, log_angle):
        changed = scenery(scene.positions, colors, scene.normals, scene.views, scene.sizes, scene.mask)
        parameters = {"log_width": log_width, "log_angle": log_angle}
        return tuple(torch.func.functional_call(model, parameters, (changed, rays)))

    inputs = (scene.colors, model.log_width.detach(), model.log_angle.detach())
    assert torch.autograd.gradcheck(seen, tuple(value.clone().requires_grad_() for value in inputs), eps=1e-6)


def test_gradients_stay_finite_where_nothing_is_seen():
    model, (scene, rays) = layer(12), random_scene(batch=1)
    colors = scene.colors.clone().requires_grad_()
    empty = scenery(scene.positions, colors, scene.normals, scene.views, scene.sizes, scene.mask & False)

    seen = model(empty, rays)
    (seen.colors.sum() + seen.distances.sum() + seen.opacities.sum()).backward()

    for gradient in (colors.grad, model.log_width.grad, model.log_angle.grad):
        assert torch.equal(gradient, torch.zeros_like(gradient))
