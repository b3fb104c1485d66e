# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU rasteriser of OpenSplat, the fastest third-party one found, for `benchmarks/rasterizer.py --opensplat DIR`.

DIR is a checkout of https://github.com/pierotofy/OpenSplat (now WebODM/OpenSplat; AGPL; nothing of it is copied here).
Its two CPU functions of rasterizer/gsplat-cpu are compiled as they are, with -O3 -march=native; its projection has
torch's own gradients, its blending a backward function of its own. Versions of the checkout differ in what more that
one takes (maps for densification, left out: then it does not compute them).
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from timesplat.datagen.sequence import InputError
from timesplat.model.gaussians import Gaussians4D

BINDING = r"""
#include <torch/extension.h>
#include <numeric>
#include "bindings.h"
using T = torch::Tensor;

template <size_t... I, class R, class... A, class... B>
R with_nothing_more(std::index_sequence<I...>, R (*f)(A...), const T &nothing, const B &...given) {
    return f(given..., (static_cast<void>(I), nothing)...);
}

template <class R, class... A, class... B>
R call(R (*f)(A...), const T &nothing, const B &...given) {
    return with_nothing_more(std::make_index_sequence<sizeof...(A) - sizeof...(B)>(), f, nothing, given...);
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    m.def("project", [](T xyz, T scale, T rotation, T view, T projection, float fx, float fy, float cx, float cy,
                        int h, int w) {
        return project_gaussians_forward_tensor_cpu(xyz.size(0), xyz, scale, 1.0f, rotation, view, projection, fx, fy,
                                                    cx, cy, h, w, 0.01f);
    });
    m.def("forward", [](int w, int h, T xy, T conic, T rgb, T opacity, T background, T cov2, T depth) {
        auto out = rasterize_forward_tensor_cpu(w, h, xy, conic, rgb, opacity, background, cov2, depth);
        return std::make_tuple(std::get<0>(out), std::get<1>(out), reinterpret_cast<int64_t>(std::get<2>(out)));
    });
    m.def("backward", [](int h, int w, T xy, T conic, T rgb, T opacity, T background, T cov2, T depth, T left,
                         int64_t ids, T g_rgb, T g_alpha) {
        auto lists = reinterpret_cast<const std::vector<int32_t> *>(ids);
        return call(rasterize_backward_tensor_cpu, torch::empty({0}), h, w, xy, conic, rgb, opacity, background, cov2,
                    depth, left, lists, g_rgb, g_alpha);
    });
    m.def("release", [](int64_t ids) { delete[] reinterpret_cast<std::vector<int32_t> *>(ids); });
}
"""


def compiled(folder: Path):
    """The extension, compiled from the checkout in `folder` (half a minute; cached by torch).
    InputError where `folder` is no checkout of OpenSplat."""
    sources = folder / "rasterizer" / "gsplat-cpu"
    if not (sources / "gsplat_cpu.cpp").is_file():
        raise InputError(f"{sources / 'gsplat_cpu.cpp'}: missing. Give a checkout of OpenSplat.")
    from torch.utils.cpp_extension import load_inline

    code = f'#include "{(sources / "gsplat_cpu.cpp").resolve()}"\n'
    return load_inline(
        "timesplat_opensplat",
        [BINDING, "#include <numeric>\n" + code],
        extra_include_paths=[str(sources.resolve())],
        extra_cflags=["-O3", "-march=native", "-w"],
    )


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, library, xy, conic, rgb, opacity, cov2, depth, background, h, w):
        image, left, ids = library.forward(w, h, xy, conic, rgb, opacity, background, cov2, depth)
        ctx.library, ctx.ids, ctx.size = library, ids, (h, w)
        ctx.save_for_backward(xy, conic, rgb, opacity, background, cov2, depth, left)
        return image, 1 - left

    @staticmethod
    def backward(ctx, g_rgb, g_alpha):
        grads = ctx.library.backward(*ctx.size, *ctx.saved_tensors, ctx.ids, g_rgb.contiguous(), g_alpha.contiguous())
        ctx.library.release(ctx.ids)
        return None, *grads, *[None] * 5


def slices(g: Gaussians4D, times: Tensor, visible: float) -> list[list[Tensor]]:
    """Per time: xyz, scale, rotation, rgb, opacity (K,1) of the still 3D Gaussians at least as opaque then."""
    out = []
    for t in times.tolist():
        s = g.frozen(t)
        s = s[s.opacity >= visible]
        out.append([x.detach().clone() for x in (s.xyz, s.scale, s.rotation, s.rgb, s.opacity[:, None])])
    return out


def render(library, leaves: list[list[Tensor]], c2w: Tensor, intrinsics: Tensor, _: Tensor, width: int, height: int):
    """Images (C,height,width,3) over white and alpha of the `slices`; principal points in the middle."""
    images, alphas = [], []
    for (xyz, scale, rotation, rgb, opacity), pose, (fx, fy, cx, cy) in zip(
        leaves, c2w, intrinsics.tolist(), strict=True
    ):
        view = torch.linalg.inv(pose)
        near, far = 0.001, 1000.0
        projection = torch.zeros(4, 4)
        projection[0, 0], projection[1, 1] = 2 * fx / width, 2 * fy / height
        projection[2, 2], projection[2, 3] = (far + near) / (far - near), -far * near / (far - near)
        projection[3, 2] = 1
        projected = library.project(xyz, scale, rotation, view, projection @ view, fx, fy, cx, cy, height, width)
        xy, _, conic, cov2, depth = projected
        image, alpha = _Blend.apply(library, xy, conic, rgb, opacity, cov2, depth, torch.ones(3), height, width)
        images.append(image)
        alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas)
