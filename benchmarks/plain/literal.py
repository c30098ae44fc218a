"""VPD as somebody who has only the paper writes it down in PyTorch: its own weights, its own random draws, no package.

``plain`` shares weights, draws and the borders between stages with the package, so that numbers can be compared. This
shares nothing but the input, so that a ratio to it is one to what a reader of the paper would run. Neighbours are found
as in ``plain.neighbors``. One member of a batch, one view.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.plain.neighbors import nearest, pairs_within
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.types import VideoBatch

KERNELS = ((0.0, 0.05), (0.05, 0.05), (0.1, 0.05), (0.5, 0.5))  # radius and bandwidth in metres, MuJoCo
NEAR, FAR = 0.3, 5.0
NUM_OCTAVES = 4


def network(*widths: int, norm: bool = False) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for before, after in zip(widths, widths[1:], strict=False):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1], *([nn.LayerNorm(widths[-1])] if norm else []))


def summed(messages: Tensor, receivers: Tensor, count: int) -> Tensor:
    """Add up the messages that arrive at each of ``count`` nodes."""
    return messages.new_zeros(count, messages.shape[1]).index_add(0, receivers, messages)


class PixelEncoder(nn.Module):
    """A UNet: features of every pixel of (image, 3, height, width)."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        depth = (len(widths) + 1) // 2
        down, up = widths[:depth], widths[depth:]
        self.down = nn.ModuleList(nn.Conv2d(i, o, 3, padding=1) for i, o in zip((3, *down), down, strict=False))
        inputs = [below + skip for below, skip in zip((down[-1], *up), reversed(down[:-1]), strict=False)]
        self.up = nn.ModuleList(nn.Conv2d(i, o, 3, padding=1) for i, o in zip(inputs, up, strict=True))

    def forward(self, images: Tensor) -> Tensor:
        """Return (image, pixel, feature)."""
        maps = [torch.relu(self.down[0](images))]
        for layer in self.down[1:]:
            maps.append(torch.relu(layer(functional.max_pool2d(maps[-1], 2))))
        x = maps.pop()
        for layer in self.up:
            x = layer(torch.cat([functional.interpolate(x, scale_factor=2), maps.pop()], dim=1))
            x = torch.relu(x) if maps else functional.softplus(x)
        return x.flatten(2).mT


class Dynamics(nn.Module):
    """Algorithm 1 of the paper."""

    def __init__(self, feature_dim: int, width: int, num_rounds: int, num_nodes: int, r_s: float, r_a_s: float) -> None:
        super().__init__()
        self.num_nodes, self.r_s, self.r_a_s = num_nodes, r_s, r_a_s

        def block(inputs: int) -> nn.Sequential:
            return network(inputs, width, width, norm=True)

        self.encode_nodes = nn.ModuleList(network(feature_dim, width, width) for _ in range(2))
        self.encode_edges = nn.ModuleList(network(3, width, width) for _ in range(4))
        self.to_abstract = nn.ModuleList(block(2 * width) for _ in range(2))
        self.first = block(width)
        self.edges = nn.ModuleList(block(3 * width) for _ in range(num_rounds))
        self.nodes = nn.ModuleList(block(2 * width) for _ in range(num_rounds))
        self.back, self.last = block(3 * width), block(2 * width)
        self.move = network(width, width, width, width, 3)
        self.change = network(width, width, width, width, feature_dim)

    def forward(self, frames: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        """Return places and features after two ``frames`` of places (particle, 3) and features."""
        x, z = frames[1]
        nodes = x[torch.randperm(len(x), device=x.device)[: self.num_nodes]]
        messages = 0.0
        for (places, features), encode_node, encode_edge, update in zip(
            frames, self.encode_nodes, self.encode_edges[:2], self.to_abstract, strict=True
        ):
            index, distance = nearest(nodes, places, 2)
            particle, slot = (distance <= self.r_s).nonzero(as_tuple=True)
            node, hidden = index[particle, slot], encode_node(features)
            edge = encode_edge(places[particle] - nodes[node])
            edge = edge + update(torch.cat([edge, hidden[particle]], dim=1))
            messages = messages + summed(edge, node, len(nodes))
        abstract = self.first(messages)
        senders, receivers = pairs_within(nodes, self.r_a_s)
        edge = self.encode_edges[2](nodes[senders] - nodes[receivers])
        for update_edge, update_node in zip(self.edges, self.nodes, strict=True):
            edge = edge + update_edge(torch.cat([edge, abstract[senders], abstract[receivers]], dim=1))
            messages = summed(edge, receivers, len(nodes))
            abstract = abstract + update_node(torch.cat([abstract, messages], dim=1))
        edge = self.encode_edges[3](nodes[node] - x[particle])
        edge = edge + self.back(torch.cat([edge, abstract[node], hidden[particle]], dim=1))
        hidden = hidden + self.last(torch.cat([hidden, summed(edge, particle, len(x))], dim=1))
        return x + 0.1 * torch.tanh(self.move(hidden)), z + self.change(hidden)


class RadianceField(nn.Module):
    """NeRF's network: density, and colour that may depend on the viewing direction."""

    def __init__(self, inputs: int, view: int, width: int, condition: int) -> None:
        super().__init__()
        self.first = network(inputs, *([width] * 5))
        self.second = network(width + inputs, *([width] * 3))
        self.density = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width) if view else nn.Identity()
        self.color = network(width + view, condition, 3)

    def forward(self, features: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        """Return densities (ray, sample) and colours (ray, sample, 3)."""
        hidden = torch.relu(self.second(torch.cat([torch.relu(self.first(features)), features], dim=-1)))
        colored = torch.cat([self.bottleneck(hidden), view.expand(*hidden.shape[:2], -1)], dim=-1)
        return torch.relu(self.density(hidden)[..., 0]), torch.sigmoid(self.color(colored))


class Renderer(nn.Module):
    """Coarse and fine volume rendering of annular kernel features."""

    def __init__(
        self, feature_dim: int, num_coarse: int, num_fine: int, width: int, condition: int, num_neighbors: int
    ) -> None:
        super().__init__()
        inputs = feature_dim * len(KERNELS)
        self.num_coarse, self.num_fine, self.num_neighbors = num_coarse, num_fine, num_neighbors
        self.coarse = RadianceField(inputs, 0, width, condition)
        self.fine = RadianceField(inputs, 3 + 6 * NUM_OCTAVES, width, condition)
        self.register_buffer("kernels", torch.tensor(KERNELS))

    def forward(self, x: Tensor, z: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return coarse and fine colours of rays (ray, 3)."""
        steps = torch.arange(self.num_coarse, device=x.device) + torch.rand(len(origins), self.num_coarse).to(x)
        t = NEAR + (FAR - NEAR) * steps / self.num_coarse
        view = directions.new_zeros(len(directions), 1, 0)
        coarse, weights = self.shaded(self.coarse, x, z, origins, directions, t, view)
        middles, share = (t[:, 1:] + t[:, :-1]) / 2, weights[:, 1:-1].detach() + 1e-5
        cumulated = functional.pad((share / share.sum(dim=1, keepdim=True)).cumsum(dim=1), (1, 0))
        u = torch.rand(len(origins), self.num_fine).to(x)
        above = torch.searchsorted(cumulated, u, right=True).clamp(1, cumulated.shape[1] - 1)
        (low, high), (left, right) = (
            (values.gather(1, above - 1), values.gather(1, above)) for values in (cumulated, middles)
        )
        more = left + (u - low) / (high - low).clamp(min=1e-5) * (right - left)
        t = torch.cat([t, more], dim=1).sort(dim=1).values
        waves = [wave(2.0**octave * directions) for octave in range(NUM_OCTAVES) for wave in (torch.sin, torch.cos)]
        fine, _ = self.shaded(self.fine, x, z, origins, directions, t, torch.cat([directions, *waves], dim=1)[:, None])
        return coarse, fine

    def shaded(
        self, field: RadianceField, x: Tensor, z: Tensor, origins: Tensor, directions: Tensor, t: Tensor, view: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return colours of rays and the weights of their samples at distances ``t``."""
        points = (origins[:, None] + t[..., None] * directions[:, None]).flatten(0, 1)
        index, _ = nearest(x, points, self.num_neighbors)
        distance = (points[:, None] - x[index]).norm(dim=-1, keepdim=True)
        kernel = torch.exp(-(((distance - self.kernels[:, 0]) / self.kernels[:, 1]) ** 2))
        features = torch.einsum("qnk,qnf->qkf", kernel, z[index]).flatten(1)
        density, colors = field(features.unflatten(0, t.shape), view)
        depth = density * torch.cat([t.diff(dim=1), t.new_full((len(t), 1), 1e10)], dim=1)
        weights = (1 - torch.exp(-depth)) * torch.exp(-functional.pad(depth.cumsum(dim=1)[:, :-1], (1, 0)))
        return (weights[..., None] * colors).sum(dim=1), weights


class LiteralVPD(nn.Module):
    """The three stages in a row; ``forward`` returns the training loss of a batch of one clip and one view."""

    def __init__(
        self,
        widths: Sequence[int] = (64, 128, 256, 512, 512, 256, 128, 64, 16),
        num_particles: int = 16384,
        num_nodes: int = 1024,
        hidden: int = 128,
        num_rounds: int = 10,
        r_s: float = 0.1,
        r_a_s: float = 0.3,
        num_coarse: int = 128,
        num_fine: int = 256,
        field_width: int = 256,
        condition_width: int = 128,
        num_neighbors: int = 16,
    ) -> None:
        super().__init__()
        self.num_particles = num_particles
        self.encoder = PixelEncoder(widths)
        self.dynamics = Dynamics(widths[-1], hidden, num_rounds, num_nodes, r_s, r_a_s)
        self.renderer = Renderer(widths[-1], num_coarse, num_fine, field_width, condition_width, num_neighbors)

    def forward(self, batch: VideoBatch) -> Tensor:
        """Return the mean over steps of the squared errors of coarse and fine colours."""
        features = self.encoder(batch.context.rgb[0, :, 0].movedim(-1, 1))
        points = unproject(batch.context.depth, batch.context.cameras)[0].flatten(1, 3)
        frames = []
        for place, feature in zip(points, features, strict=True):
            inside = (place.abs() <= 1).all(dim=-1).nonzero()[:, 0]
            chosen = inside[torch.randperm(len(inside), device=place.device)[: self.num_particles]]
            frames.append((place[chosen], feature[chosen]))
        losses = []
        for step, truth in enumerate(batch.rgbs[0]):
            frames = [frames[1], self.dynamics(frames)]
            colors = self.renderer(*frames[1], batch.rays.origins[0, step], batch.rays.directions[0, step])
            losses += [(color - truth).square().mean() for color in colors]
        return torch.stack(losses).sum() / len(batch.rgbs[0])
