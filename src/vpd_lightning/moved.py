"""Modules that were moved: their old names keep working, for plug-ins, notebooks and stored configurations.

A stored ``_target_`` is renamed when it is read (``config/migrations.py``); an import of an old name gives the moved
module itself, with a ``DeprecationWarning``.
"""

import sys
import warnings
from collections.abc import Iterable
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED: dict[str, str] = {
    "vpd_lightning.commands.environment": "vpd_lightning.runs.environment",
    "vpd_lightning.commands.evaluation_run": "vpd_lightning.runs.evaluation_run",
    "vpd_lightning.commands.first_training": "vpd_lightning.runs.first_training",
    "vpd_lightning.commands.one_recording": "vpd_lightning.runs.one_recording",
    "vpd_lightning.commands.progress": "vpd_lightning.runs.progress",
    "vpd_lightning.commands.provide_data": "vpd_lightning.runs.provide_data",
    "vpd_lightning.commands.resume": "vpd_lightning.runs.resume",
    "vpd_lightning.commands.run_claim": "vpd_lightning.runs.run_claim",
    "vpd_lightning.commands.sweeps": "vpd_lightning.runs.sweeps",
    "vpd_lightning.commands.training_errors": "vpd_lightning.runs.training_errors",
    "vpd_lightning.commands.training_run": "vpd_lightning.runs.training_run",
    "vpd_lightning.data.broken_file": "vpd_lightning.data.hdf5.broken_file",
    "vpd_lightning.data.camera_plot": "data_gen.inspection.camera_plot",
    "vpd_lightning.data.contact_sheet": "data_gen.inspection.contact_sheet",
    "vpd_lightning.data.fault": "data_gen.inspection.fault",
    "vpd_lightning.data.free_space": "data_gen.inspection.free_space",
    "vpd_lightning.data.hdf5_checks": "vpd_lightning.data.hdf5.checks",
    "vpd_lightning.data.image_chunks": "vpd_lightning.data.hdf5.image_chunks",
    "vpd_lightning.data.inspect": "data_gen.inspection.inspect",
    "vpd_lightning.data.pictures": "data_gen.inspection.pictures",
    "vpd_lightning.data.ply": "vpd_lightning.media.ply",
    "vpd_lightning.data.point_cloud": "data_gen.inspection.point_cloud",
    "vpd_lightning.data.readings": "data_gen.inspection.camera_conventions",
    "vpd_lightning.data.shots": "data_gen.inspection.posed_depth",
    "vpd_lightning.data.slot_extraction": "vpd_lightning.data.views.slot_extraction",
    "vpd_lightning.data.slot_store": "vpd_lightning.data.views.slot_store",
    "vpd_lightning.data.split": "data_gen.inspection.split",
    "vpd_lightning.data.stored_chunks": "vpd_lightning.data.hdf5.stored_chunks",
    "vpd_lightning.data.text_heaps": "vpd_lightning.data.hdf5.text_heaps",
    "vpd_lightning.data.validate": "data_gen.inspection.validate",
    "vpd_lightning.data.view_agreement": "data_gen.inspection.view_agreement",
    "vpd_lightning.data.view_clips": "vpd_lightning.data.views.view_clips",
    "vpd_lightning.data.view_datamodule": "vpd_lightning.data.views.view_datamodule",
    "vpd_lightning.dynamics.body_forces": "vpd_lightning.dynamics.inertial.body_forces",
    "vpd_lightning.dynamics.body_motion": "vpd_lightning.dynamics.inertial.body_motion",
    "vpd_lightning.dynamics.contact": "vpd_lightning.dynamics.inertial.contact",
    "vpd_lightning.dynamics.first_motion": "vpd_lightning.dynamics.inertial.first_motion",
    "vpd_lightning.dynamics.first_velocity": "vpd_lightning.dynamics.inertial.first_velocity",
    "vpd_lightning.dynamics.materials": "vpd_lightning.dynamics.inertial.materials",
    "vpd_lightning.dynamics.rigid_motion": "vpd_lightning.dynamics.inertial.rigid_motion",
    "vpd_lightning.dynamics.shading": "vpd_lightning.dynamics.inertial.shading",
    "vpd_lightning.encoder.background": "vpd_lightning.encoder.particles.fixed_camera_background",
    "vpd_lightning.encoder.resnet": "vpd_lightning.encoder.networks.resnet",
    "vpd_lightning.encoder.unet_network": "vpd_lightning.encoder.networks.unet_network",
    "vpd_lightning.encoder.unprojection": "vpd_lightning.encoder.particles.unprojection",
    "vpd_lightning.encoder.wide_surface_background": "vpd_lightning.encoder.particles.wide_surface_background",
    "vpd_lightning.evaluation.clip": "vpd_lightning.evaluation.prediction",
    "vpd_lightning.evaluation.filmed_maps": "vpd_lightning.media.filmed_maps",
    "vpd_lightning.evaluation.filming": "vpd_lightning.media.render_rollout",
    "vpd_lightning.evaluation.viewpoints": "vpd_lightning.media.viewpoints",
    "vpd_lightning.export.camera_paths": "vpd_lightning.media.camera_paths",
    "vpd_lightning.export.card_figures": "vpd_lightning.release.card_figures",
    "vpd_lightning.export.graph_data": "vpd_lightning.media.graph_data",
    "vpd_lightning.export.model_card": "vpd_lightning.release.model_card",
    "vpd_lightning.export.nerfstudio_paths": "vpd_lightning.media.nerfstudio_paths",
    "vpd_lightning.export.particle_colors": "vpd_lightning.media.particle_colors",
    "vpd_lightning.export.particle_files": "vpd_lightning.media.particle_files",
    "vpd_lightning.export.pictures": "vpd_lightning.media.pictures",
    "vpd_lightning.export.portable": "vpd_lightning.release.portable",
    "vpd_lightning.export.release": "vpd_lightning.release.release",
    "vpd_lightning.export.release_folder": "vpd_lightning.release.release_folder",
    "vpd_lightning.export.renderer_program": "vpd_lightning.release.renderer_program",
    "vpd_lightning.export.system_notes": "vpd_lightning.release.system_notes",
    "vpd_lightning.export.video": "vpd_lightning.media.video",
    "vpd_lightning.renderer.chunked_rays": "vpd_lightning.renderer.rays.chunked_rays",
    "vpd_lightning.renderer.feature_network": "vpd_lightning.renderer.features.feature_network",
    "vpd_lightning.renderer.fused_features": "vpd_lightning.renderer.kernels.fused_features",
    "vpd_lightning.renderer.fused_features_numba": "vpd_lightning.renderer.kernels.fused_features_numba",
    "vpd_lightning.renderer.fused_features_triton": "vpd_lightning.renderer.kernels.fused_features_triton",
    "vpd_lightning.renderer.fused_loops_numba": "vpd_lightning.renderer.kernels.fused_loops_numba",
    "vpd_lightning.renderer.fused_loops_triton": "vpd_lightning.renderer.kernels.fused_loops_triton",
    "vpd_lightning.renderer.neighbor_features": "vpd_lightning.renderer.features.neighbor_features",
    "vpd_lightning.renderer.particle_search": "vpd_lightning.renderer.rays.particle_search",
    "vpd_lightning.renderer.point_features": "vpd_lightning.renderer.features.point_features",
    "vpd_lightning.renderer.positional_encoding": "vpd_lightning.renderer.field.positional_encoding",
    "vpd_lightning.renderer.precision": "vpd_lightning.renderer.field.precision",
    "vpd_lightning.renderer.radiance_field": "vpd_lightning.renderer.field.radiance_field",
    "vpd_lightning.renderer.ray_candidates": "vpd_lightning.renderer.rays.ray_candidates",
    "vpd_lightning.renderer.ray_features_numba": "vpd_lightning.renderer.kernels.ray_features_numba",
    "vpd_lightning.renderer.ray_search": "vpd_lightning.renderer.kernels.ray_search",
    "vpd_lightning.renderer.ray_search_numba": "vpd_lightning.renderer.kernels.ray_search_numba",
    "vpd_lightning.renderer.sample_features": "vpd_lightning.renderer.features.sample_features",
    "vpd_lightning.renderer.two_tiers": "vpd_lightning.renderer.rays.hierarchical_sampling",
    "vpd_lightning.renderer.volumetric": "vpd_lightning.renderer.rays.volumetric",
    "vpd_lightning.report.board": "vpd_lightning.comparison.comparison_table",
    "vpd_lightning.report.collect": "vpd_lightning.comparison.collect",
    "vpd_lightning.report.comparison": "vpd_lightning.comparison.paired_differences",
    "vpd_lightning.report.films": "vpd_lightning.comparison.comparison_video",
    "vpd_lightning.report.kept_rollouts": "vpd_lightning.comparison.kept_rollouts",
    "vpd_lightning.report.page": "vpd_lightning.comparison.page",
    "vpd_lightning.report.plots": "vpd_lightning.comparison.plots",
    "vpd_lightning.report.run": "vpd_lightning.comparison.run",
    "vpd_lightning.report.settings": "vpd_lightning.comparison.settings",
    "vpd_lightning.report.spreadsheet": "vpd_lightning.comparison.spreadsheet",
    "vpd_lightning.report.strips": "vpd_lightning.comparison.rollout_grid",
    "vpd_lightning.report.sums": "vpd_lightning.comparison.bootstrap",
    "vpd_lightning.report.sweep": "vpd_lightning.comparison.sweep",
    "vpd_lightning.report.tables": "vpd_lightning.comparison.tables",
    "vpd_lightning.report.warnings": "vpd_lightning.comparison.warnings",
    "vpd_lightning.report.writing": "vpd_lightning.comparison.writing",
}
"""Old module name to new module name."""

_OLD_PACKAGES = {name.rpartition(".")[0] for name in MOVED}


def current_name(target: str) -> str:
    """Return the dotted name of a class or module as it is today; a name that was never moved stays."""
    if target in MOVED:
        return MOVED[target]
    module, _, name = target.rpartition(".")
    return f"{MOVED[module]}.{name}" if module in MOVED else target


class _MovedLoader(Loader):
    """Gives the module under its new name; of a package that is gone, an empty one that holds the old names."""

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        if spec.name not in MOVED:
            return None
        warnings.warn(f"{spec.name} is now {MOVED[spec.name]}", DeprecationWarning, stacklevel=2)
        module = import_module(MOVED[spec.name])
        self._spec = module.__spec__  # Python is about to replace it by the old name's
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Run nothing: the module has been imported under its new name."""
        if module.__name__ in MOVED.values():
            module.__spec__ = self._spec


class _MovedFinder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Iterable[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname in MOVED or fullname in _OLD_PACKAGES:
            return ModuleSpec(fullname, _MovedLoader(), is_package=fullname in _OLD_PACKAGES)
        return None


def install() -> None:
    """Let Python find the old names, after everything that is really there; safe to call again."""
    if not any(isinstance(finder, _MovedFinder) for finder in sys.meta_path):
        sys.meta_path.append(_MovedFinder())
