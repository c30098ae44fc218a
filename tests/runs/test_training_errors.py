"""Errors of the operating system while a training runs."""

import errno
from pathlib import Path

import pytest

from vpd_lightning.errors import CheckpointError
from vpd_lightning.runs.training_errors import named_disk_errors


@pytest.mark.parametrize("error", [OSError(errno.EACCES, "no", "/runs/a/metrics.csv"), OSError(errno.ENOSPC, "full")])
def test_a_run_folder_that_cannot_be_written_is_named(error: OSError):
    with pytest.raises(CheckpointError, match="could (not )?be written"), named_disk_errors(Path("/runs/a")):
        raise error


@pytest.mark.parametrize("error", [OSError(errno.EIO, "worn out", "/data/a.h5"), OSError(errno.EPIPE, "gone")])
def test_faults_elsewhere_are_not_called_those_of_the_run_folder(error: OSError):
    with pytest.raises(OSError, match="worn out|gone"), named_disk_errors(Path("/runs/a")):
        raise error
