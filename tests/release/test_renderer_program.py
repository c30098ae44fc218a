"""Renderers as exported programs: the same numbers, without this package."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.waiting import HANG
from vpd_lightning.config import build_simulator, compose
from vpd_lightning.errors import ConfigError
from vpd_lightning.release.renderer_program import export_renderer, write_program
from vpd_lightning.types import Driven, Particles, Rays

NUM_PARTICLES, FEATURE_DIM, NUM_RAYS = 300, 8, 200

CALLER = """
import sys, torch
program = torch.export.load(sys.argv[1]).module()
torch.save(program(*torch.load(sys.argv[2])), sys.argv[3])
assert not any("vpd_lightning" in name for name in sys.modules)
"""


def renderer(name: str) -> torch.nn.Module:
    torch.manual_seed(0)
    words = ["scene=tiny", f"renderer={name}", "dynamics=persistence", f"feature_dim={FEATURE_DIM}", "data.folder=none"]
    built = build_simulator(compose("train", words)).renderer.eval()
    with torch.no_grad():  # as after training: what is initialised to zero would hide a mistake
        for parameter in built.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return built


def scene(seed: int, num_valid: int) -> tuple[torch.Tensor, ...]:
    """A flat cloud seen from above, as a simulator would; other numbers than those that the export is traced with."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(1, NUM_PARTICLES, 3, generator=generator) * torch.tensor([1.6, 1.6, 0.2])
    pixels = torch.rand(1, NUM_RAYS, 2, generator=generator) * 1.6
    origins = torch.tensor([0.8, 0.8, 2.0]).expand(1, NUM_RAYS, 3).contiguous()
    directions = torch.nn.functional.normalize(torch.cat([pixels, torch.zeros(1, NUM_RAYS, 1)], -1) - origins, dim=-1)
    mask = torch.arange(NUM_PARTICLES)[None] < num_valid
    return positions, torch.rand(1, NUM_PARTICLES, FEATURE_DIM, generator=generator), mask, origins, directions


@pytest.mark.slow
@pytest.mark.parametrize("name", ["splat", "surface"])
def test_a_program_draws_what_the_renderer_draws_without_this_package(tmp_path: Path, name: str) -> None:
    built = renderer(name)
    sizes = {"num_particles": NUM_PARTICLES, "feature_dim": FEATURE_DIM, "num_rays": NUM_RAYS}
    write_program(tmp_path / "renderer.pt2", export_renderer(built, **sizes))
    assert str(Path(__file__).parents[2]).encode() not in (tmp_path / "renderer.pt2").read_bytes()
    program = torch.export.load(tmp_path / "renderer.pt2").module()
    for number, num_valid in enumerate((NUM_PARTICLES, 150, 0)):
        inputs = scene(number, num_valid)
        with torch.no_grad():
            drawn = built(Particles(*inputs[:3]), Rays(*inputs[3:]), None)
        for mine, theirs in zip((drawn.rgbs, drawn.depths, drawn.opacities), program(*inputs), strict=True):
            torch.testing.assert_close(theirs, mine, rtol=1e-4, atol=1e-4)
        assert num_valid == 0 or (drawn.opacities.mean() > 0.5 and drawn.depths.std() > 0.01), "there is something"
    positions, features, mask, *lines = scene(3, NUM_PARTICLES)
    given = Driven(positions[:, 200:], torch.ones_like(positions[:, 200:]), mask[:, 200:].long())
    given = replace(given, features=features[:, 200:])
    some = Particles(positions[:, :200], features[:, :200], mask[:, :200], driven=given)
    shown = some.with_driven()
    with torch.no_grad():
        with_tool, without = (built(seen, Rays(*lines), None) for seen in (some, replace(some, driven=None)))
    from_program = program(shown.positions, shown.features, shown.mask, *lines)
    torch.testing.assert_close(from_program[0], with_tool.rgbs, rtol=0, atol=1e-3)
    assert (with_tool.rgbs - without.rgbs).abs().max() > 0.01
    torch.save(inputs, tmp_path / "inputs.pt")
    files = [str(tmp_path / name) for name in ("renderer.pt2", "inputs.pt", "drawn.pt")]
    subprocess.run([sys.executable, "-c", CALLER, *files], check=True, cwd=tmp_path, timeout=HANG)
    torch.testing.assert_close(torch.load(tmp_path / "drawn.pt")[0], drawn.rgbs, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_renderers_that_cannot_be_exported_are_refused() -> None:
    with pytest.raises(ConfigError, match="PointNeRFRenderer cannot be exported"):
        export_renderer(renderer("point_nerf_small"), num_particles=50, feature_dim=FEATURE_DIM, num_rays=8)
