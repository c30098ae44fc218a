"""Triton's kernels without a GPU: run by its interpreter, and compiled for one (which the interpreter does not)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.kernels
def test_the_kernels_pass_the_backends_tests_in_the_interpreter():
    pytest.importorskip("triton")
    # Triton decides when it is imported, so this needs a process of its own.
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/renderer/test_fused_features.py"]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout[-4000:] + result.stderr[-1000:]
    assert " passed" in result.stdout


@pytest.mark.slow
@pytest.mark.kernels
@pytest.mark.parametrize(("element", "num_kernels", "width"), [("fp32", 4, 16), ("fp64", 5, 17), ("fp32", 1, 1)])
def test_the_kernels_compile_for_a_gpu(element: str, num_kernels: int, width: int):
    triton = pytest.importorskip("triton")
    pytest.importorskip("triton.backends.nvidia")
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from vpd_lightning.renderer.kernels import fused_features_triton, fused_loops_triton

    if not isinstance(fused_loops_triton.sum_features, triton.JITFunction):
        pytest.skip("the interpreter does not compile")
    sizes = fused_features_triton.tile_sizes(num_kernels, width)
    pointers = {"table": "*i32", "order": "*i64", "starts": "*i64"}
    for name in ("sum_features", "add_gradients", "gather_gradients"):
        kernel = getattr(fused_loops_triton, name)
        for scatter in (True, False) if name == "add_gradients" else (None,):
            constants = sizes | ({} if scatter is None else {"SCATTER": scatter})
            signature = {
                argument: "constexpr"
                if argument in constants
                else "i32"
                if argument.startswith("num_")
                else pointers.get(argument, "*" + element)
                for argument in kernel.arg_names
            }
            places = {(kernel.arg_names.index(argument),): value for argument, value in constants.items()}
            options = dict(fused_features_triton.OPTIONS)
            compiled = triton.compile(ASTSource(kernel, signature, places), GPUTarget("cuda", 90, 32), options)
            # Nothing spills from registers to memory.
            assert "ld.local" not in compiled.asm["ptx"]
