# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs of `timesplat render` that are killed at random moments, and what they must end with."""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet

from timesplat.datagen.render_index import read_index

KILLS = int(os.environ.get("TIMESPLAT_KILLS", "20"))  # in the tests that are marked slow
ZOO = ["--zoo", "3,11,1000104"]  # beside the assets, where there are many kills
SMALL = ["--size", "32", "--samples", "1", "--frames", "2", "--rig", "alternating", "--clip", "all"]


def everything(folder):
    """{path: what is in the file} of a run, without the seconds that things took."""
    found = {}
    for file in sorted(f for f in folder.rglob("*") if f.is_file()):
        name, data = file.relative_to(folder).as_posix(), file.read_bytes()
        if file.name == "index.parquet":
            data = pyarrow.parquet.read_table(file).drop_columns(["seconds", "cpu_seconds"]).to_pylist()
        elif file.name == "index.csv":
            data = [replace(row, seconds=0, cpu_seconds=0) for row in read_index(folder)]
        elif file.name in ("transforms.json", "failed.json"):
            data = json.loads(data)
            for measured in ("seconds", "cpu_seconds"):
                (data["provenance"] if "provenance" in data else data["row"]).pop(measured)
        found[name] = data
    return found


def start(out, words):
    """`timesplat render` of small pictures into `out`, in a session of its own."""
    command = [sys.executable, "-m", "timesplat.cli", "render", *map(str, words), *SMALL, "--jobs", "2"]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen([*command, "--out", str(out)], start_new_session=True, **pipes)


def children(out):
    """{pid: that of its parent} of the processes that render into `out` at this moment."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
            if (
                b"timesplat.datagen.render_asset" in words
                and str(out) in json.loads(Path(words[3].decode()).read_text())["out"]
            ):
                found[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError, IndexError):  # it is gone
            continue
    return found


def survives(words, folder, kills, rng, kill):
    """Renders undisturbed into `folder`/whole, then into `folder`/killed while `kill(process, number of the kill)` is
    called at random moments, and what it killed is started again. Whenever a run comes to its end it must have left the
    same; then it is rendered anew, until there were so many kills. Returns how many runs came to their end."""
    whole, out = folder / "whole", folder / "killed"
    begin = time.monotonic()
    assert start(whole, words).wait(600) == 2  # there is a file that is cut off
    took, expected = time.monotonic() - begin, everything(whole)
    assert len([name for name in expected if name.endswith("transforms.json")]) >= 3
    killed, ends = 0, 0
    process = start(out, words)
    while True:
        try:
            process.wait(600 if killed == kills else rng.uniform(0.05, 0.7) * took)
        except subprocess.TimeoutExpired:
            assert killed < kills
            killed += kill(process, killed)
            print(f"{killed} of {kills} kills, {ends} runs came to their end", flush=True)
            if process.poll() is not None:
                process = start(out, words)
            continue
        assert process.returncode == 2 and everything(out) == expected
        ends += 1
        if killed == kills:
            assert not children(out)
            return ends
        shutil.rmtree(out)
        process = start(out, words)
