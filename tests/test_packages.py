"""What holds for the packages as a whole: what importing does, and who imports whom."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("recipes", "augment", "adapters", "tools")  # each may import those before it
NOT_INSTALLED = {"tools.bench"}  # measures, from a source checkout


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


IMPORT = re.compile(r"^\s*(?:from\s+(\S+)\s+import\b|import\s+(\S+))", re.MULTILINE)


def test_imports_run_in_one_direction():
    for number, package in enumerate(LAYERS):
        forbidden = {*LAYERS[number + 1 :], "tests", ""} | (
            {"torch"} if package == "recipes" else set()
        )
        for path in modules(package):
            for names in IMPORT.findall(path.read_text()):
                name = "".join(names)
                assert name.split(".")[0] not in forbidden, f"{path} imports {name}"


def test_importing_everything_compiles_nothing():
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for package in LAYERS
        for path in modules(package)
    ]
    code = f"""
import gc, importlib
for name in {names}:
    importlib.import_module(name)
from numba.core.dispatcher import Dispatcher
ours = [d for d in gc.get_objects() if isinstance(d, Dispatcher)
        and d.py_func.__module__.split(".")[0] in {LAYERS}]
assert len(ours) > 10, "no kernels were found: this test looks in the wrong place"
compiled = [d.py_func.__qualname__ for d in ours if d.signatures]
assert not compiled, f"compiled by importing: {{compiled}}"
"""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert result.returncode == 0, result.stderr


def test_all_packages_are_installed():
    """pyproject.toml lists packages by name; a folder it forgets works here and nowhere else."""
    import tomllib

    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    there = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for package in LAYERS
        for path in modules(package)
        if path.name == "__init__.py"
    }
    assert there >= NOT_INSTALLED and set(listed) == there - NOT_INSTALLED
    for package in LAYERS:
        for path in modules(package):
            assert (path.parent / "__init__.py").exists(), f"{path.parent} has no __init__.py"


def test_every_public_name_resolves():
    import augment

    for name in augment.__all__:
        assert getattr(augment, name).__name__ == name
    assert set(augment.__all__) <= set(dir(augment))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = augment.nothing
