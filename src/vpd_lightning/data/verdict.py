"""What ``vpd-data validate`` found, kept beside the data set, and whether that is enough to train on it."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from data_gen.inspection.fault import Fault
from vpd_lightning.data import busy
from vpd_lightning.data.kept_files import keep_file, kept_files
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.errors import DataError

FILE_NAME = "validate.json"
GENERATED = "vpd-data generate"
"""How the manifest's ``generator`` begins where our own generators made the files, which agree with the format."""

_FORMAT_VERSION = 1
_PASSING = (busy.KIND, "unreadable")  # nothing about the file itself


@dataclass(frozen=True)
class Verdict:
    """How many faults the files of a data set have, and the first of them; ``files_digest`` says which files."""

    files_digest: str
    num_faults: int
    first_fault: str


def keep_verdict(manifest: Manifest, faults: Sequence[Fault]) -> str:
    """Keep what a validation of the whole data set found; returns why it could not be kept, or nothing."""
    errors = [fault for fault in faults if fault.is_error]
    if any(fault.name in _PASSING for fault in errors):
        return "some files could not be read just now, so no verdict was stored: validate again"
    verdict = Verdict(manifest.files_digest, len(errors), str(errors[0]) if errors else "")
    text = json.dumps({"format_version": _FORMAT_VERSION, **asdict(verdict)}, indent=1) + "\n"
    if keep_file(manifest, FILE_NAME, lambda path: path.write_text(text, encoding="utf-8")) is None:
        return f"the verdict could not be written to {manifest.folder}: vpd-train will not find it"
    return ""


def read_verdict(manifest: Manifest) -> Verdict | None:
    """Return the verdict on just these files, however they are divided; None where there is none."""
    for path in kept_files(manifest, FILE_NAME):
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            version = content.pop("format_version")
            verdict = Verdict(**content)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
        if version == _FORMAT_VERSION and verdict.files_digest == manifest.files_digest:
            return verdict
    return None


def require_trusted(manifest: Manifest) -> None:
    """Refuse a data set that failed validation, that nobody validated, or that has a trajectory in two splits.

    Raises:
        DataError: with the command that mends it.
    """
    folder, anyway = manifest.folder, "or train on it as it is: force=true"
    verdict = read_verdict(manifest)
    if verdict is not None and verdict.num_faults:
        raise DataError(
            f"{folder} failed vpd-data validate with {verdict.num_faults} fault{'s' * (verdict.num_faults > 1)}.\n"
            f"First: {verdict.first_fault}\n"
            f"Fix that and validate again: vpd-data validate {folder}\n{anyway}"
        )
    if verdict is None and not manifest.generator.startswith(GENERATED):
        raise DataError(
            f"{folder} holds recordings that were never validated; wrong conventions spoil a training silently.\n"
            f"Check them: vpd-data validate {folder}\n{anyway}"
        )
    twins = manifest.repeated()
    if twins:
        first, second = map(manifest.relative, twins[0])
        more = f" ({len(twins)} such pairs)" if len(twins) > 1 else ""
        raise DataError(
            f"{folder} has one trajectory in two splits: {first} and {second} hold the same bytes{more}.\n"
            f"Divide it anew, which keeps equal files together: vpd-data split {folder} train=0.8 validation=0.1 "
            f"test=0.1\n{anyway}"
        )
