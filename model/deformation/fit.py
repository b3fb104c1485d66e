# SPDX-License-Identifier: GPL-3.0-or-later
"""The method `deform`: photographs at times in, tracks out. One cloud of Gaussians at rest, whose looks all views
share, moved by control points (SC-GS, Huang et al. 2024), and both fitted to the photographs, with nothing else known.

Where things move fast, what a view shows is far from where it was in the views that are known, and no gradient leads
there. So a fit begins in the middle of the clip and goes on to its ends, each moment from where those before it lead;
motion is a table of several levels (`motion_table.py`), smooth in time until all of the clip is looked at, then
sharper and with places chosen anew, among what has been found, which what comes and goes joins (`appearing.py`);
pictures are small at first; and neighbours are held together less and less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..fitting.budget import parse_budget
from ..fitting.densify import OUTSIDE, Densifier, Pace
from ..fitting.fit_views import detached, downsampled, reduction
from ..fitting.loop import Pyramid, Schedule, Step, draw, gradients, optimise, photometric_loss, warm_up
from ..fitting.parameters import Parameters
from ..fitting.quality import Quality
from ..fitting.refine import part
from ..geometry.silhouettes import points_inside
from ..geometry.surroundings import EDGE, is_whole, points_around
from ..tracks import Tracks4D
from ..views import Views
from .appearing import EVER, lives, missing_points, unshown
from .cloud import SEEN, ControlPoints, DeformingCloud
from .motion_table import SEVERAL, SHARP, MotionTable
from .thin import thinned

LEAST = 8  # Gaussians that a fit begins with, whatever the budget
TOLERANCE = 0.1  # of a pixel, within twice which tracks go as the cloud does
PER_PIXEL = 2, 4  # Gaussians at the most, where no number is asked for, for each pixel that shows the object in a view,
# and in a long fit to many views, of which there is one more for each …
STEPS_MORE, VIEWS_MORE = 2000, 36  # … so many steps and so many views
MAX_GAUSSIANS = 100_000
SCENE_START = 10_000  # Gaussians at the start of a whole scene


@dataclass(frozen=True)
class DeformFit:
    """How a cloud and its motion are fitted; rates of Adam at the start and at the end, those of places in pixels."""

    xyz: tuple[float, float] = (0.5, 0.02)
    scale: tuple[float, float] = (3e-2, 8e-3)
    rotation: tuple[float, float] = (2e-2, 4e-3)
    rgb: tuple[float, float] = (2e-2, 2e-3)
    opacity: tuple[float, float] = (5e-2, 1e-2)
    motion: tuple[float, float] = (0.08, 0.0036)  # in steps of a frame in model time: the more frames, the slower
    start: int = 1000  # Gaussians at the start
    first_views: int = 8  # nearest to the middle of the clip, or all of one moment, which say where these are
    start_opacity: float = 0.1
    later_opacity: float = 0.5  # of what joins later, where something is missing; …
    later_share: float = 0.25  # … of each moment no more than this share of those that there may be
    window: float = 0.4  # share of the schedule after which all of the clip is looked at
    front: float = 0.5  # of the views until then are of the moments that came in last
    margin: float = 2.5  # frames about the middle at the start, and of what counts as last
    ssim_weight: float = 0.2
    bending: tuple[float, float] = (0.02, 0.001)  # weight in the loss, at the start and at the end
    opacity_weight: tuple[float, float] = (0.005, 5e-5)  # of mean opacity, likewise
    bind_every: int = 20  # steps after which what is near what is asked anew …
    place_every: int = 100  # … and after which control points are chosen anew


FIT = DeformFit()
ALONE = replace(FIT, motion=(0.05, 0.0036), bending=(0.05, 0.01))  # where a time is seen by fewer than SEVERAL views
SMALLEST = 128  # pixels of the longest side, from which pictures grow to what they are
SPEEDS = 0.5, 1.0  # of those that motion has at a moment, at which it may go on to the next
SHARES = {1: (0.6,), 2: (0.6, 0.85), 3: (0.5, 0.8, 0.93)}  # of the schedule after which they do, by how often


def pyramid_of(longest: int) -> Pyramid:
    """Sizes of pictures whose longest side has so many pixels in the end: each half of the next, once at least."""
    halvings = min(max(math.ceil(math.log2(longest / SMALLEST)), 1), max(SHARES))
    return tuple((until, -(-longest // 2 ** (halvings - i))) for i, until in enumerate(SHARES[halvings]))


@dataclass(frozen=True)
class _Stage:
    """The part of a schedule in which pictures have one size."""

    until: float  # share of the schedule
    gaussians: int  # that there are at its end
    pace: Pace  # by which there come to be so many


def _stages(pyramid: Pyramid, views: Views, most: int, worthwhile: int) -> list[_Stage]:
    """worthwhile: Gaussians that are worth having with whole pictures; with smaller ones there are fewer."""
    stages, since = [], 0.0
    for until, size in (*pyramid, (1.0, max(views.size))):
        here = round(worthwhile / reduction(views, size) ** 2)
        grow = Pace(25, since, (since + until) / 2, None) if stages else Pace(50, 0.1, 0.83 * until, None)
        stages.append(_Stage(until, max(min(here, most), LEAST), grow))
        since = until
    return stages


class _Fit:
    """The state of a fit, and what its steps ask for."""

    def __init__(self, views: Views, limit: int, seed: int, share: float = 1.0):
        """limit: Gaussians that there may be at the most; share: of those that there would be."""
        self.several = len(views) >= SEVERAL * len(views.time.unique())
        fit = self.fit = FIT if self.several else ALONE
        self.views, self.pixel, self.seed = views, views.pixel, seed
        self.pyramid = pyramid_of(max(views.size))
        smaller = self.smaller = reduction(views, self.pyramid[0][1])
        self.limit, self.share = limit, share
        self._expect(0)
        self.generator = torch.Generator().manual_seed(seed)
        order = views.time.abs().argsort(stable=True)
        at_once = int((views.time == views.time[order[0]]).sum())
        middle = views[order[: max(fit.first_views, at_once)]]
        self.whole = is_whole(views)
        points, most = (points_around, SCENE_START) if self.whole else (points_inside, fit.start)
        xyz, rgb = points(middle, min(most, self.stage.gaussians), self.generator)
        self.table = MotionTable.around(xyz, round(2 / views.frame_step) + 1, self.several, self.generator)
        rates = {k: getattr(fit, k) for k in ("scale", "rotation", "rgb", "opacity")}
        rates["life"] = 0.0, 0.0  # it stays as silhouettes say
        first, last = fit.xyz
        rates["xyz"] = first * self.pixel * smaller, last * self.pixel
        moves = float(views.time.max() - views.time.min()) > 0
        rates["motion"] = tuple(moves * views.frame_step * r for r in fit.motion)
        values = self._start(xyz, rgb, fit.start_opacity) | {"motion": self.table.zeros()}
        self.parameters = Parameters(values, rates, common=["motion"], settling=["xyz", "motion"])
        self.densifier = self._densifier()
        self.half = self._half(0.0)  # how far from the middle the fit has come, and moments beyond it
        self.beyond = int((self.table.moments > self.half).sum()) + 1
        self._place()
        self._bind()

    def _start(self, xyz: Tensor, rgb: Tensor, opacity: float) -> dict[str, Tensor]:
        n = len(xyz)
        parts = xyz.split(4096)
        apart = torch.cat([torch.cdist(p, xyz).topk(min(4, n), largest=False).values[:, 1:].mean(1) for p in parts])
        return {
            "xyz": xyz,
            "scale": apart.clamp(0.3 * self.pixel, 0.1).log()[:, None].expand(-1, 3),
            "rotation": torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
            "rgb": rgb,
            "opacity": torch.full((n,), opacity).logit(),
            "life": torch.tensor([-EVER, EVER]).expand(n, 2),
        }

    @torch.no_grad()
    def _found(self) -> Tensor:
        """(N,3) where something is seen to be."""
        seen, points = self.parameters["opacity"].sigmoid() > SEEN, self.parameters["xyz"].detach()
        return points[seen] if seen.sum() > 1 else points

    def _place(self) -> None:
        self.control = ControlPoints.among(self._found(), self.table, self.generator)

    def _half(self, fraction: float) -> float:
        """How far from the middle of the clip the fit has come, in model time."""
        return max(self.fit.margin * self.views.frame_step, fraction / self.fit.window) + 1e-6

    @torch.no_grad()
    def _carry_on(self, fraction: float) -> None:
        """Each time that the fit comes to a further moment at either end: motion beyond it stays as it is, or goes on
        as before at one of SPEEDS, whichever is most like the views there. What moves fast is then near where it will
        be looked for. Where SEVERAL views show a moment nothing is gained by it."""
        half, table = self._half(fraction), self.table
        beyond = int((table.moments > half).sum()) + 1
        if beyond >= self.beyond or len(table.moments) < 2 * beyond + 3:
            return
        time, values = self.views.time, self.parameters["motion"].detach()
        for back, away in ((False, time), (True, -time)):
            new = ((away > self.half) & (away <= half)).nonzero()[:, 0]
            if len(new):
                views, before = downsampled(self.views[new], self.smaller), values.clone()
                best = self._error(views), before
                for speed in SPEEDS:
                    values.copy_(before)
                    table.carry_on(values, beyond, back, speed)
                    best = min(best, (self._error(views), values.clone()), key=lambda x: x[0])
                values.copy_(best[1])
        self.half, self.beyond = half, beyond

    def _error(self, views: Views) -> float:
        """How far the cloud as it is now is from the views, over grey."""
        grey = torch.full((3,), 0.5)
        return float(photometric_loss(draw(self.cloud(), views, grey, 0.0)))

    @torch.no_grad()
    def _join(self) -> None:
        """What has no Gaussians, for it is not there in the middle of the clip, gets some, a life with them; from the
        middle to the ends, so that what is found at a moment is not missing at the next."""
        views, fit = downsampled(self.views, self.smaller), self.fit
        generator = torch.Generator().manual_seed(self.seed)  # of its own: where nothing joins, all is as without
        left = unshown(self.cloud(), views)
        for t in sorted(views.time.unique().tolist(), key=abs):
            xyz, rgb = missing_points(left, t, fit.first_views, generator)
            room = max(int(fit.later_share * self.stage.gaussians), LEAST)
            room = min(room, self.stages[-1].gaussians - len(self.near))
            if min(len(xyz), room) < LEAST:
                continue
            cloud = self.cloud()
            new = self._start(cloud.at_rest(xyz[:room], t), rgb[:room], fit.later_opacity)
            new["life"] = lives(cloud, new["xyz"], views, t)
            self.parameters.add_rows(new)
            self._bind()
            self.densifier = self._densifier()
            left = unshown(self.cloud(), views)

    def _sharpen(self) -> None:
        """Once all of the clip is looked at: what comes and goes joins, moments count over a shorter time, and places,
        which were among what the silhouettes left possible, are now among what has been found."""
        if not self.whole:
            self._join()
        values = self.parameters["motion"].detach()
        self.table.sharpen(values, SHARP[self.several])
        self.table, values = self.table.among(values, self._found(), self.generator)
        self.parameters.replace("motion", values)
        self._place()
        self._bind()

    @torch.no_grad()
    def _bind(self) -> None:
        self.near, self.weight = self.control.influence(self.parameters["xyz"].detach())

    def _at(self, fraction: float) -> _Stage:
        return next((stage for stage in self.stages if fraction < stage.until), self.stages[-1])

    def _densifier(self) -> Densifier:
        return Densifier(
            self.parameters, self.generator, self.stage.gaussians, self.stage.pace, EDGE if self.whole else OUTSIDE
        )

    def planned(self, steps: int) -> bool:
        """Has there be as many Gaussians as so many steps are enough for; -> whether these are others than before."""
        before = self.stages
        self._expect(steps)
        self.densifier = self._densifier()
        return self.stages != before

    def _expect(self, steps: int) -> None:
        worthwhile = worth(self.views, steps)
        self.most = max(round(self.share * min(self.limit, worthwhile)), 1)
        self.stages = _stages(self.pyramid, self.views, self.most, worthwhile)
        self.stage = self.stages[0]

    def cloud(self) -> DeformingCloud:
        return DeformingCloud(self.parameters.values, self.table, self.control, self.near, self.weight, self.whole)

    def grown(self, fraction: float) -> DeformingCloud:
        """A cloud of as many Gaussians as there will be at about this share of the schedule, by which it is planned."""
        count, n = self._at(fraction).gaussians, len(self.near)
        rows = torch.arange(max(count, n)) % n
        values = {k: v if k == "motion" else v[rows] for k, v in self.parameters.values.items()}
        values["scale"] = values["scale"] - 0.5 * math.log(len(rows) / n)
        return DeformingCloud(values, self.table, self.control, self.near[rows], self.weight[rows], self.whole)

    def choose(self, fraction: float, count: int) -> list[int] | None:
        """Views of the moments that the fit has come to, half of them of those that came last; later all in turn."""
        f, views = self.fit, self.views
        if fraction >= f.window:
            return None
        far, half = views.time.abs(), self._half(fraction)
        known = (far <= half).nonzero()[:, 0]
        if not len(known):
            return None
        last = known[far[known] > half - f.margin * views.frame_step]
        chosen = []
        for _ in range(count):
            old = float(torch.rand((), generator=self.generator)) > f.front or not len(last)
            among = known if old else last
            chosen.append(int(among[torch.randint(len(among), (), generator=self.generator)]))
        return chosen

    def loss(self, step: Step) -> Tensor:
        f, cloud = self.fit, step.scene
        bending = sum(cloud.control.bending(*pose) for pose in cloud.poses.values())
        a, b = (first * (last / first) ** step.fraction for first, last in (f.opacity_weight, f.bending))
        return photometric_loss(step, f.ssim_weight) + a * cloud.opacity.mean() + b * bending

    def after_backward(self, number: int, fraction: float) -> None:
        if fraction < self.fit.window:
            if not self.several:
                self._carry_on(fraction)
        elif self.table.width > SHARP[self.several]:
            self._sharpen()
        if self._at(fraction) is not self.stage:
            self.stage = self._at(fraction)
            self.densifier = self._densifier()
        densified = self.densifier.after_backward(number, fraction)
        if number % self.fit.place_every == 0:
            self._place()
        if densified or number % self.fit.bind_every == 0:
            self._bind()


def worth(views: Views, steps: int = 0) -> int:
    """How many Gaussians the pictures are worth in so many steps, by the pixels that show the object in one of them;
    LEAST or more."""
    least, most = PER_PIXEL
    per_pixel = min(max(min(steps / STEPS_MORE, len(views) / VIEWS_MORE), least), most)
    return max(round(per_pixel * float(views.alpha.sum((1, 2)).mean())), LEAST)


def reconstruct_deform(
    views: Views,
    seconds: float = 10.0,
    *,
    steps: int | None = None,
    quality: Quality | None = None,
    budget: str | None = None,
    max_loss: float = 0.1,
    seed: int = 0,
    progress=None,
) -> Tracks4D:
    """Views (RGB and alpha alone are used) -> tracks (N,), after about `seconds`, or exactly `steps`, or those of
    `quality`, and no more than these, than the budget and than PER_PIXEL say. budget: "N", "P%" of the most that
    there would be without, or "auto" for as few as lose no more than `max_loss` dB (`thin.py`). For `progress` see
    `optimise`."""
    if quality:
        steps = quality.steps
    wanted = parse_budget(budget) if budget else None
    fewest = bool(budget) and wanted is None
    limit = wanted if isinstance(wanted, int) else quality.gaussians if quality else MAX_GAUSSIANS
    with gradients():
        views = detached(views)
        warm_up("cpu")
        state = _Fit(views, limit, seed, wanted if isinstance(wanted, float) else 1.0)
        schedule = Schedule(seconds=seconds, steps=steps, pyramid=state.pyramid, seed=seed)
        optimise(
            state.parameters,
            state.cloud,
            views,
            state.loss,
            schedule,
            choose=state.choose,
            grown=state.grown,
            planned=state.planned,
            after_backward=state.after_backward,
            generator=state.generator,
            text="fitting motion and looks",
            progress=part(progress, 0, 0.6 if fewest else 1),
        )
        state._bind()
        frames = round(2 / views.frame_step) + 1
        tracks = state.cloud().to_tracks(frames, TOLERANCE * state.pixel)
        if fewest:
            return thinned(tracks, views, max_loss, part(progress, 0.6, 1))
        return tracks if len(tracks) <= state.most else tracks[tracks.opacity.topk(state.most).indices]
