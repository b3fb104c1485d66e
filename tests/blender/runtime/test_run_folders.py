# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders of runs whose Blender is gone, on Windows, played in a Blender on this system."""

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
