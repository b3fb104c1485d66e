# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures for people: predictions laid beside the truth, and the same as a small video."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

MARGIN = 4
LABEL = 96


def as_bytes(image: torch.Tensor) -> np.ndarray:
    """(…,3) 0..1 -> uint8."""
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()


def grid(rows: dict[str, torch.Tensor], columns: list[str]) -> Image.Image:
    """{label: (n,H,W,3) pictures 0..1} and n column titles -> one labelled picture, a row per label."""
    n, height, width = next(iter(rows.values())).shape[:3]
    font = ImageFont.load_default(13)
    left = max(LABEL, *(8 + math.ceil(font.getlength(label)) for label in rows))
    sheet = Image.new("RGB", (left + n * (width + MARGIN), 20 + len(rows) * (height + MARGIN)), "white")
    pen = ImageDraw.Draw(sheet)
    for i, title in enumerate(columns):
        pen.text((left + i * (width + MARGIN) + 4, 3), title, fill="black", font=font)
    for j, (label, images) in enumerate(rows.items()):
        y = 20 + j * (height + MARGIN)
        pen.text((4, y + height // 2 - 8), label, fill="black", font=font)
        for i in range(n):
            sheet.paste(Image.fromarray(as_bytes(images[i])), (left + i * (width + MARGIN), y))
    return sheet


def video(path: Path, rows: dict[str, torch.Tensor], fps: float) -> None:
    """{label: (n,H,W,3)} -> looping animated WebP of n frames with the labels side by side."""
    font = ImageFont.load_default(13)
    frames = []
    for i in range(len(next(iter(rows.values())))):
        strip = np.concatenate([as_bytes(images[i]) for images in rows.values()], 1)
        frame = Image.new("RGB", (strip.shape[1], strip.shape[0] + 18), "white")
        frame.paste(Image.fromarray(strip), (0, 18))
        pen = ImageDraw.Draw(frame)
        for j, label in enumerate(rows):
            pen.text((j * strip.shape[1] // len(rows) + 4, 2), label, fill="black", font=font)
        frames.append(frame)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=round(1000 / fps), loop=0, quality=85)
