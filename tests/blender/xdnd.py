# SPDX-License-Identifier: GPL-3.0-or-later
"""A drag source on an X11 screen: files that a person lets go over a window, as a file manager hands them over.

It speaks XDND (freedesktop.org, "Drag-and-Drop Protocol for the X Window System") and offers text/uri-list."""

import time
from pathlib import Path

from Xlib import X, Xatom, display
from Xlib.protocol import event


def _aware(window, atom):
    """The first window, from the top of the pile, that takes drops; None without one."""
    if window.get_full_property(atom("XdndAware"), Xatom.ATOM):
        return window
    return next((w for child in reversed(window.query_tree().children) if (w := _aware(child, atom))), None)


def drop(screen: str, x: int, y: int, paths: list[Path], timeout: float = 20) -> None:
    """Drags the files to a place (pixels from the top left) of the screen (like ":99") and lets go there. The mouse
    should be there already. Raises AssertionError where no window takes drops, or it does not answer in time."""
    d = display.Display(screen)
    try:
        atom, root = d.intern_atom, d.screen().root
        target = _aware(root, atom)
        assert target, "no window takes drops"
        source = root.create_window(0, 0, 1, 1, 0, X.CopyFromParent)
        source.set_selection_owner(atom("XdndSelection"), X.CurrentTime)
        text = "".join(f"{p.as_uri()}\r\n" for p in paths).encode()

        def say(kind: str, *data: int) -> None:
            words = (source.id, *data, *[0] * (4 - len(data)))
            message = event.ClientMessage(window=target, client_type=atom(kind), data=(32, words))
            target.send_event(message)
            d.flush()

        def hear(kind: str) -> tuple:
            """Waits for an answer; meanwhile hands the list of files to whoever asks for it."""
            end = time.monotonic() + timeout
            while time.monotonic() < end:
                if not d.pending_events():
                    time.sleep(0.02)
                    continue
                e = d.next_event()
                if e.type == X.SelectionRequest:
                    e.requestor.change_property(e.property, e.target, 8, text)
                    answer = event.SelectionNotify(
                        time=e.time, requestor=e.requestor, selection=e.selection, target=e.target, property=e.property
                    )
                    e.requestor.send_event(answer)
                elif e.type == X.ClientMessage and e.client_type == atom(kind):
                    return e.data[1]
            raise AssertionError(f"no {kind} in {timeout} s")

        say("XdndEnter", 3 << 24, atom("text/uri-list"))
        for _ in range(3):  # as a mouse that moves does
            say("XdndPosition", 0, x << 16 | y, X.CurrentTime, atom("XdndActionCopy"))
            assert hear("XdndStatus")[1] & 1, "the window refuses what is dragged over it"
        say("XdndDrop", 0, X.CurrentTime)
        hear("XdndFinished")
    finally:
        d.close()
