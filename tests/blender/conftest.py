# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of the tests that need Blender: the package from the checkout, and as an installed extension. The
worker always runs in pytest's Python."""

import os
import shutil
import subprocess
import sys

import pytest

from .helpers import CHECKOUT, ENABLED, REAL, TARGET, Runner
from .packages import runtime, wheel

WORKER = {"TIMESPLAT_PYTHON": sys.executable}  # has torch, where Blender has none


@pytest.fixture
def blender(tmp_path):
    """`blender(code, *args, env=None) -> dict`: see helpers.Runner. The checkout is the package `timesplat`; no
    operator is registered (`part("addon").register()` does it)."""
    return Runner(tmp_path / "blender", CHECKOUT, WORKER)


@pytest.fixture(scope="session")
def extension(tmp_path_factory):
    """The extension's .zip, built from the working tree."""
    from timesplat.addon.package import build

    folder = tmp_path_factory.mktemp("extension")
    path = build(folder)
    assert os.listdir(folder) == [path.name]
    return path


@pytest.fixture(scope="session")
def profile(extension, tmp_path_factory):
    """A user profile in which the .zip is installed and enabled, as a person does it on the command line."""
    folder = tmp_path_factory.mktemp("profile")
    if REAL:
        env = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user"), "TMPDIR": str(folder)}
        install = [TARGET, "--command", "extension", "install-file", "-r", "user_default", "--enable", str(extension)]
        done = subprocess.run(install, capture_output=True, text=True, env=env)
        assert done.returncode == 0, done.stdout + done.stderr
    else:
        code = 'bpy.ops.preferences.addon_enable(module="bl_pkg")\n'
        code += 'bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default")\ntell()'
        Runner(folder, "")(code, extension)
    assert (folder / "user/extensions/user_default/timesplat/blender_manifest.toml").is_file()
    return folder / "user"


@pytest.fixture
def installed(profile, tmp_path):
    """As `blender`, with the extension installed and enabled in a profile of the test's own: the package is
    bl_ext.user_default.timesplat, and no `timesplat` can be imported."""
    runner = Runner(tmp_path / "installed", ENABLED, WORKER)
    shutil.copytree(profile, runner.user)
    return runner


@pytest.fixture
def index(tmp_path):
    """A folder of all packages that the runtime needs, each newer than it must be."""
    folder = tmp_path / "wheels"
    folder.mkdir()
    for name, version, _ in runtime.REQUIREMENTS:
        wheel(folder, name, f"{version}.7")
    return folder
