# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel with an asset's sliders."""

from timesplat.model.io.ply import write_ply

from ..helpers import make

PANEL = """
import types
display, sliders = part("addon.asset.display"), part("addon.asset.sliders")
result_panel = part("addon.ui.result_panel")
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(part("model.io.ply").read_ply(sys.argv[1]), "a")
drawn, buttons, labels = {}, [], []
class Layout:
    def panel(self, name, default_closed): return self, self
    def row(self, **_): return self
    column = row
    def label(self, text="", **_): labels.append(text)
    def operator(self, name, **_): return buttons.append(name) or types.SimpleNamespace()
    def operator_menu_enum(self, name, key, **_): buttons.append(name)
    def prop(self, owner, key, text=""):
        if key == "value":
            owner.bl_rna.properties[key]
        else:
            owner.path_resolve(key)
        drawn[text] = key
panel = types.SimpleNamespace(layout=Layout())
scene = bpy.context.scene
sliders.set_input(sliders.asset_modifier(ob), "Crop", True)
for transform in ("AgX", "Standard"):
    scene.view_settings.view_transform = transform
    buttons.clear()
    result_panel.TIMESPLAT_PT_result.draw(panel, bpy.context)
    if transform == "AgX":
        warned = list(buttons)
all_drawn = list(drawn)
drawn.clear()
sliders.set_input(sliders.asset_modifier(ob), "Crop", False)
result_panel.TIMESPLAT_PT_result.draw(panel, bpy.context)
scene.view_settings.view_transform = "AgX"
part("addon").register()
bpy.ops.timesplat.set_standard()
poll = [result_panel.TIMESPLAT_PT_result.poll(bpy.context)]
bpy.ops.object.delete()
poll.append(result_panel.TIMESPLAT_PT_result.poll(bpy.context))
tell(drawn=all_drawn, uncropped=list(drawn), sliders=list(sliders.SLIDERS), warned=warned, buttons=buttons,
     labels=labels, poll=poll, transform=scene.view_settings.view_transform)
part("addon").unregister()
"""


def test_the_panel_shows_the_modifiers_own_sliders(blender, tmp_path):
    write_ply(tmp_path / "a.ply", make(1234))
    told = blender(PANEL, tmp_path / "a.ply")
    assert told["drawn"] == told["sliders"] and "1,234 Gaussians" in told["labels"]
    assert told["uncropped"] == [x for x in told["sliders"] if x not in ("Crop Min", "Crop Max")]
    assert "timesplat.set_standard" in told["warned"] and "timesplat.set_standard" not in told["buttons"]
    assert {"timesplat.compare", "timesplat.bake", "timesplat.delete"} <= set(told["buttons"])
    assert told["transform"] == "Standard" and told["poll"] == [True, False]
