# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender shows of an asset object, and what it should show."""

READ = """
def shown(ob, *names):
    \"\"\"Attributes of the evaluated point cloud at the scene's frame, as lists; {} where it is empty.\"\"\"
    graph = bpy.context.evaluated_depsgraph_get()
    for i in graph.object_instances:  # a mesh that stands in for a point cloud has it as an instance
        if i.object.type == "POINTCLOUD" and (i.object.original == ob or i.parent and i.parent.original == ob):
            data, out = i.object.data, {}
            names = names if len(data.points) else ()
            for name in names:
                attribute = data.attributes[name]
                key, width = {"FLOAT": ("value", 1), "FLOAT_VECTOR": ("vector", 3), "FLOAT_COLOR": ("color", 4),
                              "QUATERNION": ("value", 4)}[attribute.data_type]
                a = np.empty(len(data.points) * width, np.float32)
                attribute.data.foreach_get(key, a)
                out[name] = (a.reshape(-1, width) if width > 1 else a).tolist()
            out["world"] = [list(i.matrix_world @ p.co) for p in data.points][:5]
            out["material"] = data.materials[0].name if len(data.materials) and data.materials[0] else ""
            return out
    return {}
"""


def expected_time(s, frame):
    """The model time that the documentation promises, written another way than in nodes.py and apply_sliders.py."""
    start, end = s["Frame Start"], s["Frame End"]
    moved = start + (frame - start - s["Time Offset"]) * s["Time Scale"]
    if start == end:
        return 0.0
    if s["Repeat"] == "Loop":  # shown once a round: every frame of the clip
        while moved < start:
            moved += end - start + 1
        while moved >= end + 1:
            moved -= end - start + 1
    while s["Repeat"] == "Ping-Pong" and not start <= moved <= end:
        moved = 2 * (start if moved < start else end) - moved
    return 2 * (min(max(moved, start), end) - start) / (end - start) - 1
