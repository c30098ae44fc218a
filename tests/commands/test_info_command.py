"""``vpd-info``: what is there, what is missing, and how to get it."""

import json

import pytest

from vpd_lightning.commands import info


@pytest.fixture(autouse=True)
def _no_gl_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trying GL takes seconds and has tests of its own."""
    monkeypatch.setattr(info, "_gl_backends", lambda: {"egl": None, "osmesa": "libOSMesa is missing"})


def test_report_names_versions_devices_and_backends(capsys: pytest.CaptureFixture[str]):
    info.main([])

    said = capsys.readouterr().out
    for word in ("python", "devices", "cpu", "egl", "works", "libOSMesa is missing", "torch_cluster", "scipy"):
        assert word in said


def test_json_says_the_same(capsys: pytest.CaptureFixture[str]):
    info.main(["--json"])

    report = json.loads(capsys.readouterr().out)
    assert report["neighbors"]["torch"] is True
    assert report["gl"] == {"egl": None, "osmesa": "libOSMesa is missing"}


def test_missing_and_old_packages_come_with_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from packaging.requirements import Requirement

    wanted = [Requirement("torch>=99"), Requirement("no-such-package>=1"), Requirement("pytest; extra == 'dev'")]
    monkeypatch.setattr(info, "requirements", lambda: wanted)

    assert info.main([]) == 2

    said = capsys.readouterr().out
    assert "pip install 'torch>=99'" in said
    assert "missing: no-such-package. pip install 'no-such-package>=1'" in said
    assert "pytest" not in said


def test_optional_package_that_is_missing_is_no_problem(monkeypatch: pytest.MonkeyPatch):
    from packaging.requirements import Requirement

    monkeypatch.setattr(info, "requirements", lambda: [Requirement("numpy")])
    monkeypatch.setattr(info, "_EXTRAS", {"no-such-package": ("nothing", "pip install no-such-package")})

    report = info.collect()

    assert report["problems"] == []
    assert "missing, for nothing: pip install no-such-package" in info.render(report)


def test_unknown_flag_is_refused(capsys: pytest.CaptureFixture[str]):
    assert info.main(["--jsn"]) == 2
    assert "--jsn" in capsys.readouterr().err


def test_help(capsys: pytest.CaptureFixture[str]):
    assert info.main(["--help"]) == 0
    assert "Exit codes" in capsys.readouterr().out
