# SPDX-License-Identifier: GPL-3.0-or-later
"""The rules of the house: which room may import which, and what must never come near Blender's process."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
WINGS = ("datagen", "model", "addon", "evaluation", "benchmarks")
FILES = sorted([*ROOT.glob("*.py"), *(f for wing in WINGS for f in (ROOT / wing).rglob("*.py"))])
NAMES = [f.relative_to(ROOT).as_posix() for f in FILES]
TORCH_FREE = ("datagen/", "addon/", "model/io/")
BENCHMARKS = sorted(f.stem for f in (ROOT / "benchmarks").glob("*.py") if f.stem != "blender_display")
TENSORS = {"torch", "torchvision", "gsplat", "triton", "numba", "safetensors"}

# The layers of each wing, lowest first: a room may use those of its own layer and below. (Rooms beside one another are
# kept apart by `test_no_circle`.) A name stands for the room and all that is in it.
LAYERS = {
    "model": (
        ("model.io",),
        ("model.parallel", "model.riding", "model.rotations", "model.devices", "model.layout"),
        ("model.gaussians", "model.tracks", "model.views", "model.clip"),
        ("model.rasterize",),
        ("model.film", "model.geometry"),
        ("model.film_command",),
        ("model.patches", "model.heads", "model.hexplane", "model.network"),
        ("model.checkpoints_io", "model.inference"),
        ("model.fitting",),
        ("model.deformation",),
        ("model.methods",),
        ("model.reconstruct",),
        ("model.reconstruct_command",),
        ("model.selftest",),
        ("model.worker",),
    ),
    "evaluation": (
        ("evaluation.provenance", "evaluation.protocol", "evaluation.image_quality", "evaluation.pictures"),
        ("evaluation.flip", "evaluation.lpips", "evaluation.paper", "evaluation.figures", "evaluation.labels"),
        ("evaluation.loading", "evaluation.method_spec", "evaluation.cache"),
        ("evaluation.metrics",),
        ("evaluation.scoring",),
        ("evaluation.runner",),
        ("evaluation.tables", "evaluation.bench_summary", "evaluation.charts"),
        ("evaluation.scaling", "evaluation.recipe", "evaluation.render_report"),
        (
            "evaluation.evaluate",
            "evaluation.bench",
            "evaluation.demo",
            "evaluation.ablations",
            "evaluation.differences",
        ),
        ("evaluation.study_scores",),
        ("evaluation.studies", "evaluation.contact_sheet", "evaluation.inspection_picture", "evaluation.stress"),
    ),
    "addon": (
        ("addon.asset",),
        ("addon.runtime",),
        ("addon.survey",),
        ("addon.settings",),
        ("addon.estimates",),
        ("addon.notices",),
        ("addon.operators",),
        ("addon.ui",),
        ("addon.command_line", "addon.package"),
        ("addon",),
    ),
    "datagen": (
        ("datagen.errors", "datagen.image_files", "datagen.rigs", "datagen.track_file"),
        ("datagen.whole_folders",),
        ("datagen.objaverse", "datagen.outside", "datagen.spread", "datagen.moving_frames", "datagen.passes"),
        ("datagen.sequence",),
        ("datagen.readers",),
        ("datagen.curation.measures",),
        ("datagen.curation.duplicates", "datagen.curation.decisions"),
        ("datagen.curation.page",),
        ("datagen.inspection", "datagen.importing", "datagen.curation", "datagen.shards"),
        ("datagen.writers",),
        ("datagen.displace", "datagen.blender_output", "datagen.scene", "datagen.zoo", "datagen.render_job"),
        ("datagen.licences", "datagen.render_index"),
        ("datagen.render_setup", "datagen.tracks", "datagen.render_child"),
        ("datagen.capture", "datagen.render_pool"),
        ("datagen.ray_pool",),
        ("datagen.render_asset", "datagen.render_trials", "datagen.farm"),
    ),
    "benchmarks": (
        ("benchmarks.timing", "benchmarks.cameras", "benchmarks.opensplat"),
        (
            "benchmarks.blender_display",
            "benchmarks.network",
            "benchmarks.rasterizer",
            "benchmarks.recipe",
            "benchmarks.renderer",
            "benchmarks.training",
            "benchmarks.usd",
        ),
        ("benchmarks.rasterizer_cuda",),
    ),
}
# What `model` knows of `datagen`: how views are read and written, none of what renders them.
MODEL_READS = {
    "datagen.curation.decisions",
    "datagen.curation.measures",
    "datagen.inspection",
    "datagen.passes",
    "datagen.readers",
    "datagen.readers.options",
    "datagen.rigs",
    "datagen.sequence",
    "datagen.shards",
    "datagen.track_file",
    "datagen.whole_folders",
}
# What the product, all of `model` but these, does not know; they may use every layer up to the one named.
ASIDE = {"model.baselines": "model.methods", "model.training": "model.inference"}


def room_of(name: str) -> str:
    """The room of a file: "model/io/ply.py" -> "model.io.ply"."""
    return name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imports(name: str) -> set[str]:
    """Everything that a file imports, wherever in it: "torch.nn", or for rooms of the package the path from
    the root on, ".model.io.asset" (a name imported from a package counts as a room if there is such a room)."""
    found, package = set(), name.split("/")[:-1]
    for node in ast.walk(ast.parse((ROOT / name).read_text(), name)):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            words = node.module.split(".") if node.module else []
            if node.level == 0 and words[0] != "timesplat":
                found.add(node.module)
                continue
            base = package[: len(package) - node.level + 1] + words if node.level else words[1:]
            for alias in node.names:
                room = ROOT.joinpath(*base, alias.name)
                inside = room.with_suffix(".py").exists() or (room / "__init__.py").exists()
                found.add("." + ".".join([*base, alias.name] if inside else base))
    return found


def rooms(name: str) -> set[str]:
    """The rooms of the package that a file imports, like "model.io.asset"."""
    return {m[1:] for m in imports(name) if m.startswith(".") and m != "."}


def within(room: str, place: str) -> bool:
    """Whether a room is a place or in it."""
    return room == place or room.startswith(place + ".")


def layer(room: str) -> int:
    """The number of the layer of its wing that a room is in, by the longest name that fits."""
    fitting = [(len(p), i) for i, places in enumerate(LAYERS[room.split(".")[0]]) for p in places if within(room, p)]
    assert fitting, f"{room} is in no layer; give it a place in LAYERS"
    return max(fitting)[1]


def test_the_walker_sees_what_it_should():
    assert "model.io.asset" in rooms("addon/asset/display.py") and "torch" in imports("model/gaussians.py")
    assert {"addon.asset.display", "addon.settings", "datagen.sequence"} <= rooms("addon/operators/reconstruct.py")
    assert "model.reconstruct" in rooms("model/worker.py")  # inside a function


@pytest.mark.parametrize("name", NAMES)
def test_wings(name):
    wing, told = name.split("/")[0], rooms(name)
    if wing == "datagen":
        assert all(within(r, "datagen") for r in told)
    if wing == "model":
        assert {r for r in told if not within(r, "model")} <= MODEL_READS
    if wing == "addon":
        others = {r for r in told if not within(r, "addon") and not within(r, "datagen")}
        assert all(within(r, "model.io") for r in others)
    if wing not in ("cli.py", "evaluation", "benchmarks"):
        assert not any(within(r, w) for r in told for w in ("evaluation", "benchmarks")), "only cli imports side wings"
    if wing != "addon" and name not in ("__init__.py", "benchmarks/blender_display.py"):
        told -= {"addon.package"} if name == "cli.py" else set()  # builds the .zip, without bpy
        assert not any(within(r, "addon") for r in told), "nobody imports the add-on"


@pytest.mark.parametrize("name", [n for n in NAMES if n.split("/")[0] in LAYERS])
def test_layers(name):
    room = room_of(name)
    wing = room.split(".")[0]
    inside = {r for r in rooms(name) if within(r, wing)}
    apart = next((place for place in ASIDE if within(room, place)), None)
    if apart:
        assert all(within(r, apart) or layer(r) <= layer(ASIDE[apart]) for r in inside)
    elif room != wing or wing == "addon":  # a package's face imports nothing else
        assert not any(within(r, place) for r in inside for place in ASIDE), (
            "the product knows no baseline, no training"
        )
        above = {r for r in inside - {wing} if layer(r) > layer(room)}
        assert not above, f"{room} reaches up to {above}"


def test_no_circle():
    """Of imports, those inside functions included. That a room lies in a package does not count."""
    left = {room_of(n): rooms(n) - {room_of(n)} for n in NAMES if n != "__init__.py"}
    while free := [room for room, needs in left.items() if not needs & left.keys()]:
        left = {room: needs for room, needs in left.items() if room not in free}
    assert left == {}, {room: needs & left.keys() for room, needs in left.items()}


@pytest.mark.parametrize("name", NAMES)
def test_no_torch_near_blender_and_no_blender_near_torch(name):
    top = {m.split(".")[0] for m in imports(name) if not m.startswith(".")}
    if not name.startswith("benchmarks/"):  # these run as scripts as well
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


@pytest.mark.parametrize("name", ["rasterizer_cuda", "rasterizer"])
def test_benchmarks_are_scripts_too(name):
    pytest.importorskip("torch")
    command = [sys.executable, ROOT / "benchmarks" / f"{name}.py", "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "--sizes" in done.stdout, done.stderr


@pytest.mark.parametrize("name", [n for n in NAMES if (ROOT / n).read_text().count("\n") > 5])
def test_every_file_names_its_licence_first(name):
    assert (ROOT / name).read_text().startswith("# SPDX-License-Identifier: GPL-3.0-or-later\n")
