"""The kernels on other processors: LLVM compiles them for ARM processors, Apple's included, without an error and into
vector instructions; Numba's settings for lesser x86 processors are respected."""

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from tests.raster.test_fresh_process import ROOT, environment

IS_X86 = platform.machine() in ("x86_64", "AMD64")
COMPILE_FOR_ARM = r"""
import re
from llvmlite import binding
from numba.core.codegen import CPUCodeLibrary
texts = {}
optimise = CPUCodeLibrary._optimize_final_module
def keep_and_optimise(library):
    texts[library.name] = str(library._final_module)  # all of a kernel, before anything is decided for this processor
    optimise(library)
CPUCodeLibrary._optimize_final_module = keep_and_optimise

import torch
from engine.raster import rasterize
from tests.raster.room_workload import room_workload
work = room_workload(200, 64, 48)
tensors = [torch.from_numpy(array).requires_grad_() for array in
    (work.means, work.scales, work.quats, work.opacities, work.colours, work.labels)]
out = rasterize(*tensors, work.camera_to_world, work.intrinsics, work.width, work.height, top_k=1)
(out.image.sum() + out.labels.sum()).backward()

binding.initialize_all_targets()
binding.initialize_all_asmprinters()
KERNELS = (
    "project", "scatter_tiles", "blend_forward", "blend_backward", "gather", "list_contributors"
)
for kernel in KERNELS:
    (text,) = [text for name, text in texts.items() if name == kernel]
    text = re.sub(r"^target .*$", "", text, flags=re.M)
    # Numba's runtime is compiled by Numba, for the processor that it runs on
    runtime = r"^define [^@]*(@NRT_\w+)\((.*?)\)[^{]*\{.*?^\}"
    declared = lambda found: f"declare void {found[1]}({', '.join(['ptr'] * (found[2].count(',') + 1))})"
    text = re.sub(runtime, declared, text, flags=re.M | re.S)
    assert not re.search(r"call .*@llvm\.x86", text), kernel
    for triple, processor, options in (
        ("arm64-apple-macosx", "apple-m1", {}),
        ("aarch64-unknown-linux-gnu", "generic", {"features": "+neon"}),
    ):
        machine = binding.Target.from_triple(triple).create_target_machine(cpu=processor, opt=3, **options)
        module = binding.parse_assembly(text)
        module.triple, module.data_layout = triple, str(machine.target_data)
        builder = binding.create_pass_builder(machine, binding.create_pipeline_tuning_options(3))
        builder.getModulePassManager().run(module, builder)
        assert machine.emit_object(module)
        code = machine.emit_assembly(module)
        fused = len(re.findall(r"\bfmla(\.4s|\s+v\d+\.4s)", code))
        print(kernel, processor, fused)
        assert not re.search(r"\bbl\s+_?(fmaf?|exp2f?|fminf?|fmaxf?)\b", code), kernel
        assert fused > 100 or not kernel.startswith("blend_"), (kernel, fused)
"""
LESSER_MACHINE = """
import sys
import pytest
from engine.raster.blending import backward, forward
failed = pytest.main(["-q", "-p", "no:cacheprovider", "tests/raster/test_rasterize.py", "-k", "matches or same_bits"])
kernels = (forward.blend_forward, backward.blend_backward)
code = "".join(text for kernel in kernels for text in kernel.inspect_asm().values())
assert "%ymm" in code and "%zmm" not in code
sys.exit(failed)
"""


def run(program: str, cache: Path, **settings: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=environment(NUMBA_CACHE_DIR=str(cache), **settings),
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.skipif(not IS_X86, reason="ARM processors compile the kernels themselves")
def test_the_kernels_compile_for_arm(tmp_path: Path) -> None:
    run(COMPILE_FOR_ARM, tmp_path, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="")


@pytest.mark.slow
@pytest.mark.skipif(not IS_X86, reason="about x86 processors")
def test_the_rasterizer_matches_the_reference_without_avx512(tmp_path: Path) -> None:
    """The processor's name alone is not enough: Numba would still use all features of this machine."""
    run(LESSER_MACHINE, tmp_path, NUMBA_CPU_NAME="haswell", NUMBA_CPU_FEATURES="")
