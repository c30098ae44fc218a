"""``vpd-eval``: how good is a trained simulator on held-out video?"""

import sys
from collections.abc import Sequence

from vpd_lightning.commands.report_errors import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return run_command(lambda: _run(words))


def _run(words: list[str]) -> int:
    from vpd_lightning.commands.hydra_application import configure

    config = configure("eval", words)
    if config is not None:
        from vpd_lightning.runs.evaluation_run import run_evaluation

        run_evaluation(config)
    return 0


if __name__ == "__main__":
    sys.exit(main())
