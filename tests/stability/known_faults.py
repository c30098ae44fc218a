"""What is known to be wrong: each entry turns its tests into expected failures, strictly. Fixed? Delete the entry."""

import pytest

FAULTS: dict[str, str] = {}


def known_fault(request: pytest.FixtureRequest, name: str, is_here: bool = True) -> None:
    """Expect the running test to fail for a known reason, where ``is_here`` says that this case meets it."""
    if is_here and name in FAULTS:
        request.node.add_marker(pytest.mark.xfail(reason=FAULTS[name], strict=True))
