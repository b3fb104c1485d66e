# SPDX-License-Identifier: GPL-3.0-or-later
"""Packages of a few bytes for the runtime's installation, and a pip that knows them."""

import importlib.util
import os
import zipfile
from pathlib import Path

from .helpers import ROOT

SCRIPT = ROOT / "addon" / "runtime" / "install.py"


def load():
    spec = importlib.util.spec_from_file_location("runtime", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


runtime = load()


def wheel(folder: Path, name: str, version: str, code: str = "", needs=()) -> None:
    """A package of one module, as pip installs it."""
    module = {n: m for n, _, m in runtime.REQUIREMENTS}.get(name, name.replace("-", "_"))
    info = f"{name.replace('-', '_')}-{version}.dist-info"
    meta = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    files = {
        f"{module}/__init__.py": code,
        f"{info}/METADATA": meta + "".join(f"Requires-Dist: {x}\n" for x in needs),
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    with zipfile.ZipFile(folder / f"{name.replace('-', '_')}-{version}-py3-none-any.whl", "w") as z:
        for path, text in {**files, f"{info}/RECORD": "".join(f"{f},,\n" for f in [*files, f"{info}/RECORD"])}.items():
            z.writestr(path, text)


def pip(index: Path) -> dict:
    """A pip that knows this folder and nothing else."""
    return {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(index)}


# Code of a test of the buttons: the modules, a worker that answers at once.
BUTTONS = """
able = bool(importlib.util.find_spec("ensurepip") or importlib.util.find_spec("pip"))
options, folders, jobs = (part(f"addon.runtime.{x}") for x in ("worker_options", "folders", "jobs"))
buttons = part("addon.operators.runtime_buttons")
def op(name, **options):
    try:
        return list(getattr(bpy.ops.timesplat, name)(**options))
    except RuntimeError as e:
        return str(e)
def left():
    return sorted(x.name for n in ("runs", "runtime") for x in folders.user_folder(n, create=False).glob("*"))
process, asked = part("addon.runtime.child_process"), []
report = ["ok lift: fine", "ok network: fine"]
def worker(python, request, folder):
    asked.append([python, request])
    code = f"print({json.dumps({'event': 'done', 'report': report})!r})" if report else "raise SystemExit('no AVX')"
    return process.Child([sys.argv[1], "-c", code], request, folder)
process.start_worker = worker
text = lambda: bpy.data.texts["Timesplat self-test"].as_string().splitlines()
"""
