"""The import rules of the architecture, read from the source: arrows run one way, the engine stays free of Blender."""

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.behaviours import BEHAVIOURS

ROOT = Path(__file__).resolve().parent.parent

# Each part of the engine, the folder or file under engine/ of that name, and the parts that it may import.
ENGINE_MAY_IMPORT = {
    part: set(names.split())
    for part, names in {
        "": "",
        "gates": "",
        "user_cache": "",
        "errors": "gates",
        "json_file": "gates errors",
        "records": "gates errors json_file",
        "presets": "gates errors json_file",
        "scene_source": "",
        "job": "gates errors json_file records presets scene_source user_cache",
        "posed": "gates errors json_file scene_source job",
        "result_files": "gates errors json_file job posed",
        "known_scene": "errors records scene_source job posed result_files",
        "lift_arrays": "job json_file known_scene corrections posed result_files",
        "corrections": "errors gates json_file records job posed result_files known_scene",
        "scene": "gates errors json_file records presets scene_source job posed",
        "scene_of_lift": "errors job result_files known_scene scene",
        "machine": "user_cache",
        "raster": "machine",
        "semantics": "presets scene machine",
        "instances": "presets scene machine",
        "metrics": "errors posed scene",
        "model": "gates presets job posed result_files scene machine raster instances",
        "train": "presets scene machine raster semantics instances model",
        "passes": "gates errors job posed scene machine instances model",
        "lift": (
            "errors json_file presets job posed result_files corrections scene scene_of_lift machine raster "
            "semantics instances metrics model train passes diagnosis"
        ),
        "plates": "errors job posed machine corrections scene scene_of_lift model passes lift",
        "diagnosis": "errors job posed scene",
        "export": "gates errors job posed result_files corrections scene scene_of_lift passes lift",
        "frames": "errors scene_source job known_scene scene",
        "poses": "gates errors json_file records job posed scene",
        "known_networks": "",
        "networks": "errors json_file job known_networks",
        "segment": "errors json_file job known_networks scene",
        "mask_networks": "errors json_file networks scene segment",
        "depth_agreement": "job posed scene",
        "film": "depth_making errors job known_networks mask_networks networks poses scene segment",
        "depth_making": "depth_agreement errors job known_networks networks posed scene",
        "set_up": "gates errors job",
        "batch": "gates errors json_file job scene_of_lift machine",
        "command_line": (
            "gates errors json_file records presets scene_source job corrections scene scene_of_lift metrics lift "
            "diagnosis plates export frames poses set_up batch known_networks depth_making film"
        ),
        "__main__": "command_line",
    }.items()
}
# Each part of the extension, the same way. The engine's other parts run in a process of their own.
EXTENSION_MAY_IMPORT = {
    part: set(names.split())
    for part, names in {
        "plgs_blender": (
            "engine.errors engine.records engine.presets engine.scene_source engine.job engine.posed "
            "engine.result_files engine.known_scene engine.corrections"
        ),
        "operators": "plgs_blender",
        "ui": "plgs_blender",
        "__init__": "plgs_blender operators ui",
    }.items()
}
BLENDER_MODULES = {"bpy", "bpy_extras", "mathutils", "gpu", "gpu_extras", "bmesh", "blf", "bl_ext", "addon_utils"}
PICKLES = {"pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
THREADS = {"threading", "_thread", "concurrent", "multiprocessing", "asyncio"}


@dataclass(frozen=True)
class Import:
    """One imported module: as seen from the repository root (`engine.scene.camera`) or from outside (`numpy`)."""

    module: str
    line: str
    is_relative: bool
    is_at_top: bool


def modules_under(*names: str) -> list[Path]:
    """The Python files of packages or single files in the repository root; those not written yet are left out."""
    paths = [ROOT / name for name in names]
    return sorted(file for path in paths for file in ([path] if path.is_file() else path.rglob("*.py")))


def dotted(path: Path) -> str:
    """`engine/scene/camera.py` is `engine.scene.camera`; a package's `__init__.py` is the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


@cache
def imports_of(path: Path) -> tuple[Import, ...]:
    """Every import statement of a file, wherever it stands, but for those that only a type checker sees."""
    return tuple(_imports_of(path))


def _imports_of(path: Path) -> Iterator[Import]:
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    top = set(_at_top(tree.body))
    package = path.relative_to(ROOT).parent.parts
    for node in _outside_type_checking(tree):
        where = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Import):
            for name in node.names:
                yield Import(name.name, where, False, node in top)
        elif isinstance(node, ast.ImportFrom):
            climbed = package[: len(package) - node.level + 1] if node.level else ()
            if node.level > len(package) + 1:
                pytest.fail(f"{where} climbs out of the repository")
            base = [*climbed, *([node.module] if node.module else [])]
            for name in node.names:
                yield Import(_existing(".".join([*base, name.name])), where, node.level > 0, node in top)


def nodes_of(path: Path, words: set[str]) -> Iterator[ast.AST]:
    """All of a file's nodes, if any of the words is in it."""
    text = path.read_text(encoding="utf-8")
    return ast.walk(ast.parse(text)) if any(word in text for word in words) else iter(())


def _existing(name: str) -> str:
    """`engine.scene.Camera` is no module: then it is `engine.scene`. Names from outside lose nothing that matters."""
    path = ROOT.joinpath(*name.split("."))
    if path.with_suffix(".py").is_file() or path.is_dir():
        return name
    return name.rpartition(".")[0] or name


def _at_top(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements that run when the module is imported, through `if` and `try`."""
    for node in body:
        yield node
        for block in ("body", "orelse", "handlers", "finalbody"):
            if isinstance(node, ast.If | ast.Try | ast.With | ast.ExceptHandler) and not _is_type_checking(node):
                yield from _at_top(getattr(node, block, []))


def _outside_type_checking(node: ast.AST) -> Iterator[ast.AST]:
    """Statements, at any depth."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr) and not _is_type_checking(child):
            yield child
            yield from _outside_type_checking(child)


def _is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def lines_where(is_wrong: Callable[[Import], bool], *names: str) -> list[str]:
    """The imports in these packages or files for which something holds."""
    return [found.line for path in modules_under(*names) for found in imports_of(path) if is_wrong(found)]


def part_of_engine(module: str) -> str:
    """`engine.scene.camera` belongs to `scene`, the engine's own `__init__` to ``."""
    return module.split(".")[1] if "." in module else ""


def first(module: str) -> str:
    return module.partition(".")[0]


def target_of(found: Import) -> str:
    """The part that an import of the extension leads to: `plgs_blender`, or of the engine `engine.scene`."""
    return ".".join(found.module.split(".")[: 2 if first(found.module) == "engine" else 1])


EXTENSION = ("plgs_blender", "operators", "ui", "__init__.py")
OURS = {"self", "cls", "ctx"}
KERNELS = {"compiled", "parallel_kernel", "device_function", "inlined", "contracted"}
MOST_LINES_OF_THE_CORE = 9_200
"""Lines of the engine that Blender imports, at most."""


def test_the_engine_never_imports_bpy() -> None:
    assert lines_where(lambda i: first(i.module) in BLENDER_MODULES, "engine") == []


def test_dependencies_between_the_parts_of_the_engine_run_one_way() -> None:
    wrong = []
    for path in modules_under("engine"):
        part = part_of_engine(dotted(path))
        assert part in ENGINE_MAY_IMPORT, f"{path.relative_to(ROOT)} belongs to no known part of the engine"
        for found in imports_of(path):
            is_ours = first(found.module) == "engine"
            if is_ours and part_of_engine(found.module) not in ENGINE_MAY_IMPORT[part] | {part, ""}:
                wrong.append(f"{found.line} imports {found.module}")
    assert wrong == []


def test_every_dependency_that_is_allowed_is_used() -> None:
    """The tables name parts that exist and imports that are used; what is needed no more is taken out of them."""
    engine: dict[str, set[str]] = {part: set() for part in ENGINE_MAY_IMPORT}
    for path in modules_under("engine"):
        found = {part_of_engine(i.module) for i in imports_of(path) if first(i.module) == "engine"}
        engine[part_of_engine(dotted(path))] |= found
    extension: dict[str, set[str]] = {part: set() for part in EXTENSION_MAY_IMPORT}
    for path in modules_under(*EXTENSION):
        extension[first(dotted(path))] |= {target_of(i) for i in imports_of(path) if i.is_relative}
    allowed, used = {**ENGINE_MAY_IMPORT, **EXTENSION_MAY_IMPORT}, {**engine, **extension}
    assert {part: sorted(names - used[part]) for part, names in allowed.items() if names - used[part]} == {}


def test_modules_of_the_engine_import_each_other_relatively() -> None:
    """In Blender the engine is `plgs.engine`: only relative imports find it there; and it has to stay inside itself."""
    ours = {"engine", "plgs_blender", "operators", "ui", "plgs", "run_plgs"}
    assert lines_where(lambda i: first(i.module) in ours and not i.is_relative, "engine", *EXTENSION) == []
    assert lines_where(lambda i: i.is_relative and first(i.module) != "engine", "engine") == []


def test_modules_have_no_import_cycles() -> None:
    """Between modules, by all their imports: one inside a function only hides a cycle."""
    graph: dict[str, set[str]] = {}
    for path in modules_under("engine", *EXTENSION):
        name = dotted(path)
        graph[name] = {i.module for i in imports_of(path) if i.is_relative} - {name}
    assert _cycle_in({name: sorted(targets) for name, targets in graph.items()}) == []


def test_folders_and_files_have_no_import_cycles() -> None:
    """Beside each other in one folder, wherever an import stands: a folder counts as one, with all that is in it."""
    found: dict[tuple[str, ...], dict[str, set[str]]] = {}
    for path in modules_under("engine", *EXTENSION):
        source = path.relative_to(ROOT).with_suffix("").parts
        for each in imports_of(path):
            target = tuple(each.module.split("."))
            pairs = zip(source, target, strict=False)
            shared = next((depth for depth, pair in enumerate(pairs) if pair[0] != pair[1]), None)
            if each.is_relative and shared:  # one of them is not just the other's package
                found.setdefault(source[:shared], {}).setdefault(source[shared], set()).add(target[shared])
    for folder, graph in found.items():
        arrows = {name: sorted(names) for name, names in graph.items() if name != "__init__"}
        assert _cycle_in(arrows) == [], "/".join(folder)


def _cycle_in(arrows: dict[str, list[str]]) -> list[str]:
    """The names along a cycle; none where there is no cycle."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_dependencies_between_the_parts_of_the_extension_run_one_way() -> None:
    wrong = []
    for path in modules_under(*EXTENSION):
        part = first(dotted(path))
        for found in imports_of(path):
            if found.is_relative and target_of(found) not in EXTENSION_MAY_IMPORT[part] | {part, ""}:
                wrong.append(f"{found.line} imports {found.module}")
    assert wrong == []


def test_the_extension_needs_nothing_but_blender_numpy_and_the_standard_library() -> None:
    allowed = BLENDER_MODULES | {"numpy"} | set(sys.stdlib_module_names)
    assert lines_where(lambda i: not i.is_relative and first(i.module) not in allowed, *EXTENSION) == []


def test_blender_imports_only_the_listed_parts_of_the_engine() -> None:
    """Only with NumPy, and no readers of foreign formats. This limit may only be lowered."""
    core = _core_of_the_extension()
    allowed = {target.removeprefix("engine.") for target in EXTENSION_MAY_IMPORT["plgs_blender"]}
    allowed |= {"", "gates", "json_file", "records", "user_cache"}
    assert sorted({part_of_engine(dotted(path)) for path in core} - allowed) == []
    assert sum(len(path.read_text(encoding="utf-8").splitlines()) for path in core) <= MOST_LINES_OF_THE_CORE


def _core_of_the_extension() -> set[Path]:
    """The files of the engine that the extension and run_plgs.py import, directly or through other files."""
    found: set[Path] = set()
    waiting = modules_under(*EXTENSION, "run_plgs.py")
    while waiting:
        for each in imports_of(waiting.pop()):
            names = each.module.removeprefix("plgs.").split(".")
            folders = [ROOT.joinpath(*names[:depth]) for depth in range(1, len(names) + 1)]
            files = [file for folder in folders for file in (folder.with_suffix(".py"), folder / "__init__.py")]
            new = {file for file in files if names[0] == "engine" and file.is_file()} - found
            found |= new
            waiting += sorted(new)
    return found


def test_architecture_md_names_only_what_exists() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = {name for name in re.findall(r"`([\w/]+(?:\.py|/))`", page)}
    assert len(named) > 40 and sorted(name for name in named if not (ROOT / name).exists()) == []


def test_blenders_part_starts_no_threads() -> None:
    assert lines_where(lambda i: first(i.module) in THREADS, *EXTENSION) == []


def test_engine_job_imports_only_the_standard_library() -> None:
    library = sys.stdlib_module_names
    wrong = lines_where(lambda i: not i.is_relative and first(i.module) not in library, "engine/job", "engine/presets")
    assert wrong == []


def test_opening_a_scene_imports_only_numpy() -> None:
    late = {"cv2", "liblzfse", "lz4", "h5py", "OpenEXR", "pycocotools", "open3d"}
    always = {"numpy", *sys.stdlib_module_names}
    wrong = lines_where(
        lambda i: not i.is_relative and first(i.module) not in (always if i.is_at_top else always | late),
        "engine/scene",
    )
    assert wrong == []


def test_few_functions_take_six_positional_parameters() -> None:
    """But for compiled kernels, and tests, whose fixtures pytest passes by name: a call of six cannot be read."""
    many = []
    for path in modules_under(*EXTENSION, "engine", "research", "sample", "set_up", "run_plgs.py", "tests"):
        for node in nodes_of(path, {"def "}):
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("test_"):
                names = [each.arg for each in (*node.args.posonlyargs, *node.args.args) if each.arg not in OURS]
                if len(names) >= 6 and KERNELS.isdisjoint(map(ast.unparse, node.decorator_list)):
                    many.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name}")
    assert len(many) <= 15, many


def test_calls_that_differ_between_systems_are_in_one_module() -> None:
    """The rights of folders are asked in a branch that Windows does not reach."""
    alone = {"fcntl", "msvcrt", "resource", "pwd", "grp", "termios"}
    calls = {"fork", "getpgid", "getuid", "killpg", "mkfifo", "sched_getaffinity", "setsid", "sysconf", "SIGKILL"}
    branches = {"engine/machine/compiled.py"}
    wrong = []
    for path in modules_under("engine", *EXTENSION, "run_plgs.py"):
        if path == ROOT / "engine/job/system.py":
            continue
        wrong += [i.line for i in imports_of(path) if first(i.module) in alone]
        for node in nodes_of(path, calls):
            is_call = isinstance(node, ast.Attribute) and node.attr in calls
            if is_call and path.relative_to(ROOT).as_posix() not in branches:
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert wrong == []


def test_research_imports_the_engine_and_nothing_imports_research() -> None:
    """It runs from the repository alone, so the engine has its own name there."""
    ours = {"plgs_blender", "operators", "ui", "plgs", "run_plgs"}
    wrong = lines_where(
        lambda i: first(i.module) in ours or (i.is_relative and first(i.module) != "research"), "research"
    )
    others = ("engine", *EXTENSION, "run_plgs.py", "sample", "set_up")
    assert wrong + lines_where(lambda i: first(i.module) == "research", *others) == []


def test_no_module_uses_pickle() -> None:
    """Neither the module nor the calls that hide one, nor numpy's ``tofile``, which hides that a disk is full."""
    wrong = []
    for path in modules_under("engine", "research", *EXTENSION, "run_plgs.py", "sample"):
        wrong += [i.line for i in imports_of(path) if first(i.module) in PICKLES]
        for node in nodes_of(path, {"allow_pickle", "torch.save", "torch.load", "tofile"}):
            if not isinstance(node, ast.Call):
                continue
            hidden = any(k.arg == "allow_pickle" and ast.unparse(k.value) != "False" for k in node.keywords)
            if hidden or ast.unparse(node.func).endswith(("torch.save", "torch.load", ".tofile")):
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert wrong == []


@pytest.mark.parametrize(
    ("module", "unwanted"),
    [
        ("engine.scene", {"torch", "cv2", "numba", "scipy", "open3d", "OpenEXR", "safetensors"}),
        ("engine.job", {"torch", "cv2", "numba", "scipy", "open3d", "OpenEXR", "safetensors", "numpy"}),
        ("engine.command_line.main", {"torch", "cv2", "numba", "scipy", "open3d", "OpenEXR", "safetensors"}),
    ],
)
def test_light_modules_import_no_large_package(module: str, unwanted: set[str]) -> None:
    """What Blender and `--help` import must not pull in the heavy libraries."""
    code = f"import sys, {module}; print(' '.join(sorted({unwanted!r} & set(sys.modules))))"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120
    )
    assert run.stdout.split() == []


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
def test_every_listed_behaviour_has_an_existing_test(behaviour: str) -> None:
    file, _, name = BEHAVIOURS[behaviour].partition("::")
    text = (ROOT / "tests" / file).read_text(encoding="utf-8")
    assert f"def {name or 'test_'}" in text, f"tests/behaviours.py names {name}, which is not in tests/{file}"
