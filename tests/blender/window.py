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
PATIENCE = 300  # seconds that Blender has for an answer, of which it needs a tenth of one on a machine of its own
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
def clipboard():  # and emptied, so that what is copied next is new
    said, bpy.context.window_manager.clipboard = bpy.context.window_manager.clipboard, ""
    return said
def reports():  # what Blender has said, as its Info editor lists it: one is opened for as long
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "OUTLINER")
    area.type = "INFO"
    try:
        with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
            bpy.ops.info.select_all(action="SELECT")
            bpy.ops.info.report_copy()
    finally:
        area.type = "OUTLINER"
    return clipboard()
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
drawn = []  # something, once the 3D view has been drawn
bpy.types.SpaceView3D.draw_handler_add(lambda: drawn or drawn.append(True), (), "WINDOW", "POST_PIXEL")
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
            self.wait_for("drawn")  # the first time shaders are compiled, which takes minutes on a busy machine
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

    def ask(self, question: str, timeout: float = PATIENCE):
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

    def wait_for(self, question: str, timeout: float = PATIENCE):
        """Asks until the answer is true; returns it."""
        end, said = time.monotonic() + timeout, None
        while time.monotonic() < end:
            with contextlib.suppress(AssertionError):
                said = self.ask(question, min(timeout, 60))
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

    def settle(self) -> None:
        """Waits until Blender has dealt with what it was sent, however busy the machine is: it takes events in before
        it answers, and deals with them before it answers again."""
        with contextlib.suppress(AssertionError):  # it may have been told to quit
            self.ask("None")
            self.ask("None")

    def _run(self, name: str, *args) -> None:
        command = [tool(self.blender, name), *map(str, args)]
        subprocess.run(command, env=self.env, check=True, timeout=60, stdout=subprocess.DEVNULL)

    def move(self, x: float, y: float) -> None:
        self.place = x, y
        self._run("xdotool", "mousemove", round(x), round(y))

    def click(self, x: float, y: float, button: int = 1, times: int = 1, keys: str = "") -> None:
        self.move(x, y)
        time.sleep(0.7)  # Blender takes note of the place before the button
        hold = ["keydown", keys] if keys else []
        free = ["keyup", keys] if keys else []
        self._run("xdotool", *hold, "click", "--repeat", times, "--delay", 80, button, *free)
        time.sleep(0.3)
        self.settle()

    def drag(self, x0: float, y0: float, x1: float, y1: float, button: int = 1, steps: int = 10) -> None:
        self.move(x0, y0)
        time.sleep(0.7)
        self._run("xdotool", "mousedown", button)
        for i in range(1, steps + 1):
            time.sleep(0.1)
            self.move(x0 + (x1 - x0) * i / steps, y0 + (y1 - y0) * i / steps)
            self.settle()
        time.sleep(0.2)
        self._run("xdotool", "mouseup", button)
        time.sleep(0.3)
        self.settle()

    def wheel(self, steps: int) -> None:
        """Turns the wheel where the mouse is: up, or down where `steps` is negative."""
        for _ in range(abs(steps)):
            self._run("xdotool", "click", 4 if steps > 0 else 5)
            time.sleep(0.1)
        time.sleep(0.3)
        self.settle()

    def key(self, *keys: str) -> None:
        """Key presses one after another, like key("ctrl+z", "Return")."""
        for k in keys:
            self._run("xdotool", "key", k)
            time.sleep(0.25)
            self.settle()

    def focus(self) -> None:
        """Gives the keyboard to the main window: a window manager, of which there is none here, would."""
        self._run("xdotool", "search", "--name", "Blender [0-9]", "windowfocus")
        time.sleep(0.5)

    def put_away(self, title: str) -> None:
        """Takes the window of this title off the screen, as minimising does."""
        self._run("xdotool", "search", "--name", f"^{title}$", "windowunmap")
        time.sleep(0.5)
        self.focus()

    def type(self, text: str) -> None:
        self._run("xdotool", "type", "--delay", 25, text)
        time.sleep(0.3)
        self.settle()

    # ------------------------------------------------------------ to find what Python cannot point at

    def under(self, x: float, y: float, keys: str = "ctrl+c") -> str:
        """What Blender copies when a person presses ctrl+C over a button: the Python of an operator, the value of
        a setting; with "ctrl+shift+c" a setting's name."""
        self.move(x, y)
        self.settle()
        self.ask("clipboard()")
        self._run("xdotool", "key", keys)
        self.settle()
        return self.ask("clipboard()")

    def find(self, wanted: str, x: float, top: float, bottom: float, keys: str = "ctrl+c", step: int = 10) -> float:
        """The height of the first button of a column over which `keys` copies something with `wanted` in it."""
        y = top
        while y < bottom:
            if wanted in self.under(x, y, keys):
                return y + step / 2
            y += step
        self.picture(f"no {wanted}")
        raise AssertionError(f"nothing at x={x} between {top} and {bottom} is {wanted}: {self.pictures}")

    # ------------------------------------------------------------ what a person does often

    def menu(self, entry: str, operator: str) -> None:
        """File > Import or Export > the entry that runs an operator."""
        self.click(58, 14)
        y = {"Import": 311, "Export": 332}[entry]
        self.click(75, y)
        self.click(330, self.find(operator, 330, y - 20, HEIGHT - 30))

    def preferences(self, python: str) -> None:
        """Edit > Preferences > Add-ons > Timesplat: names the Python that has torch, and leaves."""
        self.move(500, 450)  # the window opens around the mouse
        time.sleep(0.7)
        self.key("ctrl+comma")
        self.wait_for("any(a['kind'] == 'PREFERENCES' for w in look() for a in w['areas'])")
        time.sleep(1)
        area = self.area("PREFERENCES")
        left = next(r for r in area["regions"] if r["kind"] in ("UI", "NAVIGATION_BAR"))
        for y in range(110, 330, 12):
            self.click(left["x"] + 80, left["y"] + y)
            if self.ask("bpy.context.preferences.active_section") == "ADDONS":
                break
        page = self.region("PREFERENCES", "WINDOW")
        self.click(page["x"] + 0.25 * page["w"], page["y"] + 20)
        self.type("Timesplat")
        self.key("Return")
        self.click(page["x"] + 14, page["y"] + 57)  # unfolds it
        self.picture("preferences")
        self.click(page["x"] + 0.6 * page["w"], page["y"] + 272)  # its first field
        self.key("ctrl+a")
        self.type(python)
        self.key("Return")
        self.picture("preferences filled in")
        self.put_away("Preferences")

    def sidebar(self) -> dict:
        """Opens the sidebar of the 3D viewport at our tab; returns its region."""
        area = self.area("VIEW_3D")
        self.move(area["x"] + area["w"] / 3, area["y"] + area["h"] * 0.8)
        if self.ask("tab()") is None:
            time.sleep(0.7)
            self.key("n")
            self.wait_for("tab()")
        region = self.region("VIEW_3D", "UI")
        for y in range(400, 100, -25):
            if self.ask("tab()") == "Timesplat":
                break
            self.click(region["x"] + region["w"] - 14, y)
        assert self.ask("tab()") == "Timesplat"
        return region

    def press(self, operator: str, across: float = 0.5, top: float = 100) -> None:
        """Clicks the sidebar's button that runs an operator, `across` the sidebar (0 left, 1 right)."""
        region = self.region("VIEW_3D", "UI")
        x = region["x"] + across * (region["w"] - 28)
        self.click(x, self.find(operator, x, max(top, region["y"]), region["y"] + region["h"]))

    def fill(self, setting: str, text: str, across: float = 0.75, top: float = 100) -> None:
        """Types a value into the sidebar's field of a setting."""
        region = self.region("VIEW_3D", "UI")
        x = region["x"] + across * (region["w"] - 28)
        self.find(setting, x, max(top, region["y"]), region["y"] + region["h"], "ctrl+shift+c")
        self.key("Return", "ctrl+a")
        self.type(text)
        self.key("Return")

    def choose(self, path: Path) -> None:
        """Fills in the file browser that stands open, folder and name, and presses its button."""
        browser = "any(a['kind'] == 'FILE_BROWSER' for w in look() for a in w['areas'])"
        self.wait_for(browser)
        time.sleep(1)
        top, bottom = self.region("FILE_BROWSER", "UI"), self.region("FILE_BROWSER", "EXECUTE")
        for region, text in ((top, f"{path.parent}/"), (bottom, path.name)):
            self.click(region["x"] + 0.35 * region["w"], region["y"] + region["h"] / 2, times=2)
            self.key("ctrl+a")
            self.type(text)
            self.key("Return")
            time.sleep(0.5)
        self.click(bottom["x"] + 0.9 * bottom["w"], bottom["y"] + bottom["h"] / 2)
        self.wait_for("not " + browser)
        self.focus()
