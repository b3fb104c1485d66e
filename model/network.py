# SPDX-License-Identifier: GPL-3.0-or-later
"""4D-LRM: posed, timed images to 4D Gaussians in one transformer pass (paper, section 2.2, appendix A).

Pixels carry colour, time and their ray (10 channels); 8x8 patches become tokens; a plain pre-LN transformer
without position embeddings mixes the tokens of all views; one linear layer decodes every token into a
Gaussian per pixel. As in GS-LRM's lineage: no biases, N(0, 0.02), no QK norm.

Beyond the paper, and off where its letter is wanted:
    tokens only where the object is: patches without foreground never enter (`drop_empty`);
    heads: `paper` (20 outputs a pixel) or `kinematic` (19), see heads.py;
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
from . import heads, hexplane
from .gaussians import DynamicScene, Gaussians4D
from .geometry.features import LAYOUTS, Geometry
from .layout import Layout
from .patches import gather_pixels, in_patches, patch_rays, pixel_places
from .rasterize.constants import WIDER
from .views import Views, pluecker

PIXEL = Layout({"rgb": 3, "time": 1, "ray": 6})  # input channels: -1..1 over white, -1..1 over the clip, Plücker


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
    def input_channels(self) -> int:
        """Of a pixel."""
        return PIXEL.width + (LAYOUTS[self.source].width if self.source != "predicted" else 0)

    @property
    def pixel_layout(self) -> Layout:
        """What the network decodes for a pixel's Gaussian."""
        layout = self.free_layout if self.source == "predicted" else heads.RESIDUAL[self.head]
        return layout.without("t") if self.time == "aligned" else layout

    @property
    def free_layout(self) -> Layout:
        """What it decodes for a free Gaussian."""
        return heads.STILL if self.motion == "hexplane" else heads.ABSOLUTE[self.head]


PRESETS = {  # large and base are the paper's, small and tiny for a machine of one's own
    "large": Config(width=1024, depth=24, heads=16, head="paper"),
    "base": Config(width=768, depth=12, heads=12, head="paper"),
    "small": Config(width=384, depth=6, heads=6, source="given"),
    "tiny": Config(width=256, depth=4, heads=4, source="given"),
}

# Where free Gaussians join others they start small (σ of 0.02) and faint (0.01), so that the picture is that of the
# others. Not fainter: below 1/255 no rasteriser would send them a gradient.
FREE_START = {"opacity": -2.6, "scale": -1.5}  # added to the logit of opacity and to log σ


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
        self.embed = nn.Linear(c.patch**2 * c.input_channels, c.width, bias=False)
        self.norm_in = nn.LayerNorm(c.width, bias=False)
        self.blocks = nn.ModuleList(Block(c.width, c.heads) for _ in range(c.depth))
        self.norm_out = nn.LayerNorm(c.width, bias=False)
        self.decode = nn.Linear(c.width, c.patch**2 * c.pixel_layout.width, bias=False)
        if c.free:
            self.free_tokens = nn.Parameter(torch.randn(c.free, c.width) * 0.02)
            self.decode_free = nn.Linear(c.width, c.free_layout.width)
        if c.motion == "hexplane":
            self.plane_tokens = hexplane.make_tokens(c.width)
            self.decode_planes = hexplane.make_decoder(c.width)
        for m in self.modules():
            if isinstance(m, nn.Linear):
                nn.init.normal_(m.weight, std=0.02)
        if c.free:
            nn.init.zeros_(self.decode_free.bias)
            centre = c.free_layout.slice("xyz", "t" if "t" in c.free_layout else "xyz")
            nn.init.normal_(self.decode_free.weight[centre], std=c.width**-0.5)  # tanh spreads them over the box
        if c.motion == "hexplane":
            self.deform = hexplane.make_mlp()
        if c.source != "predicted":
            nn.init.zeros_(self.decode.weight)  # starts as the Geometry itself
            self.fade_free()

    def forward(
        self, views: Views, geometry: Geometry | None = None, drop_empty: bool = True
    ) -> Gaussians4D | DynamicScene:
        """views: V images, height and width multiples of the patch, or ValueError; geometry: for the sources `sweep`
        and `given`. Pixels in dropped patches, and pixels that have no Gaussian in the geometry, yield none; the
        order is that of `gather_pixels`, or the geometry's; free Gaussians come last."""
        p = self.config.patch
        height, width = views.size
        if height % p or width % p:
            raise ValueError(f"images are {width}x{height}: width and height must be multiples of {p}")
        keep = self.kept_patches(views, drop_empty)
        with single_precision(views.rgb.device):  # rays: half a pixel would be lost in bfloat16
            origin, direction = patch_rays(views, keep, p)
            inputs = self.pixel_inputs(views, geometry, keep, pluecker(origin, direction))
        tokens = self.transform(inputs.flatten(1))
        with single_precision(views.rgb.device):  # heads and conversion: a covariance would not stay positive
            rays = origin.flatten(0, 1), direction.flatten(0, 1)
            scene = self.decode_pixels(tokens["patches"], views, geometry, keep, *rays)
            if self.config.free:
                free = self.config.free_layout.split(self.decode_free(tokens["free"]))
                scene = Gaussians4D.cat([scene, heads.in_the_box(free)])
            scene = scene.widened(WIDER * views.pixel)
            if self.config.motion == "hexplane":
                return hexplane.deformed(scene, self.decode_planes(tokens["planes"]), self.deform)
            return scene

    def pixel_inputs(self, views: Views, geometry: Geometry | None, keep: Tensor, ray: Tensor) -> Tensor:
        """The pixels of the T patches that `keep` (P,) keeps, ray (T,p²,6) theirs -> (T,p²,input_channels)."""
        p = self.config.patch
        alpha = gather_pixels(views.alpha[..., None], keep, p)
        over_white = gather_pixels(views.rgb, keep, p) * alpha + (1 - alpha)
        inputs = PIXEL.join(rgb=2 * over_white - 1, time=self.pixel_times(views, keep), ray=ray)
        if geometry is None:
            return inputs
        return torch.cat([inputs, gather_pixels(geometry.features.values, keep, p)], -1)

    def transform(self, patches: Tensor) -> dict[str, Tensor]:
        """patches (T, p²·input_channels) -> what the transformer makes of the tokens of `patches` (T,D), and where
        there are such of `free` Gaussians (free,D) and `planes` (hexplane.TOKENS,D); float32. The one part whose
        matrix products autocast may turn to bfloat16."""
        tokens = {"patches": self.embed(patches)}
        if self.config.free:
            tokens["free"] = self.free_tokens
        if self.config.motion == "hexplane":
            tokens["planes"] = self.plane_tokens
        x = self.norm_in(torch.cat(list(tokens.values())))
        for block in self.blocks:
            x = checkpoint(block, x, use_reentrant=False) if self.checkpointing and self.training else block(x)
        groups = self.norm_out(x).float().split([len(group) for group in tokens.values()])
        return dict(zip(tokens, groups, strict=True))

    def decode_pixels(
        self, x: Tensor, views: Views, geometry: Geometry | None, keep: Tensor, origin: Tensor, direction: Tensor
    ) -> Gaussians4D:
        """x (T,D) the transformed tokens of the T kept patches, origin and direction (T·p²,3) of their pixels' rays
        -> a Gaussian for each of these pixels, or the geometry's Gaussians (M,), corrected."""
        c = self.config
        g = self.decode(x).reshape(-1, c.pixel_layout.width)  # (T·p², outputs)
        if geometry is None:
            outputs = c.pixel_layout.split(g)
            if c.time == "aligned":
                outputs["t"] = self.pixel_times(views, keep).flatten()
            out = heads.along_rays(outputs, origin, direction, c.depth_range)
            if self.training:  # a centre outside of the box can only be wrong
                out.xyz = out.xyz.clamp(-1, 1)
            return out
        pixel = geometry.pixel_index
        place = self.pixel_places(views, keep)[pixel]  # (M,) which of the outputs is about which Gaussian
        outputs = c.pixel_layout.split(g[place])
        if c.time == "aligned":
            outputs["t"] = torch.zeros_like(geometry.gaussians.t)
        return heads.corrected(outputs, geometry.gaussians, direction[place], geometry.max_shift.flatten()[pixel])

    @torch.no_grad()
    def fade_free(self) -> None:
        """Makes the free Gaussians, if any, start small and faint (FREE_START)."""
        if self.config.free:
            layout = self.config.free_layout
            self.decode_free.weight[layout.slice("opacity")] = 0
            for name, start in FREE_START.items():
                self.decode_free.bias[layout.slice(name)] = start

    def kept_patches(self, views: Views, drop_empty: bool = True) -> Tensor:
        """(P,) bool: the patches that become tokens; with `drop_empty` those that show any foreground."""
        foreground = in_patches(views.alpha, self.config.patch).amax((2, 4)).flatten() > 0
        return foreground if drop_empty else torch.ones_like(foreground)

    def pixel_places(self, views: Views, keep: Tensor) -> Tensor:
        """keep (P,) bool -> (V·H·W,) for every pixel its place among the outputs; -1 where its patch is dropped."""
        return pixel_places(views, keep, self.config.patch)

    def pixel_times(self, views: Views, keep: Tensor) -> Tensor:
        """(T,p²) the times of the kept patches' pixels."""
        return gather_pixels(views.time[:, None, None].expand_as(views.alpha), keep, self.config.patch)


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


def single_precision(device: torch.device) -> torch.autocast:
    """A context in which no operation is autocast to a shorter type."""
    return torch.autocast(device.type, enabled=False)
