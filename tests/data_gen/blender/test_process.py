"""Starting, asking and losing the child process; a few lines of Python stand in for Blender."""

import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from data_gen.blender import messages, process
from data_gen.blender.process import BlenderProcess, find_python
from tests.waiting import HANG
from vpd_lightning.errors import ConfigError, RenderingBackendError

HEAD = f"""
import sys, time
sys.path.insert(0, {str(Path(messages.__file__).parent)!r})
import messages
def read(count):
    data = sys.stdin.buffer.read(count)
    if len(data) < count:
        raise SystemExit(0)
    return data
def answer(head, arrays=None):
    sys.stdout.buffer.write(messages.pack(head, arrays or {{}}))
    sys.stdout.buffer.flush()
"""
ECHO = """
answer({"kind": "ready", "blender": "stand-in"})
while True:
    head, arrays = messages.unpack(read)
    answer({"kind": "done"}, {name: array + 1 for name, array in arrays.items()})
"""


def stand_in(body: str, **options: float) -> BlenderProcess:
    return BlenderProcess([sys.executable, "-c", HEAD + textwrap.dedent(body)], **options)


def test_missing_environment_says_how_to_make_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv(process.VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "__file__", str(tmp_path / "data_gen" / "blender" / "process.py"))

    with pytest.raises(ConfigError) as caught:
        find_python()

    message = str(caught.value)
    assert "python3.11 -m venv .venv-blender && .venv-blender/bin/pip install bpy==5.0.1 OpenEXR" in message
    assert "VPD_BLENDER_PYTHON" in message
    assert len(message.splitlines()) <= 3 and caught.value.exit_code == 2


def test_environment_is_found_by_variable_then_in_the_current_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    python = tmp_path / ".venv-blender" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(process.VARIABLE, sys.executable)
    assert find_python() == Path(sys.executable)
    monkeypatch.delenv(process.VARIABLE)
    assert find_python() == python
    monkeypatch.setenv(process.VARIABLE, str(tmp_path / "nothing"))
    with pytest.raises(ConfigError, match="VPD_BLENDER_PYTHON is .*nothing"):
        find_python()


def test_questions_larger_than_a_pipe_are_answered():
    child = stand_in(ECHO)
    try:
        assert child.version == "stand-in"
        values = np.arange(2_000_000, dtype=np.float32)
        for _ in range(2):
            _, arrays = child.ask({"kind": "frame"}, {"values": values}, timeout=HANG)
            assert np.array_equal(arrays["values"], values + 1)
        assert child.is_alive
    finally:
        child.close()
    assert not child.is_alive


def test_death_is_reported_with_its_last_words():
    child = stand_in("""
        answer({"kind": "ready"})
        messages.unpack(read)
        print("first line", file=sys.stderr)
        print("Segmentation fault in shader 7", file=sys.stderr)
        raise SystemExit(9)
    """)
    with pytest.raises(RenderingBackendError) as caught:
        child.ask({"kind": "frame"}, {}, timeout=HANG)
    child.close()
    message = str(caught.value)
    assert "ended during: frame (exit code 9)" in message and "Segmentation fault in shader 7" in message
    assert len(message.splitlines()) <= 3


def test_death_at_the_start_is_reported():
    with pytest.raises(RenderingBackendError, match="No module named 'bpy_that_is_missing'"):
        stand_in("import bpy_that_is_missing")


def test_python_that_cannot_be_started_is_reported(tmp_path: Path):
    (tmp_path / "python").write_text("not a program")
    with pytest.raises(RenderingBackendError, match="cannot be started"):
        BlenderProcess([str(tmp_path / "python")])


def test_silence_ends_after_the_timeout():
    child = stand_in('answer({"kind": "ready"})\nwhile True: time.sleep(600)')  # it never ends by itself
    with pytest.raises(RenderingBackendError, match="did not answer in time"):
        child.ask({"kind": "frame"}, {}, timeout=0.3)
    assert not child.is_alive
    child.close()


def test_failure_that_the_child_survives_is_reported():
    child = stand_in("""
        answer({"kind": "ready"})
        messages.unpack(read)
        answer({"kind": "error", "message": "ValueError: no such node"})
        messages.unpack(read)
    """)
    with pytest.raises(RenderingBackendError, match="failed on a scene: ValueError: no such node"):
        child.ask({"kind": "scene"}, {}, timeout=HANG)
    assert child.is_alive
    child.close()


def test_print_into_the_answers_is_noticed():
    with pytest.raises(RenderingBackendError, match="garbled"):
        stand_in('print("Blender 5.0.1 (hash 0123456789)", flush=True)\ntime.sleep(600)')
