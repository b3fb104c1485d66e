# SPDX-License-Identifier: GPL-3.0-or-later
"""Others' pictures as a Sequence has them: RGBA with straight alpha, one size, straight lines.

Alpha is what a picture says, times its mask; where there is neither, it is what differs from a constant background. The
lens is straightened at the picture's own size; then it is brought to the size of the Sequence. Pillow and numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..sequence import InputError, View
from .backgrounds import Background, colour_of, common_colour, key_out
from .lenses import Lens, straighten
from .videos import read_frame

ALPHA = ("RGBA", "LA", "PA", "RGBa", "La")  # Pillow's modes with alpha
MEASURED = 12  # pictures whose rims are measured
PARTS = 31  # a mask without larger values holds numbers of parts, such as of a body, or 0 and 1


@dataclass(frozen=True)
class Source:
    """A picture on disk, and its lens at the size it has there. upright: whether EXIF's rotation is carried out."""

    image: Path
    mask: Path | None
    lens: Lens
    upright: bool = True
    video_frame: int | None = None  # which one, where the image is a video

    def read(self, remedy: str) -> np.ndarray:
        """(H,W,4) uint8 as the lens took it, without its mask. Raises InputError naming the file."""
        if self.video_frame is not None:
            return read_frame(self.image, self.video_frame)
        return read_picture(self.image, self.upright, remedy)


class Pictures:
    """How the pictures of a Sequence's views are read, by their path in it. The Sequence's size is the one
    that most have; others are resized to fit, and moved to its middle."""

    def __init__(
        self,
        sources: dict[str, Source],
        background: Background | None,
        has_alpha: bool,
        remedy: str,
        whole: bool = False,
    ):
        """whole: alpha is 1 everywhere, whatever pictures say. Masks are the sources' own."""
        sizes = [(s.lens.width, s.lens.height) for s in sources.values()]
        self.sources, self.background, self.has_alpha, self.remedy = sources, background, has_alpha, remedy
        self.whole = whole
        self.width, self.height = max(dict.fromkeys(sizes), key=lambda s: (sizes.count(s), s))

    def __call__(self, view: View) -> np.ndarray:
        """(H,W,4) uint8 RGBA of a view. Raises InputError naming the file that cannot be read."""
        source = self.sources[view.image]
        return self._fit(straighten(self._rgba(source), source.lens), source.lens)

    def intrinsics(self, name: str) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in pixels of a picture as it comes from here."""
        lens = self.sources[name].lens
        scale, left, top = self._place(lens)
        return lens.fx * scale, lens.fy * scale, lens.cx * scale + left, lens.cy * scale + top

    def alpha(self, view: View, size: int) -> np.ndarray:
        """(h,w) float32 0..1: alpha of a view at `size` pixels of the longer side, without the picture where its mask
        says all."""
        source = self.sources[view.image]
        if source.mask and source.lens.straight:
            alpha = self._fit(read_mask(source.mask, self.remedy)[..., None], source.lens)[..., 0]
        else:
            alpha = self(view)[..., 3]
        return shrunk(alpha, size)

    def _rgba(self, source: Source) -> np.ndarray:
        rgba = source.read(self.remedy)
        if source.mask:
            mask = read_mask(source.mask, self.remedy).astype(np.float32)
            rgba[..., 3] = np.rint(rgba[..., 3] * mask / 255)
        elif self.background and not self.has_alpha:
            rgba = key_out(rgba, self.background)
        elif self.whole:
            rgba[..., 3] = 255
        return rgba

    def _place(self, lens: Lens) -> tuple[float, float, float]:
        """The scale of a picture, and where its left and upper borders are then. A cut-out is seen whole; of a scene
        without alpha nothing may stay empty."""
        sides = self.width / lens.width, self.height / lens.height
        known = self.background or self.has_alpha
        scale = min(sides) if known else max(sides)
        return scale, (self.width - lens.width * scale) / 2, (self.height - lens.height * scale) / 2

    def _fit(self, image: np.ndarray, lens: Lens) -> np.ndarray:
        """(h,w,C) uint8 -> (H,W,C): averaged where it becomes smaller, bilinear where it becomes larger; outside as at
        the border."""
        if (lens.width, lens.height) == (self.width, self.height):
            return image
        from PIL import Image

        scale, left, top = self._place(lens)
        # The window onto the picture, in its pixels; what of it is outside is filled by repeating the rim.
        box = np.array([-left, -top, self.width - left, self.height - top]) / scale
        pad = int(np.ceil(max(0.0, -box.min(), *(box[2:] - (lens.width, lens.height)))))
        padded = np.pad(image, ((pad, pad), (pad, pad), (0, 0)), mode="edge")
        kind = {1: "L", 4: "RGBA"}[image.shape[2]]
        picture = Image.fromarray(padded[..., 0] if kind == "L" else padded, kind)  # RGBA is resized premultiplied
        out = picture.resize((self.width, self.height), Image.Resampling.BILINEAR, box=tuple(box + pad))
        return np.asarray(out).reshape(self.height, self.width, image.shape[2])


def shrunk(alpha: np.ndarray, size: int) -> np.ndarray:
    """(H,W) uint8 -> (h,w) float32 0..1 with `size` pixels at the longer side, averaged."""
    from PIL import Image

    scale = size / max(alpha.shape)
    small = (max(round(alpha.shape[1] * scale), 1), max(round(alpha.shape[0] * scale), 1))
    return np.asarray(Image.fromarray(alpha).resize(small, Image.Resampling.BOX), np.float32) / 255


def read_picture(path: Path, upright: bool, remedy: str) -> np.ndarray:
    """(H,W,4) uint8 of any kind of picture: 16 bit, grey, with a palette. Raises InputError naming the file."""
    from PIL import Image, ImageOps

    try:
        with Image.open(path) as im:
            turned = ImageOps.exif_transpose(im) if upright else im
            if turned.mode.startswith(("I", "F")):  # Pillow would cut 16 bit of grey off at 255
                grey = np.asarray(turned, np.float64) / (257 if turned.mode.startswith("I") else 1 / 255)
                turned = Image.fromarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
            return np.array(turned.convert("RGBA"))
    except FileNotFoundError:
        raise InputError(f"{path}: the image is missing; {remedy}.") from None
    except Exception as e:
        raise InputError(f"{path}: the image cannot be read ({e}); {remedy}.") from None


def read_mask(path: Path, remedy: str) -> np.ndarray:
    """(H,W) uint8, 255 where the object is; masks of 0 and 1, and of numbers of parts, are taken for what they mean.
    Raises InputError."""
    from PIL import Image

    try:
        with Image.open(path) as im:
            if im.mode.startswith("I"):
                mask = np.clip(np.asarray(im, np.float64) / 257, 0, 255).astype(np.uint8)
            else:
                mask = np.array(im.getchannel("A") if im.mode in ALPHA else im.convert("L"))
    except Exception as e:
        raise InputError(f"{path}: the mask cannot be read ({e}); {remedy}.") from None
    return (mask > 0) * np.uint8(255) if mask.max(initial=0) <= PARTS else mask


def size_of(path: Path, upright: bool, remedy: str) -> tuple[tuple[int, int], bool, bool]:
    """Width and height of a picture, whether EXIF turns it by a quarter, and whether it has alpha, from its head alone.
    upright: the size after EXIF's rotation. Raises InputError naming the file."""
    from PIL import Image

    try:
        with Image.open(path) as im:
            turned = im.getexif().get(0x0112, 1) in (5, 6, 7, 8)
            width, height = im.size[::-1] if turned and upright else im.size
            return (width, height), turned, im.mode in ALPHA or "transparency" in im.info
    except FileNotFoundError:
        raise InputError(f"{path}: the image is missing; {remedy}.") from None
    except Exception as e:
        raise InputError(f"{path}: the image cannot be read ({e}); {remedy}.") from None


def scaled_to(lens: Lens, size: tuple[int, int]) -> Lens | None:
    """The lens on a picture of another size than stated: resized where the sides have the same ratio, else None."""
    x, y = size[0] / lens.width, size[1] / lens.height
    if abs(lens.width * y - size[0]) > 1 and abs(lens.height * x - size[1]) > 1:
        return None
    return lens if size == (lens.width, lens.height) else lens.resized(*size)


def background_of(
    sources: list[Source], masked: bool, has_alpha: bool, asked: str, remedy: str
) -> tuple[Background | None, str]:
    """What is behind the object, None where alpha or masks tell the object, or nothing does; and what is to be said of
    it. asked: a colour, or auto. Raises InputError for a picture that cannot be read."""
    if masked:
        lacking = sum(s.mask is None for s in sources)
        return None, "masks say what is the object" + f"; {lacking} pictures have none: taken whole" * bool(lacking)
    if has_alpha:
        return None, "alpha says what is the object"
    if asked != "auto":
        found = colour_of(asked)
        return found, f"what is {found} and reaches the border is background, as --background says"
    chosen = [sources[i] for i in np.unique(np.linspace(0, len(sources) - 1, MEASURED).round().astype(int))]
    if measured := common_colour(s.read(remedy)[..., :3] for s in chosen):
        return measured, f"what is {measured} and reaches the border is background, as measured there"
    return None, (
        "no alpha, no masks, no constant colour behind the object: the whole scene is reconstructed, what lies far "
        "outside of the volume too; for the object alone give masks"
    )
