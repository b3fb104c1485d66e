# SPDX-License-Identifier: GPL-3.0-or-later
"""One way to go from posed images to a scene, as it is written on command lines and in tables:

[LABEL=]METHOD[@CHECKPOINT][:SECONDS][+refine:SECONDS][+quality:NAME][+steps:N][+budget:N|P%|auto][+dense]

guided                                      a method of `timesplat reconstruct`
4dgs:10                                     one that fits the scene, for ten seconds
tracks+quality:fine                         fitted as much as that means, however long it takes
4dgs+steps:2000                             fitted, or where the method does not fit refined, by so many steps
rgb+refine:4+budget:10%                     refined for four seconds, with a tenth of the Gaussians
mine=predicted@runs/mine/network.safetensors    other weights, under a name of its own
guided@small                                the shipped checkpoint guided-small
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ..datagen.sequence import InputError
from ..model import baselines  # noqa: F401 (they register themselves)
from ..model.checkpoints_io import CHECKPOINTS
from ..model.fitting.budget import SECONDS as BUDGET_SECONDS
from ..model.fitting.budget import parse_budget
from ..model.fitting.quality import QUALITIES
from ..model.methods import METHODS, ReconstructOptions, method_named
from .provenance import file_hash

FORM = "[LABEL=]METHOD[@CHECKPOINT][:SECONDS][+refine:SECONDS][+quality:NAME][+steps:N][+budget:N|P%|auto][+dense]"
STEP_SECONDS = 0.01  # that a step may take, roughly: for the order of runs, and what a quick one leaves out
_NUMBER = r"\d+(?:\.\d+)?"
_SPEC = re.compile(
    rf"(?:(?P<label>[^=+@:]+)=)?(?P<method>[^=+@:]+)(?:@(?P<weights>[^+]+?))?(?::(?P<seconds>{_NUMBER}))?(?P<options>\+.*)?"
)
_OPTION = re.compile(
    rf"(?:(refine):({_NUMBER})|(budget):({_NUMBER}%?|auto)|(quality):({'|'.join(QUALITIES)})|(steps):(\d+)|(dense))"
)


@dataclass(frozen=True)
class MethodSpec:
    """A method with all that decides what it makes of given views."""

    label: str  # how tables and figures call it
    method: str  # a name of METHODS
    checkpoint: Path | None = None  # weights in place of the method's own
    seconds: float | None = None  # of fitting, for methods that fit the scene
    refine: float | None = None  # seconds of test-time optimisation
    budget: str | None = None  # most Gaussians, a share of those predicted, or auto
    dense: bool = False  # a network's tokens everywhere, not only where the object is
    quality: str | None = None  # a name of QUALITIES, in place of seconds
    steps: int | None = None  # of fitting, or of refinement where the method does not fit; likewise

    @property
    def has_depth(self) -> bool:
        """Whether it sees depth and motion, not RGB and alpha alone."""
        return METHODS[self.method].has_depth

    @property
    def baseline(self) -> bool:
        """Whether it is what ours are compared with."""
        return METHODS[self.method].baseline

    @property
    def counted(self) -> int:
        """Steps of fitting, where it goes by them; else 0."""
        return self.steps or (QUALITIES[self.quality].steps if self.quality else 0)

    @property
    def fitted(self) -> bool:
        """Whether what the method makes is refined, or kept within a budget."""
        return bool(self.refine or self.budget or self.counted)

    @property
    def fit_seconds(self) -> float:
        """Seconds of fitting in all, without what the budget `auto` takes to find its number; roughly, where it goes by
        steps."""
        if self.counted:
            return STEP_SECONDS * self.counted
        return (self.seconds or 0.0) + (self.refine or (BUDGET_SECONDS if self.budget else 0.0))

    @property
    def weights(self) -> Path | None:
        """The checkpoint that it loads; None where it needs none."""
        shipped = METHODS[self.method].checkpoint
        return self.checkpoint or (CHECKPOINTS / f"{shipped}.safetensors" if shipped else None)

    @property
    def fingerprint(self) -> str:
        """Changes with all that has a say in the result but the code: the options, and the bytes of the weights."""
        options = (self.method, self.seconds, self.refine, self.budget, self.dense)
        counted = (self.quality, self.steps) if self.counted else ()  # rows of before know no such options
        return " ".join(map(str, (*options, file_hash(self.weights) if self.weights else "-", *counted)))


def parse_spec(text: str, seconds: float | None = None, checkpoint: Path | None = None) -> MethodSpec:
    """A spec; `seconds` for a method that fits the scene where the text names none, `checkpoint` likewise. Raises
    InputError that names what is unknown, and what there is."""
    match = _SPEC.fullmatch(text.strip())
    if not match:
        raise InputError(f"{text.strip() or 'a method'}: write {FORM}, for example rgb+refine:4.")
    label, method, weights, own, options = match.groups()
    fits = method_named(method).fits
    if own and not fits:
        fitting = " and ".join(m.name for m in METHODS.values() if m.fits)
        raise InputError(f"{text}: {fitting}, and they alone, take seconds; write for example 4dgs:10.")
    found: dict = {}
    for part in (options or "").split("+")[1:]:
        option = _OPTION.fullmatch(part)
        name, value = [x for x in (*option.groups(), True) if x][:2] if option else (part, None)
        if value is None or name in found:
            raise InputError(f"{text}: {part} is no option here, or given twice; write {FORM}.")
        found[name] = value
    if found.get("budget"):
        parse_budget(found["budget"])
    steps, counted = int(found["steps"]) if "steps" in found else None, [k for k in ("quality", "steps") if k in found]
    if own and counted:
        raise InputError(f"{text}: seconds and {counted[0]}: each says how long a fit goes on; give one of them.")
    ReconstructOptions(refine=float(found.get("refine", 0)), quality=found.get("quality"), steps=steps)  # refuses both
    if not fits or counted:
        seconds = None
    elif own:
        seconds = float(own)
    chosen = _checkpoint(text, method, weights) if weights else checkpoint
    return MethodSpec(
        label=label or text.strip(),
        method=method,
        checkpoint=chosen,
        seconds=seconds,
        refine=float(found["refine"]) if "refine" in found else None,
        budget=found.get("budget"),
        dense="dense" in found,
        quality=found.get("quality"),
        steps=steps,
    )


def parse_specs(text: str, seconds: float | None = None, checkpoint: Path | None = None) -> list[MethodSpec]:
    """Comma-separated specs. Raises InputError where there is none, or two have one label."""
    found = [parse_spec(x, seconds, checkpoint) for x in text.split(",") if x.strip()]
    if not found or len({m.label for m in found}) < len(found):
        raise InputError(f"{text or 'methods'}: name at least one, and each once (LABEL=METHOD tells two alike apart).")
    return found


def _checkpoint(text: str, method: str, weights: str) -> Path:
    """The file named, or the shipped checkpoint METHOD-weights."""
    shipped = CHECKPOINTS / f"{METHODS[method].checkpoint or method}-{weights}.safetensors"
    for path in (Path(weights), shipped):
        if path.is_file():
            return path
    raise InputError(f"{text}: there is no checkpoint {weights}; name a file, or train one with `timesplat train`.")
