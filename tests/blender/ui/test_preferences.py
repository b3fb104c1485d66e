# SPDX-License-Identifier: GPL-3.0-or-later
"""The preferences, as they are drawn."""

from ..packages import BUTTONS

DRAW = """
from unittest.mock import MagicMock
versions = {"torch": "2", "numpy": "2"}
options._installed = {"python": "bin/python", "build": "cpu", "versions": versions, "bytes": 5e8}
buttons.self_test_report[:] = ["ok lift: fine", "FAILED: network: " + "long " * 40]
buttons.last_job = MagicMock(spec=jobs.Job, state="running", fraction=0.5, text="half", label="Install", number=1)
jobs.JOBS.append(buttons.last_job)
prefs = bpy.context.preferences.addons[name].preferences
def draw():
    layout = MagicMock()
    type(prefs).draw(MagicMock(layout=layout), bpy.context)
    return " ".join(map(str, layout.mock_calls))
draw()
files = []
watching = True
sys.addaudithook(lambda event, args: watching and event in ("open", "os.listdir", "os.scandir", "import") and
                 files.append([event, str(args)]))
drawn = draw()
buttons.last_job.state, buttons.last_job.message = "failed", "No room."
drawn += draw()
watching = False
prefs.python = sys.executable
named, there = draw(), [options.is_named_python_there()]
prefs.python = "/nowhere/python"
gone = draw()
there.append(options.is_named_python_there())
jobs.JOBS.clear()
tell(there=there, named=named, gone=gone, files=files, drawn=drawn)
"""


def test_drawing_reads_no_file(installed):
    told = installed(BUTTONS + DRAW)
    assert told["files"] == []
    assert told["there"] == [True, False] and "not installed" not in told["named"]
    assert "Python: /nowhere/python: there is no such file." in told["gone"]
    for words in ("'checkpoint'", "torch 2 (CPU), 500 MB", "numpy 2", "factor=0.5", "No room."):
        assert words in told["drawn"], words
    for operator in ("install_runtime", "uninstall_runtime", "self_test", "cancel", "log"):
        assert f"timesplat.{operator}" in told["drawn"]
