# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the add-on keeps files of its own."""

FOLDER = """
folders = part("addon.runtime.folders")
before = str(folders.user_folder("runs"))
folders.WINDOWS = True
os.environ["LOCALAPPDATA"] = sys.argv[1]
made = str(folders.user_folder("runs"))
runtime, exists = str(folders.runtime_folder()), os.path.isdir(made)
del os.environ["LOCALAPPDATA"]
tell(before=before, made=made, exists=exists, runtime=runtime, without=str(folders.user_folder("runs")),
     version="%d.%d" % bpy.app.version[:2])
"""
LONGEST = 126  # characters: of a file's name in torch 2.15's wheel for Windows, below site-packages


def test_the_runtime_lies_where_its_names_fit(installed, tmp_path):
    told = installed(FOLDER, tmp_path)
    home = tmp_path / "Timesplat" / told["version"]
    assert told["made"] == str(home / "runs") and told["exists"] and told["runtime"] == str(home / "runtime/venv")
    assert told["before"] == told["without"] and not told["before"].startswith(str(tmp_path / "Timesplat"))
    below = rf"\Timesplat\{told['version']}\runs\run-123456-abcdefgh\venv\Lib\site-packages\\"[:-1]
    assert len(r"C:\Users\a.name.of.25.characters\AppData\Local" + below) + LONGEST < 260
