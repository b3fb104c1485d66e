# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that a renderer meets among hundreds of thousands: cut off, with bits turned over, or made to do harm. Built by
Blender or by hand from seeds; `build_damaged` and `build_evil` put them into a folder."""

import random
import struct
import zlib
from pathlib import Path

import bpy

from timesplat.datagen.scene.open import empty_session

from .helpers import cube, export_glb, glb_bytes, key, triangle_document, write_file

KINDS = ("glb", "obj", "fbx", "usdc", "blend")


def whole_files(folder: Path) -> dict[str, bytes]:
    """kind -> a small file of it that renders: a cube that moves and turns, with a texture."""
    empty_session()
    ob = cube()
    key(ob, "location", {1: (0, 0, 0), 8: (2, 0, 0)})
    image = bpy.data.images.new("checks", 16, 16)
    image.pixels[:] = [float(i % 3 == 0) for i in range(16 * 16 * 4)]
    image.pack()
    ob.data.materials.append(material := bpy.data.materials.new("painted"))
    material.use_nodes = True
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    shader = material.node_tree.nodes["Principled BSDF"]
    material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 8
    name = {kind: str(folder / f"whole.{kind}") for kind in KINDS}
    bpy.ops.wm.save_as_mainfile(filepath=name["blend"], compress=False)
    bpy.ops.wm.usd_export(filepath=name["usdc"], export_animation=True, export_textures_mode="KEEP")
    bpy.ops.export_scene.fbx(filepath=name["fbx"])
    bpy.ops.wm.obj_export(filepath=name["obj"])
    bpy.ops.export_scene.gltf(filepath=name["glb"])
    return {kind: Path(name[kind]).read_bytes() for kind in KINDS}


def build_damaged(folder: Path, whole: dict[str, bytes], each: int, seed: int = 0) -> list[str]:
    """`each` files of every kind, every second one cut off, the others with up to 16 bits turned over; their names."""
    rng, names = random.Random(seed), []
    for kind, data in whole.items():
        for i in range(each):
            if i % 2 == 0:
                damaged = bytearray(data[: rng.randrange(len(data))])
            else:
                damaged = bytearray(data)
                start = 0 if rng.random() < 0.3 else 200  # seldom in the head, which is soon found out
                for _ in range(rng.choice((1, 1, 2, 4, 16))):
                    damaged[rng.randrange(min(start, len(data) - 1), len(data))] ^= 1 << rng.randrange(8)
            names.append(f"{kind}-{i:03d}.{kind}")
            (folder / names[-1]).write_bytes(damaged)
    return names


def png_header(width: int, height: int) -> bytes:
    """A PNG that says how large it is, and holds next to nothing."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0" * 4096)) + chunk(b"IEND", b"")


def build_evil(folder: Path, canary: Path) -> dict[str, str]:
    """name of the file -> what is expected of it, a status of the table. canary: a file that exists if any of them got
    something executed or written."""
    expected = {}

    def put(name, data, status):
        write_file(folder / name, data)
        expected[name] = status

    document, binary = triangle_document()
    empty = dict(document, nodes=[{"name": "nothing"}])
    put("no_mesh.glb", glb_bytes(empty, binary), "refused")
    for name, x in (("nan", float("nan")), ("infinite", float("inf")), ("far", 1e30)):
        put(f"{name}.glb", glb_bytes(*triangle_document(x)), "refused")
        put(f"{name}.obj", f"v 0 0 0\nv 0 1 0\nv {x} 0 0\nf 1 2 3\n".encode(), "refused")
    put("nested.gltf", b"[" * 100_000, "refused")
    put("nothing.glb", b"", "refused")
    put("liar.glb", glb_bytes(dict(document, accessors=[a | {"count": 2**31} for a in document["accessors"]]), binary),
        "refused")  # fmt: skip
    put("climbing.gltf", triangle_document(uri="../../../../../../etc/passwd")[0], "refused")
    (folder / "30k.png").write_bytes(png_header(30_000, 30_000))
    put("texture_30k.glb", glb_bytes(*triangle_document(image="30k.png")), "rendered")
    put("texture_outside.glb", glb_bytes(*triangle_document(image="../../../../../etc/hostname")), "rendered")
    lib = "mtllib ../../../../../../etc/passwd\nmtllib m.mtl\n"
    (folder / "m.mtl").write_text("newmtl m\nmap_Kd ../../../../../../etc/hostname\n")
    put("climbing.obj", f"{lib}v 0 0 0\nv 0 1 0\nv 1 0 0\nusemtl m\nf 1 2 3\n".encode(), "rendered")
    put("faces_of_nothing.obj", b"v 0 0 0\nv 0 1 0\nv 1 0 0\nf 1 2 99999999\n", "refused")
    _animations(folder, expected)
    _scripts(folder / "script.blend", canary)
    expected["script.blend"] = "rendered"
    return expected


def _animations(folder: Path, expected: dict[str, str]) -> None:
    """Cubes whose animation has no length, one frame, two thousand, or keys at no time at all."""
    for name, keys in (("frames_0", {0: 0}), ("frames_1", {5: 0, 6: 1}), ("frames_2000", {0: 0, 2000: 3})):
        empty_session()
        key(cube(), "location", {frame: (x, 0, 0) for frame, x in keys.items()})
        export_glb(folder / f"{name}.glb")
        expected[f"{name}.glb"] = "rendered"
    empty_session()
    curve = cube().animation_data_create()
    curve.action = bpy.data.actions.new("never")
    bpy.context.object.keyframe_insert("location", frame=1)
    points = next(iter(bpy.data.actions["never"].layers[0].strips[0].channelbags[0].fcurves)).keyframe_points
    points[0].co = (float("inf"), 1.0)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "never.blend"))
    expected["never.blend"] = ""  # whatever: it must be accounted for


def _scripts(path: Path, canary: Path) -> None:
    """A .blend that would write the canary when it is opened, when frames change, and by a driver."""
    empty_session()
    ob = cube()
    text = bpy.data.texts.new("evil.py")
    writes = f"open({str(canary)!r}, 'w').close()"
    text.write(f"import bpy\n{writes}\nbpy.app.handlers.frame_change_pre.append(lambda *a: {writes})\n")
    text.use_module = True
    ob.driver_add("location", 0).driver.expression = f"__import__('pathlib').Path({str(canary)!r}).touch() or 0"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))


def build_hanging(folder: Path) -> str:
    """A file that keeps Blender's importer busy for a very long time: more objects of one name than it can count."""
    document, binary = triangle_document()
    many = [{"name": "x", "mesh": 0} for _ in range(300_000)]
    document |= {"nodes": many, "scenes": [{"nodes": list(range(len(many)))}]}
    write_file(folder / "hangs.glb", glb_bytes(document, binary))
    return "hangs.glb"


def build_hungry(folder: Path) -> str:
    """A file of nothing that becomes gigabytes: a cube, divided eleven times."""
    empty_session()
    divide = cube().modifiers.new("divide", "SUBSURF")
    divide.levels, divide.render_levels = 0, 11
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "hungry.blend"))
    return "hungry.blend"
