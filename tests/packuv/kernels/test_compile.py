"""Kernels are compiled in one way, and never run machine code of older sources."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from packuv.kernels import compile
from packuv.kernels.compile import PACKAGE, kernel, sources_digest

COMPILERS = {"njit", "jit", "generated_jit", "vectorize", "guvectorize", "stencil", "cfunc"}
PROBE = """
import numpy as np
from packuv.camera import PinholeCamera
from packuv.fit.labels import active_tiles
from packuv.gaussians.floats import Gaussians

pose = np.eye(4)
pose[2, 3] = 4
camera = PinholeCamera("c", 96, 64, 63.0, 64.0, 48, 32, pose)
arrays = np.zeros((1, 3)), np.full((1, 3), -1.5), np.array([[1, 0, 0, 0.0]]), np.array([2.0]), np.zeros((1, 1, 3))
one = Gaussians(*(a.astype(np.float32) for a in arrays))
print(active_tiles(np.zeros((64, 96), bool), one, camera, near=0.1).sum())
"""


def modules() -> Iterator[tuple[str, Path]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def direct_compilations(tree: ast.AST) -> Iterator[str]:
    """Uses of numba's compilers for the CPU. `cuda.jit` keeps no cache, so it cannot be stale."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "numba":
            yield from (alias.name for alias in node.names if alias.name in COMPILERS)
        if isinstance(node, ast.Attribute) and node.attr in COMPILERS and ast.unparse(node.value) != "cuda":
            yield ast.unparse(node)


def test_every_kernel_of_the_package_is_compiled_by_kernel():
    found = {name: list(direct_compilations(ast.parse(path.read_bytes()))) for name, path in modules()}
    assert {name: uses for name, uses in found.items() if uses} == {"packuv.kernels.compile": ["numba.njit"]}


@pytest.mark.parametrize("line", ["from numba import njit", "@numba.njit()\ndef f(): pass", "f = nb.vectorize(g)"])
def test_the_scan_sees_a_direct_use(line):
    assert list(direct_compilations(ast.parse(line)))


@pytest.mark.slow
def test_a_constant_changed_in_another_file_is_seen_at_once(tmp_path):
    """Numba alone would go on with the old size of a tile: the kernel's own file has not changed."""
    shutil.copytree(PACKAGE, tmp_path / "packuv", ignore=shutil.ignore_patterns("__pycache__"))
    view = tmp_path / "packuv" / "raster" / "view.py"

    def probe() -> int:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        command = [sys.executable, "-P", "-c", PROBE]
        done = subprocess.run(command, env=environment, cwd=tmp_path, text=True, capture_output=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    assert probe() == 4
    view.write_text(re.sub(r"^TILE = 16$", "TILE = 8", view.read_text(), flags=re.MULTILINE))
    assert probe() == 12
    assert len(list((tmp_path / "cache").glob("kernels-*"))) > 1


def imported(path: Path) -> set[Path]:
    """Files of the package that a file imports, by its syntax tree."""
    names, found = dict(modules()), set[str]()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inside | ({node.module} if inside - set(names) else set())
    return {names[name] for name in found & set(names)}


def test_what_a_file_imports_is_seen_in_its_text():
    for name, path in modules():
        assert compile._imported(path) == imported(path), name


def test_a_closure_holds_what_its_modules_import():
    for name, path in modules():
        closure = compile._closure(name)
        assert path in closure
        assert all(imported(member) <= closure for member in closure), name


@pytest.mark.parametrize(
    "text",
    [
        "from packuv.raster.view import TILE",
        "if True:\n    from packuv.raster.view import TILE as SIDE  # (here",
        "from packuv.raster import view",
        "import packuv.raster.view as v, os",
        "from packuv.raster.view import (\n    TILE,  # of a tile (16)\n    SIDE,\n)",
    ],
)
def test_an_import_is_seen_however_it_is_written(tmp_path, text):
    (tmp_path / "module.py").write_text(f'"""A module."""\n{text}\n')
    assert compile._imported(tmp_path / "module.py") == imported(tmp_path / "module.py")
    assert PACKAGE / "raster" / "view.py" in compile._imported(tmp_path / "module.py")


def test_a_closure_goes_through_other_modules_and_no_further():
    names = {path.relative_to(PACKAGE).as_posix() for path in compile._closure("packuv.raster.bins")}
    assert {"raster/bins.py", "raster/project.py", "raster/ewa.py", "raster/view.py", "kernels/simd.py"} <= names
    assert "raster/blend.py" not in names  # imports bins, not the other way round
    assert not any(name.startswith("fit/") for name in names)
    assert sources_digest("packuv.raster.bins") != sources_digest("packuv.raster.blend")


def test_what_a_closure_cannot_follow_is_refused(tmp_path):
    with pytest.raises(ValueError, match="kernels are compiled for modules of packuv, not for numpy"):
        sources_digest("numpy")
    hidden = tmp_path / "module.py"
    hidden.write_text("from .view import TILE\n")
    with pytest.raises(ValueError, match=r"module.py: 'from .view import TILE': relative imports hide"):
        compile._imported(hidden)


def test_the_setting_of_other_packages_is_left_alone():
    def double(x):
        return 2 * x

    double.__module__ = "packuv.kernels.simd"
    before = numba.config.CACHE_DIR
    inner = kernel(inner=True)(double)
    assert before == numba.config.CACHE_DIR

    @numba.njit
    def outer(x):
        return inner(x)

    assert outer(21) == 42


def test_an_inline_kernel_gives_what_python_gives():
    from packuv.raster import ewa, project

    turn = project._rotation
    quaternion = np.array([0.5, -0.5, 0.1, 0.7]) / np.linalg.norm([0.5, -0.5, 0.1, 0.7])

    @numba.njit
    def compiled(w, x, y, z):
        return turn(w, x, y, z)

    np.testing.assert_allclose(compiled(*quaternion), ewa.rotation(*quaternion), rtol=0, atol=1e-15)


def test_read_only_sources_have_their_cache_elsewhere(monkeypatch, tmp_path):
    monkeypatch.setattr(compile.os, "access", lambda path, mode: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compile._cache_root.cache_clear()
    try:
        assert compile._cache_root() == tmp_path / "packuv"
    finally:
        compile._cache_root.cache_clear()
