"""Cameras that stand still and film the balls of `worlds`: videos, and the layouts that have them."""

from dataclasses import replace

import av
import numpy as np

from timesplat.datagen.sequence import opengl_to_opencv

from .worlds import on_white, photograph, shots


def write_video(path, frames, rate=24, codec="libx264rgb", pix_fmt="rgb24", **options):
    """frames (H,W,3) uint8, without loss unless said."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"qp": "0"} | {k: str(v) for k, v in options.items()} if codec == "libx264rgb" else options
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=rate, options={k: str(v) for k, v in options.items()})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt
        for x in frames:
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(x), format="rgb24")):
                file.mux(packet)
        for packet in stream.encode():
            file.mux(packet)
    return path


def rig(cameras=6, moments=5, lens=None):
    """Of each camera its shots: the same pose at every moment."""
    still = shots(cameras, **({"lens": lens} if lens else {}))
    times = np.linspace(0, 1, moments)
    return [[replace(s, time=float(t), camera=f"{k:02d}") for t in times] for k, s in enumerate(still)]


def film(folder, films, name="cam{}.mp4", rate=24, **how):
    """A video of each camera, on white."""
    for shots_of_one in films:
        frames = [on_white(photograph(s)) for s in shots_of_one]
        write_video(folder / name.format(shots_of_one[0].camera), frames, rate, **how)


def poses_bounds(films):
    """(V,17) as LLFF writes cameras: down, right, backwards, place, and height, width, focal length."""
    rows = []
    for s, *_ in films:
        right, up, back, place = s.c2w[:3].T
        hwf = np.array([s.lens.height, s.lens.width, s.lens.fx])
        rows.append([*np.stack([-up, right, back, place, hwf], -1).ravel(), 1.0, 5.0])
    return np.array(rows)


def calibration(films):
    """K, R (3,3), T, D and the size of each camera, as OpenCV has them: pixel centres at whole numbers."""
    found = {}
    for s, *_ in films:
        w2c, lens = np.linalg.inv(opengl_to_opencv(s.c2w)), s.lens
        K = np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
        k1, k2, k3 = [*lens.radial[:3], *np.zeros(3 - len(lens.radial[:3]))]
        D = np.array([k1, k2, *lens.tangential, k3])
        found[s.camera] = {"K": K, "R": w2c[:3, :3], "T": w2c[:3, 3:], "D": D, "H": lens.height, "W": lens.width}
    return found
