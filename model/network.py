# SPDX-License-Identifier: GPL-3.0-or-later
"""4D-LRM: posed, timed images to 4D Gaussians in one transformer pass (paper, section 2.2, appendix A).

Pixels carry colour, time and their ray (10 channels); 8x8 patches become tokens; a plain pre-LN transformer
without position embeddings mixes the tokens of all views; one linear layer decodes every token into a
Gaussian per pixel. As in GS-LRM's lineage: no biases, N(0, 0.02), no QK norm.

Beyond the paper, and off where its letter is wanted:
    tokens only where the object is: patches without foreground never enter (`drop_empty`);
    heads: `paper` (20 outputs a pixel) or `kinematic` (19);
    sources of the distance along a ray: `predicted` (the paper's), or `sweep` and `given`, where a Geometry
    is known per pixel: its features are extra channels and the outputs are bounded residuals to its
    Gaussians, so that an untrained network returns them unchanged.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal, get_args, get_origin, get_type_hints

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ..datagen.sequence import InputError
from . import hexplane
from .gaussians import DynamicScene, Gaussians4D, kinematic_from_covariance
from .geometry.features import LAYOUTS, Geometry
from .rotations import isoclinic_rotation, quaternion_multiply
from .views import Views, pluecker, rays


@dataclass(frozen=True)
class Config:
    """What a network is. Raises InputError for a word that is none of its field's."""

    width: int = 256
    depth: int = 4
    heads: int = 4
    patch: int = 8
    head: Literal["paper", "kinematic"] = "kinematic"
    source: Literal["predicted", "sweep", "given"] = "predicted"
    depth_range: Literal["paper", "centred"] = "paper"  # 0.1..4.5, or 1.8 to either side of the ray's middle
    free: int = 0  # free Gaussian tokens
    time: Literal["free", "aligned"] = "free"  # of a pixel's Gaussian; aligned: its frame's, or where its Geometry is
    motion: Literal["gaussian", "hexplane"] = "gaussian"  # hexplane: a field moves 3D Gaussians (hexplane.py)

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(Config).items():
            if get_origin(kind) is Literal and (value := getattr(self, name)) not in get_args(kind):
                raise InputError(f"{name} {value}: no network has that; choose one of {', '.join(get_args(kind))}.")
        if self.motion == "hexplane" and (self.source != "predicted" or self.time == "aligned"):
            raise InputError("hexplane: its Gaussians have no time; it goes with the source predicted and free times.")

    @property
    def channels(self) -> int:
        return 10 + (LAYOUTS[self.source].width if self.source != "predicted" else 0)

    @property
    def outputs(self) -> int:
        """Numbers that define one Gaussian."""
        if self.motion == "hexplane":
            return 14  # xyz rgb scale q opacity
        return 20 if self.head == "paper" else 19

    @property
    def centre(self) -> int:
        """How many of them, the first, are the centre: xyz, and t where there is one."""
        return 3 if self.motion == "hexplane" else 4

    @property
    def pixel_outputs(self) -> int:
        """Those that the network decodes for a pixel's."""
        return self.outputs - (self.time == "aligned")


PRESETS = {  # large and base are the paper's, small and tiny for a machine of one's own
    "large": Config(width=1024, depth=24, heads=16, head="paper"),
    "base": Config(width=768, depth=12, heads=12, head="paper"),
    "small": Config(width=384, depth=6, heads=6, source="given"),
    "tiny": Config(width=256, depth=4, heads=4, source="given"),
}


FAINT, SMALL = -2.6, -1.5  # where free Gaussians join others: added to the logit of opacity and to log σ


class Block(nn.Module):
    """Pre-LN self-attention and MLP, each with a residual connection."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width, bias=False)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.proj = nn.Linear(width, width, bias=False)
        self.norm2 = nn.LayerNorm(width, bias=False)
        self.mlp = nn.Sequential(
            nn.Linear(width, 4 * width, bias=False), nn.GELU(), nn.Linear(4 * width, width, bias=False)
        )

    def forward(self, x: Tensor) -> Tensor:  # (T, D)
        qkv = self.qkv(self.norm1(x)).unflatten(-1, (3, self.heads, -1)).permute(1, 2, 0, 3)  # (3, nh, T, hs)
        y = F.scaled_dot_product_attention(*qkv[:, None])[0]  # (nh, T, hs)
        x = x + self.proj(y.transpose(0, 1).flatten(1))
        return x + self.mlp(self.norm2(x))


class Network(nn.Module):
    """forward(views, geometry) -> the Gaussians of one scene."""

    checkpointing = False  # in training, keep only the blocks' inputs and compute the rest again going backward

    def __init__(self, config: Config):
        super().__init__()
        self.config = c = config
        self.embed = nn.Linear(c.patch**2 * c.channels, c.width, bias=False)
        self.norm_in = nn.LayerNorm(c.width, bias=False)
        self.blocks = nn.ModuleList(Block(c.width, c.heads) for _ in range(c.depth))
        self.norm_out = nn.LayerNorm(c.width, bias=False)
        self.decode = nn.Linear(c.width, c.patch**2 * c.pixel_outputs, bias=False)
        if c.free:
            self.free_tokens = nn.Parameter(torch.randn(c.free, c.width) * 0.02)
            self.decode_free = nn.Linear(c.width, c.outputs)
        if c.motion == "hexplane":
            self.plane_tokens = nn.Parameter(torch.randn(hexplane.TOKENS, c.width) * 0.02)
            self.decode_planes = nn.Linear(c.width, hexplane.CELLS**2 * hexplane.CHANNELS, bias=False)
        for m in self.modules():
            if isinstance(m, nn.Linear):
                nn.init.normal_(m.weight, std=0.02)
        if c.free:
            nn.init.zeros_(self.decode_free.bias)
            nn.init.normal_(self.decode_free.weight[: c.centre], std=c.width**-0.5)  # tanh spreads them over the box
        if c.motion == "hexplane":
            self.deform = hexplane.make_mlp()
        if c.source != "predicted":
            nn.init.zeros_(self.decode.weight)  # starts as the Geometry itself
            self.fade_free()

    def forward(
        self, views: Views, geometry: Geometry | None = None, drop_empty: bool = True
    ) -> Gaussians4D | DynamicScene:
        """views: V images, height and width multiples of the patch; geometry: for the sources `sweep` and
        `given`. Pixels in dropped patches, and pixels that own no Gaussian of the
        geometry, yield none."""
        p = self.config.patch
        height, width = views.size
        if height % p or width % p:
            raise ValueError(f"images are {width}x{height}: width and height must be multiples of {p}")
        keep = self.kept_patches(views, drop_empty)
        alpha = gather_pixels(views.alpha[..., None], keep, p)
        colour = gather_pixels(views.rgb, keep, p) * alpha + (1 - alpha)  # over white
        with single_precision(views.rgb.device):  # rays: half a pixel would be lost in bfloat16
            origin, direction = patch_rays(views, keep, p)
        time = gather_pixels(views.time[:, None, None, None].expand(*views.alpha.shape, 1), keep, p)
        maps = [2 * colour - 1, time, pluecker(origin, direction)]
        if geometry is not None:
            maps.append(gather_pixels(geometry.features.values, keep, p))
        pixels, free, planes = self.transform(torch.cat(maps, -1).flatten(1))  # (T, p²·channels) -> (T, D) …
        with single_precision(views.rgb.device):  # heads and conversion: a covariance would not stay positive
            return self.decode_scene(views, geometry, keep, (origin, direction, time), pixels, free, planes)

    def transform(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x (T, p²·channels) patches -> what the transformer makes of the tokens of patches (T,D), of free Gaussians
        (c.free,D) and of planes (…,D), float32. The one part whose matrix products autocast may turn to bfloat16."""
        c = self.config
        x = self.embed(x)
        counts = [len(x), c.free, hexplane.TOKENS if c.motion == "hexplane" else 0]
        if c.free:
            x = torch.cat([x, self.free_tokens])
        if c.motion == "hexplane":
            x = torch.cat([x, self.plane_tokens])
        x = self.norm_in(x)
        for block in self.blocks:
            x = checkpoint(block, x, use_reentrant=False) if self.checkpointing and self.training else block(x)
        return self.norm_out(x).float().split(counts)

    def decode_scene(
        self, views: Views, geometry: Geometry | None, keep: Tensor, pixels: tuple[Tensor, Tensor, Tensor],
        x: Tensor, free: Tensor, planes: Tensor,
    ) -> Gaussians4D | DynamicScene:  # fmt: skip
        """The Gaussians of the transformer's tokens; pixels: ray origins, directions (T,p²,3) and times (T,p²,1)."""
        c, p = self.config, self.config.patch
        origin, direction, time = pixels
        g = self.decode(x).unflatten(-1, (p * p, c.pixel_outputs))  # (T, p², outputs)
        if c.time == "aligned":
            at = torch.zeros_like(time) if geometry is not None else time
            g = torch.cat([g[..., :3], at, g[..., 3:]], -1)

        if geometry is not None:
            row = self.rows(views, keep)[geometry.pixel_index]  # (M,) which of the outputs is about which Gaussian
            slack = geometry.max_shift.flatten()[geometry.pixel_index]
            out = self.residual(g.flatten(0, 1)[row], geometry.gaussians, direction.flatten(0, 1)[row], slack)
        else:
            out = self.pixel_aligned(g, origin, direction).map(lambda m: m.flatten(0, 1))
        if c.free:
            out = Gaussians4D.cat([out, self.free_gaussians(self.decode_free(free))])
        if c.motion == "hexplane":
            planes = hexplane.planes_from_tokens(self.decode_planes(planes))
            out = hexplane.Deformed(out, planes, [m.weight for m in self.deform[::2]])
        return out

    def free_gaussians(self, g: Tensor) -> Gaussians4D:
        """g (N,outputs) -> Gaussians with centres anywhere in the box and the clip (paper, section 2.2)."""
        out = self.activate(g)
        out.xyz, out.t = torch.tanh(out.xyz), torch.tanh(out.t)
        return out

    @torch.no_grad()
    def fade_free(self) -> None:
        """Makes the free Gaussians, if any, start small (σ of 0.02) and faint (0.01), so that the picture is that
        of the others. Not fainter: below 1/255 no rasteriser would send them a gradient."""
        if self.config.free:
            self.decode_free.weight[-1] = 0
            self.decode_free.bias[-1] = FAINT
            self.decode_free.bias[self.config.centre + 3 :][:3] = SMALL

    def kept_patches(self, views: Views, drop_empty: bool = True) -> Tensor:
        """(P,) bool: the patches that become tokens; with `drop_empty` those that show any foreground."""
        seen = patches(views.alpha, self.config.patch).amax((2, 4)).flatten() > 0
        return seen if drop_empty else torch.ones_like(seen)

    def rows(self, views: Views, keep: Tensor) -> Tensor:
        """(V·H·W,) for every pixel its place among the outputs of the kept patches; -1 where dropped."""
        height, width = views.size
        number = torch.arange(len(views) * height * width, device=keep.device).reshape(len(views), height, width)
        row = torch.full_like(number.flatten(), -1)
        chosen = gather_pixels(number, keep, self.config.patch).flatten()
        row[chosen] = torch.arange(len(chosen), device=keep.device)
        return row

    def pixel_aligned(self, g: Tensor, origin: Tensor, direction: Tensor) -> Gaussians4D:
        """g (…,outputs), origin and direction (…,3) -> Gaussians on their pixels' rays (appendix A.1)."""
        omega = torch.sigmoid(g[..., :3].mean(-1, keepdim=True))
        if self.config.depth_range == "paper":
            delta = 0.1 * (1 - omega) + 4.5 * omega
        else:
            delta = (2 * omega - 1) * 1.8 - (origin * direction).sum(-1, keepdim=True)
        out = self.activate(g)
        out.xyz = origin + delta * direction
        if self.training:  # a centre outside of the box can only be wrong
            out.xyz = out.xyz.clamp(-1, 1)
        return out

    def activate(self, g: Tensor) -> Gaussians4D:
        """g (…,outputs) in the order xyz t rgb scale_xyz scale_t, then q_l q_r opacity (paper) or q velocity
        opacity (kinematic) -> Gaussians with the appendix's activations and biases. With a HexPlane xyz rgb
        scale_xyz q opacity -> Gaussians that do not move, and live for ever. The paper head's shape is in `cov3`."""
        still = self.config.motion == "hexplane"
        if still:
            none = torch.zeros_like(g[..., :1])
            g = torch.cat([g[..., :3], none, g[..., 3:9], none, g[..., 9:13], none, none, none, g[..., 13:]], -1)
        xyz, t, rgb, s, s_t = g[..., :3], g[..., 3], g[..., 4:7], g[..., 7:10], g[..., 10]
        rgb = 0.5 + 0.28209479177387814 * rgb  # zero-order SH
        scale = torch.exp(s - 2.3).clamp_max(0.3)
        scale_t = torch.full_like(s_t, 1e6) if still else torch.exp(s_t - 2.3).clamp_max(1.0)
        opacity = torch.sigmoid(g[..., -1] - 2.0)
        if self.config.head == "kinematic" or still:
            return Gaussians4D(
                xyz,
                t,
                g[..., 15:18],
                scale_t,
                scale,
                F.normalize(g[..., 11:15] + _IDENTITY.to(g), dim=-1),
                rgb,
                opacity,
            )
        R = isoclinic_rotation(F.normalize(g[..., 11:15], dim=-1), F.normalize(g[..., 15:19], dim=-1))
        M = R * torch.cat([scale, scale_t[..., None]], -1)[..., None, :]
        velocity, sigma_t, cov3 = kinematic_from_covariance(M @ M.mT)
        return Gaussians4D.from_covariance(xyz, t, velocity, sigma_t, cov3, rgb, opacity)

    def residual(self, g: Tensor, base: Gaussians4D, direction: Tensor, slack: Tensor) -> Gaussians4D:
        """g (M,19), base Gaussians (M,), their rays' directions (M,3), slack (M,) -> base plus bounded steps:
        along the ray by `slack`, σ and σ_t by a factor of e^1.5, colour by 0.5, velocity by 4 per unit of
        time, μ_t by 0.3, opacity by 4 in its logit."""
        move = slack[..., None] * torch.tanh(g[..., :3].mean(-1, keepdim=True))
        turn = torch.cat([torch.ones_like(g[..., :1]), 0.5 * g[..., 12:15]], -1)  # g[11] has no effect
        return Gaussians4D(
            xyz=base.xyz + move * direction,
            t=base.t + 0.3 * torch.tanh(g[..., 3]),
            velocity=base.velocity + 4 * torch.tanh(0.25 * g[..., 15:18]),
            sigma_t=base.sigma_t * torch.exp(1.5 * torch.tanh(g[..., 10])),
            scale=base.scale * torch.exp(1.5 * torch.tanh(g[..., 7:10])),
            rotation=quaternion_multiply(base.rotation, F.normalize(turn, dim=-1)),
            rgb=base.rgb + 0.5 * torch.tanh(g[..., 4:7]),
            opacity=torch.sigmoid(torch.logit(base.opacity, 1e-4) + 4 * torch.tanh(0.5 * g[..., -1])),
        )


def load_matching(network: Network, trained: Network) -> None:
    """Copies the weights of `trained`, which may lack the network's free Gaussians: these then start faint.
    Raises InputError where the two differ in anything else."""
    here, there = asdict(network.config), asdict(trained.config)
    differ = [k for k in here if here[k] != there[k] and not (k == "free" and not there[k])]
    if differ:
        text = ", ".join(f"{k} {there[k]} instead of {here[k]}" for k in differ)
        raise InputError(f"the checkpoint to start from has {text}; train with the same, or from random weights.")
    network.load_state_dict(trained.state_dict(), strict=False)
    if here["free"] != there["free"]:
        network.fade_free()


_IDENTITY = torch.tensor([1.0, 0, 0, 0])


def single_precision(device: torch.device):
    """A context in which no operation is autocast to a shorter type."""
    return torch.autocast(device.type, enabled=False)


def patches(m: Tensor, p: int) -> Tensor:
    """(V,H,W,…) -> (V, H/p, p, W/p, p, …), a view."""
    return m.unflatten(2, (-1, p)).unflatten(1, (-1, p))


def gather_pixels(m: Tensor, keep: Tensor, p: int) -> Tensor:
    """m (V,H,W,…), keep (P,) bool with T patches kept -> (T, p², …): patches view by view and row by row, pixels
    row by row within; the order of the network's Gaussians."""
    m = patches(m, p)
    view, i, j = keep.reshape(len(m), m.shape[1], m.shape[3]).nonzero(as_tuple=True)
    return m[view, i, :, j].flatten(1, 2)


def patch_rays(views: Views, keep: Tensor, p: int) -> tuple[Tensor, Tensor]:
    """Origins and unit directions (T,p²,3) of the kept patches' pixels: every patch a small image of its own."""
    height, width = views.size
    view, i, j = keep.reshape(len(views), height // p, width // p).nonzero(as_tuple=True)
    corner = torch.stack([0 * i, 0 * i, j * p, i * p], -1)
    found = rays(views.c2w[view], views.intrinsics[view] - corner, p, p)
    return tuple(m.flatten(1, 2) for m in found)
