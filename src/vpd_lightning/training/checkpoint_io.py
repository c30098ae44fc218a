"""Lightning's way to our checkpoint files."""

from pathlib import Path
from typing import Any

from lightning.fabric.plugins.io.checkpoint_io import CheckpointIO

from vpd_lightning.training.checkpoint_files import LAST, keep_previous, read_checkpoint, write_checkpoint


class AtomicCheckpointIO(CheckpointIO):
    """Lightning's way to our checkpoints. The file that ``last.ckpt`` replaces is kept as ``last-previous.ckpt``."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write atomically; see ``write_checkpoint``."""
        path = Path(path)
        if path.name == LAST:
            keep_previous(path)
        write_checkpoint(checkpoint, path)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = "cpu", weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read and verify; never unpickles objects, whatever ``weights_only`` says.

        Lightning also passes weights from process to process through files of its own making, without a state_dict.
        """
        return read_checkpoint(path, map_location or "cpu")

    def remove_checkpoint(self, path: str | Path) -> None:
        """Delete one file."""
        Path(path).unlink(missing_ok=True)
