# SPDX-License-Identifier: GPL-3.0-or-later
"""What is wrong with inputs, by one number each: functions (views, cameras, level, rng) -> views.

`cameras` (V,) numbers the camera that took each view. Level 0 changes nothing but where a function says so. Depth and
motion, where there are any, stay those of the true cameras: what a sensor says of itself.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from ...datagen.zoo.shapes import rotation
from ...model.views import Views

Disturbance = Callable[[Views, np.ndarray, float, np.random.Generator], Views]


def _each(cameras: np.ndarray, values: np.ndarray) -> Tensor:
    """(V,…) float32: the value of the camera that took each view; values (C,…) in the order of cameras' numbers."""
    return torch.from_numpy(values[np.unique(cameras, return_inverse=True)[1]]).float()


def turned(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Each view's camera is said to look `level` degrees from where it looks, about a random axis."""
    axes = rng.normal(size=(len(views), 3))
    turns = np.stack([rotation(a, np.radians(level))[:3, :3] for a in axes])
    c2w = views.c2w.clone()
    c2w[:, :3, :3] = c2w[:, :3, :3] @ torch.from_numpy(turns).float()
    return replace(views, c2w=c2w)


def misplaced(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Each view's camera is said to stand `level` percent of its distance from where it stands."""
    way = rng.normal(size=(len(views), 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    c2w = views.c2w.clone()
    far = c2w[:, :3, 3].norm(dim=1, keepdim=True)
    c2w[:, :3, 3] += level / 100 * far * torch.from_numpy(way).float()
    return replace(views, c2w=c2w)


def zoomed(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """All focal lengths are said to be `level` percent longer than they are."""
    longer = torch.tensor([1 + level / 100, 1 + level / 100, 1, 1])
    return replace(views, intrinsics=views.intrinsics * longer)


def mistimed(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Each view is said to be of another time, normally by `level` moments."""
    off = torch.from_numpy(rng.normal(size=len(views))).float() * level * views.frame_step
    return replace(views, time=(views.time + off).clamp(-1, 1))


def late(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """One camera's clock is `level` moments late."""
    one = torch.from_numpy(cameras == cameras[0])
    return replace(views, time=torch.where(one, views.time + level * views.frame_step, views.time).clamp(-1, 1))


def exposed(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Each camera's exposure differs, normally by `level` stops (of light; sRGB taken as a power of 2.2)."""
    gain = 2.0 ** (level * rng.normal(size=len(np.unique(cameras))) / 2.2)
    return replace(views, rgb=(views.rgb * _each(cameras, gain)[:, None, None, None]).clamp(0, 1))


def tinted(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Each camera's white is of another colour: channels differ normally by `level` percent."""
    gain = 1 + level / 100 * rng.normal(size=(len(np.unique(cameras)), 3))
    return replace(views, rgb=(views.rgb * _each(cameras, gain)[:, None, None]).clamp(0, 1))


def noisy(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Normal noise of σ = `level` of 255 on the colours."""
    noise = torch.from_numpy(rng.standard_normal(tuple(views.rgb.shape), np.float32)) * level / 255
    return replace(views, rgb=(views.rgb + noise).clamp(0, 1))


def jpeg(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Colours went through JPEG of quality 100 - `level`, laid on white; the masks are whole."""
    if not level:
        return views
    found = []
    for picture in (views.over() * 255).round().byte().numpy():
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "JPEG", quality=round(100 - level))
        with Image.open(file) as image:
            found.append(torch.from_numpy(np.array(image)).float() / 255)
    alpha = views.alpha[..., None]
    straight = (torch.stack(found) - (1 - alpha)) / alpha.clamp_min(1e-3)
    return replace(views, rgb=torch.where(alpha > 1 / 255, straight, views.rgb).clamp(0, 1))


def grown(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Masks `level` pixels too large, what was outside shown white; below 0 so many pixels too small."""
    size = 2 * round(abs(level)) + 1
    if size == 1:
        return views
    sign = 1 if level > 0 else -1
    alpha = sign * F.max_pool2d(sign * views.alpha[:, None], size, 1, size // 2)[:, 0]
    # What a mask that is too large adds is what lies behind the object: white.
    share = (views.alpha / alpha.clamp_min(1e-6)).clamp(max=1)[..., None]
    return replace(views, rgb=views.rgb * share + (1 - share), alpha=alpha)


def holed(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Of the mask of each view `level` percent is missing, in squares of a tenth of the picture, elsewhere in each."""
    alpha = views.alpha.clone()
    height, width = views.size
    side = max(max(views.size) // 10, 2)
    for a in alpha:
        whole = float((a > 0).sum())
        ys, xs = np.nonzero((a > 0).numpy())
        while len(ys) and level and float((a > 0).sum()) > whole * (1 - level / 100):
            k = rng.integers(len(ys))
            y, x = max(ys[k] - side // 2, 0), max(xs[k] - side // 2, 0)
            a[y : min(y + side, height), x : min(x + side, width)] = 0
    return replace(views, alpha=alpha)


def unmasked(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """A grey background shows through: alpha is nowhere less than `level`; 1 is no mask at all."""
    alpha = views.alpha.clamp_min(level)
    share = (views.alpha / alpha.clamp_min(1e-6)).clamp(max=1)[..., None]
    return replace(views, rgb=views.rgb * share + 0.5 * (1 - share), alpha=alpha)


# ---------------------------------------------------------------- fewer inputs


def missing(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """`level` percent of the moments are not there, never the first or the last."""
    moments = views.time.unique()
    gone = rng.permutation(np.arange(1, len(moments) - 1))[: round(level / 100 * len(moments))]
    return views[~torch.isin(views.time, moments[torch.from_numpy(gone)])]


def few(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """`level` views in all, spread over the clip; their cameras drawn."""
    keys = rng.permutation(len(views))
    order = np.lexsort((keys, views.time.numpy()))
    picked = order[np.linspace(0, len(order) - 1, min(round(level), len(order))).round().astype(int)]
    return views[torch.from_numpy(np.sort(picked))]


def one_sided(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Of all views those alone that look from within 180 - `level` degrees of the front."""
    x, y = views.c2w[:, 0, 3], views.c2w[:, 1, 3]
    from_front = torch.rad2deg(torch.atan2(x, -y)).abs()
    return views[from_front <= 180 - level + 1e-3]


# ---------------------------------------------------------------- what must make no difference


def shuffled(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """The same views in another order, for each level its own."""
    return views[torch.from_numpy(rng.permutation(len(views)))] if level else views


def hair(views: Views, cameras: np.ndarray, level: float, rng: np.random.Generator) -> Views:
    """Principal points moved by a hundredth of a pixel, for each level otherwise."""
    off = np.zeros((len(views), 4))
    off[:, 2:] = 0.01 * rng.choice([-1, 1], (len(views), 2)) * bool(level)
    return replace(views, intrinsics=views.intrinsics + torch.from_numpy(off).float())
