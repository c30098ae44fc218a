"""The two numbers of a stage: operations of its networks, and bytes that they must at least move.

Counted from shapes. Operations are 2 x rows x inputs x outputs of each layer; bytes are each layer's input, output and
weights once, in float32. A training step takes three times both: forward, gradient of the input, of the weights.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor, nn

from benchmarks.plain.neighbors import nearest, pairs_within
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.encoder.unet import UNetEncoder
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.renderer.surface import SurfaceRenderer
from vpd_lightning.types import Particles

TRAINING = 3  # passes of a training step over each layer


class Layer(NamedTuple):
    """A matrix product: ``rows`` vectors of ``inputs`` numbers become ``rows`` of ``outputs``."""

    rows: int
    inputs: int
    outputs: int


@dataclass(frozen=True)
class Work:
    """Operations and bytes of one forward pass."""

    operations: float
    bytes: float

    def seconds(self, operations_per_second: float, bytes_per_second: float, passes: int = 1) -> float:
        """Return the floor: whichever of both takes longer at the given rates."""
        return passes * max(self.operations / operations_per_second, self.bytes / bytes_per_second)


@dataclass(frozen=True)
class EdgeCounts:
    """Nodes and edges of the dynamics' graph of one step and one member of the batch."""

    previous: int
    current: int
    abstract: int
    previous_to_abstract: int
    current_to_abstract: int
    abstract_to_abstract: int


def work(layers: Iterable[Layer]) -> Work:
    """Sum up layers."""
    layers = list(layers)
    operations = sum(2.0 * rows * inputs * outputs for rows, inputs, outputs in layers)
    moved = sum(4.0 * (rows * (inputs + outputs) + inputs * outputs) for rows, inputs, outputs in layers)
    return Work(operations, moved)


def edge_counts(model: HierarchicalGNNDynamics, previous: Particles, current: Particles) -> EdgeCounts:
    """Count the graph of the first member of the batch, for one draw of abstract nodes."""
    before = previous.positions[0][previous.mask[0]]
    now = current.positions[0][current.mask[0]]
    chosen = now[:: max(1, len(now) // model.num_abstract_nodes)][: model.num_abstract_nodes]

    def num_edges(positions: Tensor) -> int:
        return int((nearest(chosen, positions, model.max_abstract_neighbors)[1] <= model.r_s).sum())

    among = len(pairs_within(chosen, model.r_a_s)[0])
    return EdgeCounts(len(before), len(now), len(chosen), num_edges(before), num_edges(now), among)


def encoder_layers(encoder: UNetEncoder, height: int, width: int, num_images: int) -> list[Layer]:
    """Return the convolutions of the UNet as matrix products over all pixels."""
    layers = []
    pixels = num_images * height * width
    for level, convolution in enumerate(encoder.network.down):
        layers.append(_convolution(convolution, pixels >> (2 * level)))
    for level, convolution in enumerate(encoder.network.up):
        layers.append(_convolution(convolution, pixels >> (2 * (len(encoder.network.up) - 1 - level))))
    return layers


def dynamics_layers(model: HierarchicalGNNDynamics, counts: EdgeCounts, is_plain: bool = False) -> list[Layer]:
    """Return all layers of one step; ``is_plain`` multiplies concatenated edges instead of their parts."""
    num_edges = {"previous": counts.previous_to_abstract, "current": counts.current_to_abstract}
    nodes = {"previous": counts.previous, "current": counts.current}
    layers = []
    for name in ("previous", "current"):
        layers += _mlp(model.encode_node[name], nodes[name])
        layers += _mlp(model.encode_edge[f"{name}_to_abstract"], num_edges[name])
        layers += _edges(model.update_edge[f"{name}_to_abstract"], num_edges[name], (nodes[name],), is_plain)
    layers += _mlp(model.update_node["abstract_first"].mlp, counts.abstract)
    layers += _mlp(model.encode_edge["abstract_to_abstract"], counts.abstract_to_abstract)
    layers += among_abstract_layers(model, counts, is_plain)
    layers += _mlp(model.encode_edge["abstract_to_current"], num_edges["current"])
    both = (counts.abstract, counts.current)
    layers += _edges(model.update_edge["abstract_to_current"], num_edges["current"], both, is_plain)
    layers += _mlp(model.update_node["current"].mlp, counts.current)
    decoders = [model.decode_location, model.decode_feature]
    return layers + [layer for mlp in decoders if mlp is not None for layer in _mlp(mlp, counts.current)]


def among_abstract_layers(model: HierarchicalGNNDynamics, counts: EdgeCounts, is_plain: bool = False) -> list[Layer]:
    """Return the message passing among abstract nodes alone, which does not grow with the particles."""
    layers = []
    both = (counts.abstract, counts.abstract)
    for update in model.update_edge["abstract_to_abstract"]:
        layers += _edges(update, counts.abstract_to_abstract, both, is_plain)
    for update in model.update_node["abstract"]:
        layers += _mlp(update.mlp, counts.abstract)
    return layers


def renderer_layers(
    model: PointNeRFRenderer | SurfaceRenderer, num_rays: int, is_plain: bool = False, has_coarse_color: bool = True
) -> list[Layer]:
    """Return all layers for a number of rays; ``is_plain`` keeps the bottleneck and repeats the viewing direction."""
    if isinstance(model, SurfaceRenderer):
        first, _, last = model.background
        ends = [Layer(num_rays, m.in_features, m.out_features) for m in (first, last)]
        return ends + _field(model.field, num_rays, model.num_samples, is_plain)
    coarse = _field(model.coarse, num_rays, model.num_coarse_samples, is_plain, has_coarse_color)
    return coarse + _field(model.fine, num_rays, model.num_coarse_samples + model.num_fine_samples, is_plain)


def _field(net: RadianceField, num_rays: int, num_samples: int, is_plain: bool, has_color: bool = True) -> list[Layer]:
    rows = num_rays * num_samples
    layers = [Layer(rows, layer.in_features, layer.out_features) for layer in (*net.trunk, net.density)]
    if not has_color:
        return layers
    width, after = net.density.in_features, net.condition.out_features
    if net.bottleneck is not None and is_plain:
        layers += [Layer(rows, width, width), Layer(rows, net.condition.in_features, after)]
    elif net.bottleneck is not None:
        # The bottleneck and the next layer are one matrix, made once; directions are projected once per ray.
        layers += [Layer(rows, width, after), Layer(num_rays, net.condition.in_features - width, after)]
    else:
        layers += [Layer(rows, width, after)]
    return [*layers, Layer(rows, after, 3)]


def _edges(update: nn.Module, num_edges: int, num_nodes: tuple[int, ...], is_plain: bool) -> list[Layer]:
    first, *rest = update.mlp.layers
    if is_plain:
        return _mlp(update.mlp, num_edges)
    width = first.out_features
    parts = [Layer(num_edges, width, width), *(Layer(count, width, width) for count in num_nodes)]
    return parts + [Layer(num_edges, layer.in_features, layer.out_features) for layer in rest]


def _mlp(mlp: nn.Module, rows: int) -> list[Layer]:
    return [Layer(rows, layer.in_features, layer.out_features) for layer in mlp.layers]


def _convolution(layer: nn.Conv2d, pixels: int) -> Layer:
    return Layer(pixels, layer.in_channels * layer.kernel_size[0] * layer.kernel_size[1], layer.out_channels)
