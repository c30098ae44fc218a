"""A renderer as a program of PyTorch's own (``torch.export``): it runs where this package is not installed."""

import contextlib
import copy
import io
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.errors import ConfigError
from vpd_lightning.files import AtomicPath
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.types import Particles, Rays

_TOLERANCE = 1e-5


class RendererProgram(nn.Module):
    """A renderer with plain tensors at its borders: what is exported."""

    def __init__(self, renderer: AbstractRenderer):
        super().__init__()
        self.renderer = renderer

    def forward(
        self,
        positions: Float[Tensor, "1 particle 3"],
        features: Float[Tensor, "1 particle feature"],
        mask: Bool[Tensor, "1 particle"],
        origins: Float[Tensor, "1 ray 3"],
        directions: Float[Tensor, "1 ray 3"],
    ) -> tuple[Float[Tensor, "1 ray 3"], Float[Tensor, "1 ray"], Float[Tensor, "1 ray"]]:
        """Return colours in [0, 1], expected distances along the rays (metres) and opacities."""
        rendered = self.renderer(Particles(positions, features, mask), Rays(origins, directions), None)
        return rendered.rgbs, rendered.depths, rendered.opacities


def export_renderer(
    renderer: AbstractRenderer, *, num_particles: int, feature_dim: int, num_rays: int
) -> torch.export.ExportedProgram:
    """Export a renderer for the CPU, for one scene of ``num_particles`` and ``num_rays`` at a time (both fixed).

    Where there are fewer of either, pad them; ``mask`` is false for particles of the padding. What comes out is
    compared with the renderer itself before it is returned.

    Raises:
        ConfigError: PyTorch cannot export this kind of renderer, or what it exported computes something else.
    """
    if getattr(renderer, "scenery", None) is not None:
        raise ConfigError(
            "This renderer draws the scenery of a clip, which a program of particles and rays does not have.\n"
            "Leave renderer_program out, or train with scenery=false."
        )
    renderer = copy.deepcopy(renderer).to("cpu", torch.float32).eval().requires_grad_(False)
    if hasattr(renderer, "candidate_backend"):  # compiled loops of numba cannot go into a program
        renderer.candidate_backend = "torch"
    module = RendererProgram(renderer).eval()
    first, second = (_scene(num_particles, feature_dim, num_rays, seed) for seed in (0, 1))
    refusal = f"The renderer {type(renderer).__name__} cannot be exported as a program"
    way_out = "splat and surface can be; leave renderer_program out for others."
    try:
        with torch.no_grad(), contextlib.redirect_stderr(io.StringIO()):  # PyTorch prints the graph where it fails
            program = torch.export.export(module, first, strict=False)
            pairs = [(program.module()(*scene), module(*scene)) for scene in (first, second)]
    except Exception as error:  # PyTorch has a class of its own for nearly every reason
        reason = (str(error).strip().splitlines() or [""])[0][:200]
        raise ConfigError(f"{refusal}: {type(error).__name__} {reason}\n{way_out}") from error
    for result, expected in pairs:
        if not all(torch.allclose(a, b, rtol=0, atol=_TOLERANCE) for a, b in zip(result, expected, strict=True)):
            raise ConfigError(f"{refusal}: it computes something else.\n{way_out}")
    for part in program.graph_module.modules():
        for node in part.graph.nodes if isinstance(part, torch.fx.GraphModule) else ():
            for kind in ("stack_trace", "nn_module_stack", "source_fn_stack", "torch_fn"):
                node.meta.pop(kind, None)  # they name files of this machine
    return program


def write_program(path: Path, program: torch.export.ExportedProgram) -> None:
    """Write a program for ``torch.export.load``."""
    content = io.BytesIO()
    torch.export.save(program, content)
    with AtomicPath(path) as partial:
        partial.write_bytes(content.getvalue())


def _scene(num_particles: int, feature_dim: int, num_rays: int, seed: int) -> tuple[Tensor, ...]:
    """Particles around the origin, some of them padding, and rays from a metre away, most of them towards it."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(1, *shape, generator=generator)

    origins = nn.functional.normalize(draw(num_rays, 3), dim=-1)
    directions = nn.functional.normalize(0.3 * draw(num_rays, 3) - origins, dim=-1)
    mask = torch.rand(1, num_particles, generator=generator) > 0.2
    return 0.3 * draw(num_particles, 3), draw(num_particles, feature_dim).sigmoid(), mask, origins, directions
