"""Ground floor: a Blender scene becomes a Sequence. bpy, numpy, OpenEXR; never torch."""
