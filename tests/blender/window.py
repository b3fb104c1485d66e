# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender with a window on a virtual screen, driven by mouse and keyboard as a person drives it.

Everything that acts on Blender goes through xdotool. What a person would see (which area lies where, the current
frame, how a job stands) comes from a script inside Blender that answers questions and changes nothing.
Needs Xvfb, xdotool and ImageMagick's `import` beside the `blender` executable or on PATH.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

WIDTH, HEIGHT = 1600, 1000
# Looks for <folder>/question (a Python expression) and answers in <folder>/answer.
OBSERVER = """
import bpy, json, os, sys
FOLDER = sys.argv[sys.argv.index("--") + 1]
last = 0
def ours(path):
    for name, module in list(sys.modules.items()):
        if name.endswith(".timesplat." + path):
            return module
def areas(window):
    return [dict(kind=a.type, x=a.x, y=a.y, w=a.width, h=a.height, regions=[
        dict(kind=r.type, x=r.x, y=r.y, w=r.width, h=r.height) for r in a.regions]) for a in window.screen.areas]
def tab():  # of the 3D viewport's sidebar
    for area in bpy.context.window_manager.windows[0].screen.areas:
        for r in area.regions:
            if area.type == "VIEW_3D" and r.type == "UI" and r.width > 1:
                return r.active_panel_category
def look():
    return [dict(w=w.width, h=w.height, x=w.x, y=w.y, areas=areas(w)) for w in bpy.context.window_manager.windows]
def answer():
    global last
    try:
        number, question = json.load(open(FOLDER + "/question"))
    except (OSError, ValueError):
        return 0.05
    if number != last:
        last = number
        try:
            said = eval(question)
        except Exception as e:
            said = "ERROR " + repr(e)
        with open(FOLDER + "/answer.tmp", "w") as f:
            json.dump([number, said], f, default=str)
        os.replace(FOLDER + "/answer.tmp", FOLDER + "/answer")
    return 0.05
bpy.app.timers.register(answer, persistent=True)
"""


def tool(blender: str, name: str) -> str | None:
    """A program that stands beside the Blender executable, else on PATH."""
    beside = Path(blender).parent / name
    return str(beside) if beside.exists() else shutil.which(name)


def missing(blender: str) -> str:
    """The programs that a window would need and that are not here, as a sentence's end; "" where all are."""
    return ", ".join(n for n in ("Xvfb", "xdotool", "import") if not tool(blender, n))


class Window:
    """with Window(blender, folder, profile) as w: … `folder` gets its temporary folder, its log and the pictures."""

    def __init__(self, blender: str, folder: Path, profile: Path, *args, env: dict | None = None) -> None:
        self.blender, self.folder, self.pictures = blender, folder, folder / "pictures"
        self.tmp = folder / "tmp"
        for x in (folder, self.tmp, self.pictures, folder / "observer"):
            x.mkdir(exist_ok=True)
        self.env = {**os.environ, "BLENDER_USER_RESOURCES": str(profile), "TMPDIR": str(self.tmp), **(env or {})}
        self.args, self.asked, self.shots = args, 0, 0

    def __enter__(self):
        r, w = os.pipe()
        screen = [tool(self.blender, "Xvfb"), "-displayfd", str(w), "-screen", "0", f"{WIDTH}x{HEIGHT}x24"]
        self.screen = subprocess.Popen(
            [*screen, "-nolisten", "tcp"], pass_fds=[w], stderr=open(self.folder / "screen.log", "wb")
        )
        os.close(w)
        with os.fdopen(r) as f:
            self.env["DISPLAY"] = ":" + f.readline().strip()
        script = self.folder / "observer.py"
        script.write_text(OBSERVER)
        command = [self.blender, "-p", "0", "0", str(WIDTH), str(HEIGHT), *self.args, "--python", str(script)]
        self.log = open(self.folder / "blender.log", "wb")
        self.process = subprocess.Popen(
            [*map(str, command), "--", str(self.folder / "observer")],
            env=self.env,
            stdout=self.log,
            stderr=subprocess.STDOUT,
        )
        try:
            self.wait_for("bpy.context.window_manager.windows[0].width > 0", 120)
        except BaseException:
            self.__exit__()
            raise
        time.sleep(2)
        return self

    def __exit__(self, *_):
        for process in (self.process, self.screen):
            if process.poll() is None:
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(10)
                if process.poll() is None:
                    process.send_signal(signal.SIGKILL)
                    process.wait()
        self.log.close()

    # ------------------------------------------------------------ to see

    def ask(self, question: str, timeout: float = 60):
        """The value of a Python expression in Blender. Raises AssertionError where none comes."""
        self.asked += 1
        box = self.folder / "observer"
        (box / "question.tmp").write_text(json.dumps([self.asked, question]))
        os.replace(box / "question.tmp", box / "question")
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            with contextlib.suppress(OSError, ValueError):
                number, said = json.loads((box / "answer").read_text())
                if number == self.asked:
                    return said
            assert self.process.poll() is None, f"Blender is gone: {self.said()}"
            time.sleep(0.03)
        self.picture("no answer")
        raise AssertionError(f"no answer to {question}")

    def wait_for(self, question: str, timeout: float = 60):
        """Asks until the answer is true; returns it."""
        end, said = time.monotonic() + timeout, None
        while time.monotonic() < end:
            with contextlib.suppress(AssertionError):
                said = self.ask(question, min(timeout, 20))
                if said and not str(said).startswith("ERROR"):
                    return said
            if self.process.poll() is not None:
                break
            time.sleep(0.1)
        self.picture("waited in vain")
        raise AssertionError(f"waited {timeout} s for {question}, which is {said}: {self.said()}")

    def said(self) -> str:
        return (self.folder / "blender.log").read_text(errors="replace")[-3000:]

    def picture(self, name: str) -> Path:
        """A picture of the whole screen, numbered in order."""
        self.shots += 1
        path = self.pictures / f"{self.shots:02d}-{re.sub('[^a-z0-9]+', '-', name.lower())}.png"
        self._run("import", "-window", "root", str(path))
        return path

    def area(self, kind: str) -> dict:
        """The largest area of a kind, like "VIEW_3D", with its regions; x and y from the screen's left and top."""
        found = []
        for window in self.ask("look()"):
            for area in window["areas"]:
                for box in (area, *area["regions"]):
                    box["x"] += window["x"]
                    box["y"] = HEIGHT - window["y"] - box["y"] - box["h"]
                found += [area] if area["kind"] == kind else []
        assert found, f"no {kind} on screen"
        return max(found, key=lambda a: a["w"] * a["h"])

    def region(self, area: str, kind: str) -> dict:
        return next(r for r in self.area(area)["regions"] if r["kind"] == kind)

    # ------------------------------------------------------------ to act

    def _run(self, name: str, *args) -> None:
        command = [tool(self.blender, name), *map(str, args)]
        subprocess.run(command, env=self.env, check=True, timeout=60, stdout=subprocess.DEVNULL)

    def move(self, x: float, y: float) -> None:
        self._run("xdotool", "mousemove", round(x), round(y))

    def click(self, x: float, y: float, button: int = 1, times: int = 1, keys: str = "") -> None:
        self.move(x, y)
        time.sleep(0.7)  # Blender takes note of the place before the button
        hold = ["keydown", keys] if keys else []
        free = ["keyup", keys] if keys else []
        self._run("xdotool", *hold, "click", "--repeat", times, "--delay", 80, button, *free)
        time.sleep(0.3)

    def drag(self, x0: float, y0: float, x1: float, y1: float, button: int = 1, steps: int = 10) -> None:
        self.move(x0, y0)
        time.sleep(0.7)
        self._run("xdotool", "mousedown", button)
        for i in range(1, steps + 1):
            time.sleep(0.1)
            self.move(x0 + (x1 - x0) * i / steps, y0 + (y1 - y0) * i / steps)
        time.sleep(0.2)
        self._run("xdotool", "mouseup", button)
        time.sleep(0.3)

    def key(self, *keys: str) -> None:
        """Key presses one after another, like key("ctrl+z", "Return")."""
        for k in keys:
            self._run("xdotool", "key", k)
            time.sleep(0.25)

    def type(self, text: str) -> None:
        self._run("xdotool", "type", "--delay", 25, text)
        time.sleep(0.3)

    # ------------------------------------------------------------ to find what Python cannot point at

    def under(self, x: float, y: float, keys: str = "ctrl+c") -> str:
        """What Blender copies when a person presses ctrl+C over a button: the Python of an operator. With
        "ctrl+shift+alt+c" the data path of a setting."""
        self.move(x, y)
        time.sleep(0.25)
        self._run("xdotool", "key", keys)
        time.sleep(0.1)
        return self.ask("bpy.context.window_manager.clipboard")

    def find(self, wanted: str, x: float, top: float, bottom: float, keys: str = "ctrl+c", step: int = 11) -> float:
        """The height of the first button of a column under which ctrl+C gives `wanted`."""
        y = top
        while y < bottom:
            if wanted in self.under(x, y, keys):
                return y + step / 2
            y += step
        self.picture(f"no {wanted}")
        raise AssertionError(f"nothing at x={x} between {top} and {bottom} is {wanted}")

    # ------------------------------------------------------------ what a person does often

    def menu(self, name: str, operator: str) -> None:
        """File > Import (or Export) > the entry that runs an operator."""
        self.click(58, 14)

    def choose(self, path: Path) -> None:
        """Fills in the file browser that stands open, folder and name, and presses its button."""
        self.wait_for("len(look()) > 1")
        time.sleep(1)
        top, bottom = self.region("FILE_BROWSER", "UI"), self.region("FILE_BROWSER", "EXECUTE")
        for region, text in ((top, f"{path.parent}/"), (bottom, path.name)):
            self.click(region["x"] + 0.35 * region["w"], region["y"] + region["h"] / 2, times=2)
            self.key("ctrl+a")
            self.type(text)
            self.key("Return")
            time.sleep(0.5)
        self.click(bottom["x"] + 0.9 * bottom["w"], bottom["y"] + bottom["h"] / 2)
        self.wait_for("len(look()) == 1")
