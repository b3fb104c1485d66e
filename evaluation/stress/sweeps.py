# SPDX-License-Identifier: GPL-3.0-or-later
"""The sweeps of `timesplat stress`: each is a name, a unit, levels from easy to hard, and what a level does. A new one
is one entry of SWEEPS."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

from ...datagen.sequence import InputError
from . import disturb
from .disturb import Disturbance

CALM = ("calm", 0.0)  # trial and level that inputs are disturbed of


@dataclass(frozen=True)
class Condition:
    """What one reconstruction is made of. Conditions of different sweeps that are the same are measured once."""

    trial: str = "calm"
    trial_level: float = 0.0
    disturbance: str = ""  # name of a sweep that disturbs inputs; none: as they were rendered
    level: float = 0.0
    size: int = 96  # pixels
    all_views: bool = False  # 96 of them, not 48
    seed: int = 0  # of the fit
    threads: int = 1

    @property
    def key(self) -> str:
        """A name for files, the same wherever it is made."""
        return hashlib.sha256(json.dumps(asdict(self)).encode()).hexdigest()[:16]

    @property
    def folder(self) -> str:
        """What the recipe calls it: "speed_0.5", "turned_2"."""
        name, level = (self.disturbance, self.level) if self.disturbance else (self.trial, self.trial_level)
        more = f"_{self.size}px" if self.size != Condition.size else ""
        return f"{name}_{level:g}{more}"


@dataclass(frozen=True)
class Sweep:
    """A difficulty."""

    name: str
    about: str  # what is hard, as a title
    unit: str  # of the levels
    levels: tuple[float, ...]  # from easy to hard
    quick: tuple[float, ...] = ()  # those of --quick; none: it leaves the sweep out
    disturb: Disturbance | None = None  # of the inputs; None: the trial of this name is rendered at each level
    all_views: bool = False  # inputs are chosen of 96, not of 48
    repeats: bool = False  # levels are no difficulty: they must make no difference

    def conditions(self, quick: bool, size: int) -> dict[float, Condition]:
        """{level: what is reconstructed}."""
        return {x: self._condition(float(x), size) for x in (self.quick if quick else self.levels)}

    def _condition(self, level: float, size: int) -> Condition:
        if self.name == "size":
            return Condition(size=round(level))
        if self.name == "seed":
            return Condition(size=size, seed=round(level))
        if self.name == "threads":
            return Condition(size=size, threads=round(level))
        if self.disturb is None:
            return Condition(self.name, level, size=size)
        calm = level == 0 and not self.all_views
        return Condition(*CALM, "" if calm else self.name, level, size, self.all_views)


SWEEPS = {
    s.name: s
    for s in (
        Sweep("speed", "fast motion", "radii a moment", (0.0, 0.25, 0.5, 1.0, 2.0), (0.0, 0.5, 2.0)),
        Sweep("bend", "bent paths at 0.6 radii a moment", "degrees a moment", (0, 15, 30, 60, 120), (0, 60)),
        Sweep("jumps", "jumps", "in the clip", (0, 1, 2, 5, 10)),
        Sweep("spin", "spin", "degrees a moment", (0, 5, 15, 30, 60), (0, 15, 60)),
        Sweep("appear", "things appear and vanish", "of eight", (0, 1, 2, 4, 8), (0, 8)),
        Sweep("contact", "two things cross", "diameters within one another", (-0.5, 0, 0.25, 0.5, 1.0)),
        Sweep("thin", "thin rods", "% of the object", (8, 4, 2, 1, 0.5), (8, 1)),
        Sweep("plain", "no texture", "of the contrast lost", (0, 0.5, 0.8, 0.95, 1.0)),
        Sweep("repeated", "repeated texture", "squares", (4, 8, 16, 32)),
        Sweep("gloss", "glossy surfaces", "from matt to a mirror", (0, 0.25, 0.5, 0.75, 1.0)),
        Sweep("glass", "transparent surfaces", "of the light goes through", (0, 0.25, 0.5, 0.75, 0.9)),
        Sweep("aside", "off centre", "of what cameras see whole", (0, 0.25, 0.5, 0.75, 1.0)),
        Sweep("size", "small pictures", "pixels", (128, 96, 64, 32)),
        Sweep("turned", "cameras turned", "degrees", (0, 0.25, 0.5, 1, 2, 4), (0, 0.5, 2), disturb.turned),
        Sweep("misplaced", "cameras elsewhere", "% of the distance", (0, 0.5, 1, 2, 4), (), disturb.misplaced),
        Sweep("zoomed", "wrong field of view", "% of the focal length", (0, 1, 2, 5, 10), (0, 5), disturb.zoomed),
        Sweep("mistimed", "wrong times", "moments", (0, 0.25, 0.5, 1, 2), (0, 1), disturb.mistimed),
        Sweep("late", "one camera is late", "moments", (0, 0.5, 1, 2, 4), (), disturb.late),
        Sweep("exposed", "exposures differ", "stops", (0, 0.1, 0.25, 0.5, 1), (0, 0.5), disturb.exposed),
        Sweep("tinted", "white balance differs", "%", (0, 2, 5, 10, 20), (), disturb.tinted),
        Sweep("noisy", "noise", "σ of 255", (0, 5, 10, 25, 50), (0, 25), disturb.noisy),
        Sweep("jpeg", "JPEG", "below quality 100", (0, 10, 25, 50, 75, 90), (), disturb.jpeg),
        Sweep("grown", "masks too large", "pixels", (0, 1, 2, 3, 5), (0, 2), disturb.grown),
        Sweep("shrunk", "masks too small", "pixels", (0, -1, -2, -3, -5), (), disturb.grown),
        Sweep("holed", "masks with holes", "% missing", (0, 5, 10, 25, 50), (0, 25), disturb.holed),
        Sweep("unmasked", "grey background shows", "opacity", (0, 0.05, 0.1, 0.25, 0.5, 1.0), (), disturb.unmasked),
        Sweep("missing", "missing moments", "%", (0, 25, 50, 75), (0, 50), disturb.missing),
        Sweep("few", "few inputs", "views", (96, 48, 24, 12, 6, 2), (96, 24, 6), disturb.few, all_views=True),
        Sweep("one_sided", "cameras on one side", "degrees unseen to each side", (0, 45, 90, 135), (),
              disturb.one_sided, all_views=True),
        Sweep("seed", "another seed", "seed", (0, 1, 2, 3, 4), repeats=True),
        Sweep("shuffled", "another order of the inputs", "order", (0, 1, 2, 3, 4), (), disturb.shuffled, repeats=True),
        Sweep("hair", "cameras moved by .01 pixel", "draw", (0, 1, 2, 3, 4), (), disturb.hair, repeats=True),
        Sweep("threads", "threads", "threads", (1, 2), repeats=True),
    )
}  # fmt: skip


def sweeps_named(text: str | None, quick: bool) -> list[Sweep]:
    """Of comma-separated names, or all of them (of --quick). Raises InputError."""
    if not text:
        return [s for s in SWEEPS.values() if s.quick or not quick]
    names = list(dict.fromkeys(n.strip() for n in text.split(",") if n.strip()))
    for name in names:
        if name not in SWEEPS:
            raise InputError(f"--sweeps {name}: there is no such sweep; choose of {', '.join(SWEEPS)}.")
        if quick and not SWEEPS[name].quick:
            raise InputError(f"--sweeps {name}: --quick has no levels of it; drop --quick.")
    if not names:
        raise InputError(f"--sweeps {text}: name at least one of {', '.join(SWEEPS)}.")
    return [SWEEPS[n] for n in names]
