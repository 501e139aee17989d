"""Machine code that Numba keeps must not outlive the sources that it is made of.

`njit(cache=True)` watches the file that holds the function and no other. A number, an array or a function from another
of our files is compiled in, and stays as it was when that file changes. packuv compiles through
`packuv.kernels.compile`, which names the cache after all sources; sync, calibration and studio may not import that, so
their cached kernels use nothing of ours from elsewhere.
"""

from __future__ import annotations

import ast
import dis
import importlib
import pkgutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

OURS = ("pipelines", "tasks", "packuv", "sync", "calibration", "studio", "bench")


def modules_of(package: str) -> list[ModuleType]:
    root = importlib.import_module(package)
    inner = pkgutil.walk_packages(root.__path__, f"{package}.")
    return [root, *(importlib.import_module(module.name) for module in inner)]


def cached_kernels(module: ModuleType) -> list[Dispatcher]:
    """Those that stand in this module; what it imports is looked at where it stands."""
    found = [value for value in vars(module).values() if isinstance(value, Dispatcher)]
    return [
        kernel
        for kernel in found
        if kernel.py_func.__module__ == module.__name__ and not isinstance(kernel._cache, NullCache)
    ]


def faults(kernel: Dispatcher, ours: Sequence[str] = OURS) -> list[str]:
    """Names of what a kernel compiles in from another of our files, itself or through what it uses in its own file."""
    module = sys.modules[kernel.py_func.__module__]
    tree = ast.parse(Path(str(module.__file__)).read_text())
    imported, made_of = set(imported_names(tree, ours)), dict(assigned_names(tree))
    found, seen, waiting = set[str](), set[str](), [*names_used(kernel.py_func)]
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        function = plain(getattr(module, name, None))
        if name in imported or is_foreign(function, module, ours):
            found.add(name)
        elif isinstance(function, FunctionType) and function.__module__ == module.__name__:
            waiting += names_used(function)
        waiting += made_of.get(name, ())
    cells = [plain(cell.cell_contents) for cell in kernel.py_func.__closure__ or ()]
    return sorted(found) + [cell.__name__ for cell in cells if is_foreign(cell, module, ours)]


def plain(value: Any) -> Any:
    """The Python function of a compiled one."""
    return value.py_func if isinstance(value, Dispatcher) else value


def is_foreign(value: Any, module: ModuleType, ours: Sequence[str]) -> bool:
    home = getattr(value, "__module__", None) if isinstance(value, FunctionType) else None
    return home is not None and home != module.__name__ and home.split(".")[0] in ours


def names_used(function: FunctionType) -> Iterator[str]:
    """Global names in a function's code and in functions inside it."""
    waiting: list[CodeType] = [function.__code__]
    while waiting:
        code = waiting.pop()
        yield from (step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"))
        waiting += [constant for constant in code.co_consts if isinstance(constant, CodeType)]


def imported_names(tree: ast.Module, ours: Sequence[str]) -> Iterator[str]:
    """Names that a file's imports bind to what is ours."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").split(".")[0] in ours):
            yield from (alias.asname or alias.name for alias in node.names)
        elif isinstance(node, ast.Import):
            mine = [alias for alias in node.names if alias.name.split(".")[0] in ours]
            yield from (alias.asname or alias.name.split(".")[0] for alias in mine)


def assigned_names(tree: ast.Module) -> Iterator[tuple[str, set[str]]]:
    """Global names that a file gives a value, and the names of which the value is made."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            parts = {part.id for part in ast.walk(node.value) if isinstance(part, ast.Name)}
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                yield from ((part.id, parts) for part in ast.walk(target) if isinstance(part, ast.Name))


@pytest.mark.parametrize("package", ["sync", "calibration", "studio"])
def test_no_cached_kernel_uses_another_file(package: str) -> None:
    kernels = [kernel for module in modules_of(package) for kernel in cached_kernels(module)]
    assert kernels, f"{package} has no cached kernels, so this test looks in the wrong place"
    found = {f"{kernel.py_func.__module__}.{kernel.py_func.__name__}": faults(kernel) for kernel in kernels}
    assert {name: names for name, names in found.items() if names} == {}, "pass these as arguments"


MADE_UP = {
    "nothing of ours": ("", "np.sqrt(x) + len(TABLE) + helper(x)", []),
    "a number": ("from made_up_limits import LIMIT", "x + LIMIT", ["LIMIT"]),
    "a number under another name": ("from made_up_limits import LIMIT as MOST", "x + MOST", ["MOST"]),
    "a module's number": ("import made_up_limits", "x + made_up_limits.LIMIT", ["made_up_limits"]),
    "an array": ("from made_up_limits import STEPS", "x + STEPS[0]", ["STEPS"]),
    "a compiled function": ("from made_up_limits import twice", "twice(x)", ["twice"]),
    "a function bound anew": ("import made_up_limits\ndouble = made_up_limits.twice", "double(x)", ["double"]),
    "through a number of its own": ("from made_up_limits import LIMIT\nHALF = LIMIT / 2", "x + HALF", ["LIMIT"]),
    "through a function of its own": (
        "from made_up_limits import LIMIT\n\n\n@njit\ndef within(x):\n    return min(x, LIMIT)",
        "within(x)",
        ["LIMIT"],
    ),
    "a function inside": ("from made_up_limits import LIMIT", "(lambda y: y + LIMIT)(x)", ["LIMIT"]),
}


@pytest.mark.parametrize("case", MADE_UP)
def test_a_kernel_with_such_a_fault_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    extra, result, expected = MADE_UP[case]
    head = "import numpy as np\nfrom numba import njit\n"
    (tmp_path / "made_up_limits.py").write_text(
        f"{head}LIMIT = 4\nSTEPS = np.arange(4)\n\n\n@njit(cache=True)\ndef twice(x):\n    return 2 * x\n"
    )
    (tmp_path / "made_up_kernel.py").write_text(
        f"{head}{extra}\nTABLE = np.zeros(3)\n\n\n@njit\ndef helper(x):\n    return x + len(TABLE)\n\n\n"
        f"@njit(cache=True)\ndef kernel(x):\n    return {result}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("made_up_limits", "made_up_kernel"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    kernels = cached_kernels(importlib.import_module("made_up_kernel"))
    found = {name for kernel in kernels for name in faults(kernel, ours=("made_up_limits", "made_up_kernel"))}
    assert [kernel.py_func.__name__ for kernel in kernels] == ["kernel"]
    assert set(expected) <= found <= {*expected, "made_up_limits"}
    assert bool(found) == bool(expected)
