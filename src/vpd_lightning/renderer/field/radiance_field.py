"""The network that turns features of a location, and a viewing direction, into density and colour."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from vpd_lightning.renderer.field.positional_encoding import encoding_dim, positional_encoding
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision

DENSITY_ACTIVATIONS = ("relu", "softplus")


class RadianceField(nn.Module):
    """jaxnerf's network: a trunk with a skip connection, a density head, and a colour branch.

    The trunk has ``net_depth`` layers of ``net_width``; after each layer whose index is a positive multiple of
    ``skip_layer`` the input is concatenated again. The density is one linear unit on the trunk. With view directions
    (``view_degree`` not ``None``) the colour branch is a linear bottleneck of ``net_width``, concatenation with the
    encoded direction, one layer of ``net_width_condition``, and three sigmoids.

    A skip that would fall behind the last layer is left out. The density head starts with zero weights and the bias
    that gives ``initial_density``.

    # Paper: jaxnerf draws the density head at random. All features are positive, so with ReLU about every second draw
    # is zero at every location: an invisible scene without gradients. Starting from thin fog cannot die like that.
    # Paper: jaxnerf without view directions takes the colour straight from the trunk. The paper says that both of its
    # networks have eight layers of 256 "followed by 1 layer of width 128", so without view directions the colour
    # branch is that layer and three sigmoids (no bottleneck, which only serves to meet the directions). With
    # ``net_width_condition`` ``None`` it is jaxnerf's: three sigmoids on the trunk.

    Parameters at the paper's size (64 features in): trunk 64*256 + 256*256*4 + 320*256 + 256*256*2 weights, 8*256
    biases; density 256 + 1. Coarse colour 256*128 + 128 + 128*3 + 3: 527,108 in all. Fine colour 256*256 + 256 +
    (256 + 27)*128 + 128 + 128*3 + 3: 596,356 in all.
    """

    def __init__(
        self,
        *,
        input_dim: int,
        net_depth: int,
        net_width: int,
        skip_layer: int,
        net_width_condition: int | None,
        view_degree: int | None,
        density_activation: str,
        initial_density: float,
    ) -> None:
        super().__init__()
        sizes = {"input_dim": input_dim, "net_depth": net_depth, "net_width": net_width, "skip_layer": skip_layer}
        if net_width_condition is None and view_degree is not None:
            raise ValueError("net_width_condition must be given where there are view directions: they enter there.")
        for name, value in (sizes | {"net_width_condition": net_width_condition}).items():
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        if view_degree is not None and view_degree < 0:
            raise ValueError(f"view_degree must be at least 0, or null for no view directions, got {view_degree}.")
        if density_activation not in DENSITY_ACTIVATIONS:
            raise ValueError(
                f"density_activation must be one of {', '.join(DENSITY_ACTIVATIONS)}, got {density_activation!r}."
            )
        if not initial_density > 0:
            raise ValueError(f"initial_density must be greater than 0, got {initial_density}.")
        self.view_degree = view_degree
        self.density_activation = density_activation
        # The first layer after a skip: one behind a positive multiple of skip_layer.
        takes_input = [index > 1 and (index - 1) % skip_layer == 0 for index in range(net_depth)]
        self.trunk = nn.ModuleList()
        for index in range(net_depth):
            width = input_dim if index == 0 else net_width + (input_dim if takes_input[index] else 0)
            self.trunk.append(nn.Linear(width, net_width))
        self.takes_input = takes_input
        self.density = nn.Linear(net_width, 1)
        self.bottleneck = None if view_degree is None else nn.Linear(net_width, net_width)
        view_dim = 0 if view_degree is None else encoding_dim(view_degree)
        has_condition = net_width_condition is not None
        self.condition = nn.Linear(net_width + view_dim, net_width_condition) if has_condition else None
        self.color = nn.Linear(net_width_condition if has_condition else net_width, 3)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                # jaxnerf: Glorot uniform weights, zero biases.
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
        nn.init.zeros_(self.density.weight)
        is_relu = density_activation == "relu"
        # The inverse of softplus, log(e^x - 1), in a form that no density overflows.
        bias = initial_density if is_relu else initial_density + math.log(-math.expm1(-initial_density))
        nn.init.constant_(self.density.bias, bias)

    def forward(
        self,
        features: Float[Tensor, "*batch sample feature"],
        directions: Float[Tensor, "*batch 3"] | None,
        use_color: bool = True,
        scenes: Float[Tensor, "scene latent"] | None = None,
    ) -> tuple[Float[Tensor, "*batch sample"], Float[Tensor, "*batch sample 3"] | None]:
        """Return densities (per unit of length, >= 0) and colours in [0, 1], both in at least float32.

        ``directions`` are unit vectors, one per ray. Without ``use_color`` the colour branch is left out. ``scenes``
        is the last part of the input where all samples of a scene share it; scenes are the first axis of ``batch``.
        What the layers make of it is computed once per scene: the same sum as for features with it concatenated.
        """
        # Under autocast the first product rounds the features; the skip connection then takes the rounded ones too.
        features = features.to(_product_dtype(features))
        shape = features.shape[:-1]
        # One row per sample, so that what ReLU overwrites is no view: its gradient would be copied at every layer.
        hidden = _of_input(self.trunk[0], 0, features, scenes).relu_().flatten(0, -2)
        for layer, takes_input in list(zip(self.trunk, self.takes_input, strict=True))[1:]:
            hidden = (_two_inputs(layer, hidden, features, scenes) if takes_input else layer(hidden)).relu_()
        if not use_color:
            return self._activated(self.density(hidden)).unflatten(0, shape), None
        if self.condition is None:
            heads = functional.linear(
                hidden,
                torch.cat([self.color.weight, self.density.weight]),
                torch.cat([self.color.bias, self.density.bias]),
            )
            heads = heads.unflatten(0, shape)
            return self._activated(heads[..., 3:]), torch.sigmoid(at_least_float32(heads[..., :3]))
        weight, bias = self.condition.weight, self.condition.bias
        along_ray = None
        if self.bottleneck is not None and self.view_degree is not None:
            if directions is None:
                raise ValueError("This radiance field was built with view directions, but none were given.")
            with full_precision(directions):
                encoded = positional_encoding(at_least_float32(directions), self.view_degree).to(weight.dtype)
                # No activation lies between the bottleneck and the next layer, so their product is one small matrix.
                # All samples of a ray share its direction, so that part is computed once per ray.
                width = self.bottleneck.out_features
                along_ray = functional.linear(encoded, weight[:, width:])[..., None, :]
                bias = bias + weight[:, :width] @ self.bottleneck.bias
                weight = weight[:, :width] @ self.bottleneck.weight
        # Density and colour branch read the trunk in one product.
        heads = functional.linear(
            hidden, torch.cat([weight, self.density.weight]), torch.cat([bias, self.density.bias])
        ).unflatten(0, shape)
        hidden, raw_density = heads[..., :-1], heads[..., -1:]
        hidden = functional.relu(hidden if along_ray is None else hidden + along_ray.to(hidden.dtype))
        return self._activated(raw_density), torch.sigmoid(at_least_float32(self.color(hidden)))

    def _activated(self, raw_density: Float[Tensor, "*shape 1"]) -> Float[Tensor, "*shape"]:
        activation = functional.relu if self.density_activation == "relu" else functional.softplus
        return activation(at_least_float32(raw_density).squeeze(-1))


def _product_dtype(tensor: Tensor) -> torch.dtype:
    """The precision of matrix products: autocast's where that is on."""
    device = tensor.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else tensor.dtype


def _of_input(layer: nn.Linear, start: int, features: Tensor, scenes: Tensor | None) -> Tensor:
    """Return what ``layer`` makes of the network's input, which its weights take from column ``start`` on.

    Of axes ``row width``, or ``scene row width`` where there are scenes.
    """
    # Under autocast the sums below take what they are given, so the weights are rounded here.
    weight, bias = layer.weight.to(features.dtype), layer.bias.to(features.dtype)
    if scenes is None:
        return functional.linear(features.flatten(0, -2), weight[:, start:], bias)
    stop = start + features.shape[-1]
    once = functional.linear(scenes.to(features.dtype), weight[:, stop:], bias)
    shared = weight[:, start:stop].t().expand(len(scenes), -1, -1)
    return torch.baddbmm(once[:, None], features.flatten(1, -2), shared)


def _two_inputs(layer: nn.Linear, hidden: Tensor, features: Tensor, scenes: Tensor | None) -> Tensor:
    """Apply ``layer`` to the concatenation of ``hidden`` and the input without writing the concatenation down."""
    width = hidden.shape[-1]
    weight = layer.weight[:, :width].to(hidden.dtype)
    return torch.addmm(_of_input(layer, width, features, scenes).flatten(0, -2), hidden, weight.t())
