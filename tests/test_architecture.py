"""The rules of the package layout, read off the import statements."""

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "shapeenh"
BASE = ("types", "numerics", "checks", "fusion", "heat", "memory", "sparse", "wide")
WITHIN_BASE = {"checks": ("numerics",), "heat": ("fusion", "sparse"), "sparse": ("fusion",), "wide": ("checks",)}
STAGES = ("codecs", "scene", "buffers", "descriptor", "light", "style", "lines", "fit")
SEES_ALL = ("pipeline", "cli", "__init__")
TOUCHES_FILES = ("io", "cli")
KERNELS = {"light": ("brdf", "warp", "scaling")}  # siblings that never import one another
FILES = sorted(SOURCE.rglob("*.py"))


def module_of(path: Path) -> tuple[str, ...]:
    return path.relative_to(SOURCE).with_suffix("").parts


def imports_of(path: Path) -> set[tuple[str, ...]]:
    """Modules of ours that a file imports, as paths: ('light', 'warp')."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "shapeenh":
            head = tuple(node.module.split(".")[1:])
            for name in node.names:
                whole = SOURCE.joinpath(*head, name.name)
                is_module = whole.with_suffix(".py").exists() or whole.is_dir()
                found.add((*head, name.name) if is_module else head)
        elif isinstance(node, ast.Import):
            found |= {tuple(n.name.split(".")[1:]) for n in node.names if n.name.split(".")[0] == "shapeenh"}
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: "/".join(module_of(p)))
def test_a_module_imports_only_what_its_layer_may(path):
    module, imports = module_of(path), imports_of(path)
    if module[0] in SEES_ALL:
        return
    if module[0] in BASE:
        assert {other[0] for other in imports} <= set(WITHIN_BASE.get(module[0], ()))
        return
    for other in imports:
        if other[0] in (*BASE, "stencils"):
            assert module[0] != "stencils" or other[0] in BASE
        elif module == ("io",):
            assert other in {("codecs",), ("scene", "mesh")}
        else:
            assert module[0] in STAGES, f"{module} may not import {other}"
            assert other[0] == module[0], f"{module} may not import {other}"
            if module[0] in KERNELS and module[1] in KERNELS[module[0]]:
                raise AssertionError(f"{module} may not import its sibling {other}")


def test_no_folder_imports_in_a_circle():
    graph = {module_of(p): imports_of(p) for p in FILES}

    def visit(module, trail):
        assert module not in trail, f"circle: {trail}"
        for other in graph.get(module, ()):
            visit(other, (*trail, module))

    for module in graph:
        if module[-1] != "__init__":
            visit(module, ())


@pytest.mark.parametrize("path", FILES, ids=lambda p: "/".join(module_of(p)))
def test_only_io_and_cli_touch_files(path):
    if module_of(path)[0] in TOUCHES_FILES:
        return
    tree = ast.parse(path.read_text())
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
    roots = {n.names[0].name.split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.Import)}
    assert not names & {"open", "Path"}
    assert not roots & {"pathlib", "os", "shutil"}


def test_only_solve_imports_jaxopt():
    users = {module_of(p) for p in FILES if "jaxopt" in p.read_text() and "import jaxopt" in p.read_text()}
    assert users <= {("fit", "solve")}


def test_importing_the_package_neither_compiles_nor_configures():
    for path in FILES:
        module = module_of(path)
        if module[0] == "cli":
            continue
        for node in ast.parse(path.read_text()).body:
            assert "config.update" not in ast.unparse(node) or isinstance(node, ast.FunctionDef), path
