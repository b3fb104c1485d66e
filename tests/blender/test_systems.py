# SPDX-License-Identifier: GPL-3.0-or-later
"""What the add-on does otherwise on Windows, played in a Blender on this system."""

SWEEP = """
import subprocess
from types import ModuleType, SimpleNamespace
jobs, process = part("addon.runtime.jobs"), part("addon.runtime.child_process")
folders = part("addon.runtime.folders")
runs = folders.user_folder("runs")
here, dead, foreign = os.getpid(), 44444, 55555
class Winapi(ModuleType):
    SYNCHRONIZE, WAIT_TIMEOUT, asked, closed = 0x00100000, 258, [], []
    def OpenProcess(self, access, inherit, pid):
        self.asked.append(pid)
        if pid == foreign:
            raise PermissionError(13, "Access is denied")
        if pid == dead:
            raise OSError(22, "The parameter is incorrect")
        return pid
    def WaitForSingleObject(self, handle, milliseconds):
        return 258 if handle == 66666 else 0
    def CloseHandle(self, handle):
        self.closed.append(handle)
winapi = sys.modules["_winapi"] = Winapi("_winapi")
part("addon.runtime.run_folders").WINDOWS = True
def ended(*_):
    raise SystemExit("os.kill ends a process there")
os.kill = ended
sleeper = [sys.argv[1], "-c", "import time; time.sleep(99)"]
job = jobs.start("x", [lambda folder: process.Child(sleeper, {}, folder)])
for pid in (here, dead, foreign, 66666, 77777):
    (runs / f"run-{pid}-abc").mkdir()
    (runs / f"run-{pid}-abc" / "picture.png").touch()
jobs.sweep()
left = sorted(x.name for x in runs.iterdir())
mine = job.folder.name
job.cancel()
tell(left=left, mine=mine, asked=sorted(winapi.asked), closed=sorted(winapi.closed))
"""


def test_what_other_blenders_still_need_is_not_swept(installed):
    import sys

    told = installed(SWEEP, sys.executable)
    assert told["left"] == sorted([told["mine"], "run-55555-abc", "run-66666-abc"])
    assert told["asked"] == [44444, 55555, 66666, 77777] and told["closed"] == [66666, 77777]


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
