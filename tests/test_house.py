# SPDX-License-Identifier: GPL-3.0-or-later
"""The rules of the house: which room may import which, and what must never come near Blender's process."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = ("datagen", "model", "addon", "evaluation")
FILES = sorted([*ROOT.glob("*.py"), *(f for floor in FLOORS for f in (ROOT / floor).rglob("*.py"))])
NAMES = [f.relative_to(ROOT).as_posix() for f in FILES]
TORCH_FREE = ("datagen/", "addon/", "model/io/")
BENCHMARKS = sorted(f.stem for f in (ROOT / "benchmarks").glob("*.py") if f.stem != "blender_display")
TENSORS = {"torch", "torchvision", "gsplat", "triton", "numba", "safetensors"}


def imports(name: str) -> set[str]:
    """Everything that a file imports, wherever in it: "torch.nn", or for rooms of the package the path from
    the root on, ".model.io.asset" (a name imported from a package counts as a room if there is such a room)."""
    found, package = set(), name.split("/")[:-1]
    for node in ast.walk(ast.parse((ROOT / name).read_text(), name)):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0:
                found.add(node.module)
                continue
            base = package[: len(package) - node.level + 1] + (node.module.split(".") if node.module else [])
            for alias in node.names:
                room = ROOT.joinpath(*base, alias.name)
                inside = room.with_suffix(".py").exists() or (room / "__init__.py").exists()
                found.add("." + ".".join([*base, alias.name] if inside else base))
    return found


def rooms(name: str) -> set[str]:
    """The rooms of the package that a file imports, like "model.io.asset"."""
    return {m[1:] for m in imports(name) if m.startswith(".") and m != "."}


def test_the_walker_sees_what_it_should():
    assert "model.io.asset" in rooms("addon/display.py") and "datagen.rigs" in rooms("addon/rigs.py")
    assert "addon.display" in rooms("addon/reconstruct.py") and "torch" in imports("model/gaussians.py")
    assert "model.reconstruct" in rooms("model/worker.py")  # inside a function


@pytest.mark.parametrize("name", NAMES)
def test_floors(name):
    floor, told = name.split("/")[0], rooms(name)
    if floor == "datagen":
        assert all(r.split(".")[0] == "datagen" for r in told)
    if floor == "model":
        others = {r for r in told if not r.startswith("model")}
        assert others <= {"datagen.sequence", "datagen.rigs"}
    if floor == "addon":
        others = {r for r in told if not r.startswith(("addon", "datagen."))}
        assert all(r.startswith("model.io") for r in others)
    if floor not in ("cli.py", "evaluation"):
        assert not any(r.split(".")[0] == "evaluation" for r in told), "nobody but the command line imports evaluation"
    if floor != "addon" and name != "__init__.py":
        told -= {"addon.package"} if name == "cli.py" else set()  # builds the .zip, without bpy
        assert not any(r.split(".")[0] == "addon" for r in told), "nobody imports the add-on"


@pytest.mark.parametrize("name", NAMES)
def test_no_torch_near_blender_and_no_blender_near_torch(name):
    top = {m.split(".")[0] for m in imports(name) if not m.startswith(".")}
    assert "timesplat" not in top, "inside the package imports are relative"
    if name.startswith(TORCH_FREE):
        assert not top & TENSORS
    if name.startswith("model/"):
        assert not top & {"bpy", "mathutils", "bmesh"}


def test_the_face_is_light():
    """The root and the torch-free rooms load without torch, bpy or pxr, the worker before it is asked."""
    rooms = ("model.io.asset", "model.io.usd_write", "model.io.files", "model.worker", "cli")
    code = f"import sys, {', '.join(f'timesplat.{r}' for r in rooms)}\n"
    code += "print([m for m in ('torch', 'bpy', 'pxr', 'numba', 'PIL') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


@pytest.mark.parametrize("name", BENCHMARKS)
def test_benchmarks_are_modules_of_the_package(name):
    try:
        assert importlib.import_module(f"timesplat.benchmarks.{name}").__doc__
    except ModuleNotFoundError as e:
        missing = (e.name or "").split(".")[0]
        if missing not in {*TENSORS, "matplotlib", "pxr", "bpy", "OpenEXR"}:
            raise
        pytest.skip(f"{missing} is not installed")


@pytest.mark.parametrize("name", ["gpu", "rasterize"])
def test_benchmarks_are_scripts_too(name):
    pytest.importorskip("torch")
    command = [sys.executable, ROOT / "benchmarks" / f"{name}.py", "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "--sizes" in done.stdout, done.stderr


@pytest.mark.parametrize("name", [n for n in NAMES if (ROOT / n).read_text().count("\n") > 5])
def test_every_file_names_its_licence_first(name):
    assert (ROOT / name).read_text().startswith("# SPDX-License-Identifier: GPL-3.0-or-later\n")
