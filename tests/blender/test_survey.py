# SPDX-License-Identifier: GPL-3.0-or-later
"""What is found in scenes as artists have them, and said before anything is rendered."""

SCENE = """
import bmesh
part("addon").register()
survey, settings, notices = (part(f"addon.{x}") for x in ("survey", "settings", "notices"))
estimates, InputError = part("addon.estimates"), part("datagen.sequence").InputError
scene, chosen = bpy.context.scene, bpy.context.scene.timesplat
for o in list(bpy.data.objects):
    bpy.data.objects.remove(o)
def named(name, ob=None):
    ob = ob or bpy.context.object
    ob.name = name
    return ob
bpy.ops.mesh.primitive_monkey_add(size=2)
hero = named("Hero")
def said():
    bpy.context.view_layer.update()
    try:
        return notices.notices(chosen, bpy.context, estimates.estimate(chosen, bpy.context))
    except InputError as e:
        return ["! " + str(e)]
def captured():
    bpy.context.view_layer.update()
    return sorted(o.name for o in settings.objects(chosen, bpy.context) if o.type not in ("LIGHT", "CAMERA"))
def keyed(ob, *frames):
    for frame in frames:
        ob.location.x = frame
        ob.keyframe_insert("location", frame=frame)
"""
AROUND = """
told = {"alone": [said(), captured()]}
bpy.ops.mesh.primitive_plane_add(size=40)
ground = named("Ground")
told["ground"] = [said(), captured()]
chosen.leave_out = False
told["kept"] = [said(), captured()]
chosen.leave_out = True
bpy.ops.mesh.primitive_plane_add(size=40, location=(0, 20, 20), rotation=(np.pi / 2, 0, 0))
named("Wall")
bpy.ops.mesh.primitive_uv_sphere_add(radius=30)
named("Sky")
told["more"] = [said(), captured()]
chosen.source = "SELECTED"
told["selected"] = captured()
chosen.source = "SCENE"
for name in ("Wall", "Sky"):
    bpy.data.objects.remove(bpy.data.objects[name])
ground.scale = (0.06, 0.06, 1)  # 2.4: no larger than she is
told["pedestal"] = captured()
ground.scale = (1, 1, 1)
keyed(ground, 1, 5)  # it moves: it is what is shown
told["moving"] = captured()
ground.animation_data_clear()
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.03, location=(0.35, -0.78, 0.24))
named("Eye")
bpy.data.objects.remove(ground)
told["eye"] = captured()
bpy.data.objects.remove(hero)
bpy.ops.mesh.primitive_uv_sphere_add(radius=1)
named("Statue")
bpy.data.objects["Eye"].location = (0, -0.95, 0.2)
told["statue"] = captured()
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.2)
ball = named("Ball")
def shape(name, *boxes):
    parts = []
    for size, place in boxes:
        bpy.ops.mesh.primitive_cube_add(size=1, location=place, scale=size)
        parts.append(bpy.context.object)
    with bpy.context.temp_override(active_object=parts[0], selected_editable_objects=parts):
        bpy.ops.object.join()
    return named(name, parts[0])
scene, chosen = bpy.context.scene, bpy.context.scene.timesplat
table = shape("Table", ((3, 2, 0.1), (0, 0, -0.25)), ((0.1, 0.1, 1), (1.4, 0, -0.8)))
told["table"] = captured()
bpy.data.objects.remove(table)
shape("Sweep", ((8, 8, 0.1), (0, 0, -0.25)), ((8, 0.1, 6), (0, 4, 2.5)))
told["sweep"] = captured()
tell(**told)
"""


def test_surroundings_are_named_and_left_out(blender):
    told = blender(SCENE + AROUND)
    assert told["alone"] == [[], ["Hero"]]
    assert told["ground"] == [["Left out as surroundings: Ground."], ["Hero"]]
    assert told["kept"] == [["All else will be small in the pictures beside Ground."], ["Ground", "Hero"]]
    assert told["more"][1] == ["Hero"] and sorted(told["more"][0][0][26:-1].split(", ")) == ["Ground", "Sky", "Wall"]
    assert told["selected"] == ["Sky"] and told["pedestal"] == ["Ground", "Hero"] == told["moving"]
    assert told["eye"] == ["Eye", "Hero"] and told["statue"] == ["Eye", "Statue"], "an eye is no reason"
    assert told["table"] == ["Ball", "Table"] and told["sweep"] == ["Ball"]


ENDS = """
told = {"still": said()}
keyed(hero, 1, 13)
told["13"] = [said(), list(settings.frames(chosen, scene))]
chosen.frame_range, chosen.frame_end = "CUSTOM", 48
told["own"] = [said(), list(settings.frames(chosen, scene))]
chosen.frame_range = "SCENE"
curve = survey._curves(hero.animation_data.action)[0]
cycles = curve.modifiers.new("CYCLES")
told["cycles"] = [said(), list(settings.frames(chosen, scene))]
curve.modifiers.remove(cycles)
scene.frame_end = 10
told["cut"] = [said(), list(settings.frames(chosen, scene))]
scene.frame_end = 250
hero.modifiers.new("c", "CLOTH")
told["cloth"] = said()
tell(**told)
"""


def test_an_animation_that_ends_early_is_noticed(blender):
    told = blender(SCENE + ENDS)
    assert told["still"] == told["cloth"] == []
    assert told["13"] == [["The animation ends at 13: frames 1 to 13 are captured."], list(range(1, 14))]
    assert told["own"] == [[], list(range(1, 49, 3))[:24]] or told["own"][1][-1] > 13
    assert told["cycles"][0] == [] and told["cycles"][1][-1] > 200
    assert told["cut"] == [[], list(range(1, 11))]


CLEAR = """
def material(kind):
    made = bpy.data.materials.new(kind)
    made.use_nodes = True
    tree = made.node_tree
    end = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
    if kind == "glass":
        tree.links.new(tree.nodes.new("ShaderNodeBsdfGlass").outputs[0], end.inputs["Surface"])
    elif kind == "smoke":
        tree.links.remove(end.inputs["Surface"].links[0])
        tree.links.new(tree.nodes.new("ShaderNodeVolumePrincipled").outputs[0], end.inputs["Volume"])
    return made
bpy.ops.mesh.primitive_cube_add(size=0.5)
cube = named("Cube")
cube.data.materials.append(material("glass"))
told = {"some": [said(), settings.method(chosen, settings.objects(chosen, bpy.context))]}
cube.scale = (8, 8, 8)
told["most"] = [said(), settings.method(chosen, settings.objects(chosen, bpy.context))]
cube.data.materials[0] = material("smoke")
told["smoke"] = said()
request = part("addon.operators.reconstruct").request(chosen, bpy.context)
told["request"] = [request["passes"], request["tracks"]]
chosen.method = "deform"
told["chosen"] = said()
cube.data.materials[0] = material("plain")
chosen.method, chosen.budget, chosen.number, chosen.quality = "tracks", "NUMBER", 40_000, "DRAFT"
told["number"] = said()
chosen.quality = "FINE"
told["enough"] = said()
told["followed"] = part("addon.operators.reconstruct").request(chosen, bpy.context)["tracks"]
tell(**told)
"""


def test_what_has_no_surface_goes_by_pictures_alone(blender):
    told = blender(SCENE + CLEAR)
    assert told["some"] == [["Cube: glass has no surface to follow; Pictures Only is for that."], "tracks"]
    assert told["most"] == [["Cube: glass has no surface, so that Pictures Only is used."], "deform"]
    assert told["smoke"] == ["Cube: a volume has no surface, so that Pictures Only is used."]
    assert told["request"] == [False, None] and told["chosen"] == []
    assert told["number"] == ["Not 40,000 but 10,000 Gaussians: Quality Draft has no more; choose another."]
    assert told["enough"] == [] and told["followed"] == 40_000


HAIR = """
curves = bpy.data.hair_curves.new("Fur")
fur = bpy.data.objects.new("Fur", curves)
scene.collection.objects.link(fur)
told = {"curves": said()}
bpy.data.objects.remove(fur)
bpy.context.view_layer.objects.active = hero
bpy.ops.object.particle_system_add()
hero.particle_systems[0].settings.type = "HAIR"
told["particles"] = said()
hero.modifiers[0].show_render = False
told["hidden"] = said()
hero.modifiers[0].show_render = True
chosen.method = "deform"
told["pictures"] = said()
chosen.method = "tracks"
hero.modifiers.clear()
lamp = bpy.data.materials.new("lamp")
lamp.use_nodes = True
tree = lamp.node_tree
surface = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
hero.data.materials.append(lamp)
told["dark"] = said()
surface.inputs["Emission Color"].default_value = (1, 0.5, 0, 1)
surface.inputs["Emission Strength"].default_value = 1.0
told["dim"] = said()
surface.inputs["Emission Strength"].default_value = 5.0
told["bright"] = said()
surface.inputs["Emission Color"].default_value = (0, 0, 0, 1)
told["black"] = said()
glow = tree.nodes.new("ShaderNodeEmission")
glow.inputs["Strength"].default_value = 9.0
told["loose"] = said()
tree.links.new(glow.outputs[0], next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL").inputs["Surface"])
told["node"] = said()
tell(**told)
"""


def test_how_hair_and_what_glows_are_captured_is_said(blender):
    told = blender(SCENE + HAIR)
    assert told["curves"] == [
        "Fur: hair curves are followed, each strand at least a pixel wide: finer fur needs a higher Resolution."
    ]
    assert told["particles"] == [
        "Hero: hair of particle systems is led by motion vectors, which is less sharp; as hair curves it is followed."
    ]
    assert told["hidden"] == told["pictures"] == told["dark"] == told["dim"] == told["black"] == told["loose"] == []
    glows = ["Hero: what glows keeps its colour up to white, and lights nothing new afterwards."]
    assert told["bright"] == told["node"] == glows


SELECTED = """
def part():
    bpy.context.view_layer.update()
    return settings.part_is_selected(bpy.context)
hero.select_set(True)
told = {"alone": part()}
bpy.ops.mesh.primitive_plane_add(size=40)
ground = named("Ground")
bpy.ops.object.select_all(action="DESELECT")
hero.select_set(True)
told["surroundings"] = part()  # the ground is not captured: she is all that is
bpy.ops.mesh.primitive_cube_add(location=(3, 0, 0))
cube = named("Cube")
told["one"] = part()
cube.select_set(False)
told["none"] = part()
bpy.ops.object.light_add()
told["light"] = part()
bpy.ops.object.select_all(action="DESELECT")
cube.parent = hero
hero.select_set(True)
told["family"] = part()
panel = __import__("timesplat.addon.ui.panel", fromlist=["x"])
made = []
class Layout:
    def __getattr__(self, name): return lambda *a, **k: Layout()
    def operator(self, name, text="", **_):
        made.append([name, text, type("Made", (), {})()])
        return made[-1][2]
def drawn():
    made.clear()
    panel.TIMESPLAT_PT_panel.draw(type("Panel", (), {"layout": Layout()})(), bpy.context)
    return [[text, o.source] for name, text, o in made if name == "timesplat.reconstruct"]
told["whole"] = drawn()
cube.parent = None
told["offered"] = drawn()
chosen.source = "SELECTED"
told["chosen"] = drawn()
tell(**told)
"""


def test_what_is_selected_is_offered_first(blender):
    told = blender(SCENE + SELECTED)
    assert told["alone"] is told["surroundings"] is told["none"] is told["light"] is told["family"] is False
    assert told["one"] is True
    assert told["whole"] == [["Reconstruct", "SCENE"]]
    assert told["offered"] == [["Reconstruct Selected", "SELECTED"], ["All", "SCENE"]]
    assert told["chosen"] == [["Reconstruct", "SELECTED"]]


ROOM = """
bpy.ops.mesh.primitive_cube_add(size=9)
named("Room")
bpy.ops.object.camera_add(location=(3, -3, 1))
scene.camera = eye = bpy.context.object
def refused():
    bpy.context.view_layer.update()
    try:
        notices.refuse_views_from_outside(chosen, bpy.context)
    except InputError as e:
        return str(e)
estimates = __import__("timesplat.addon.estimates", fromlist=["x"])
def said():
    return [x for x in notices.notices(chosen, bpy.context, estimates.estimate(chosen, bpy.context)) if "room" in x]
eye.select_set(False)
told = {"inside": refused(), "inside_said": said()}
eye.select_set(True)
told["dark"] = refused()
chosen.lighting = False
told["chosen"] = refused()
told["chosen_said"] = said()
chosen.lighting = True
eye.select_set(False)
eye.location = (20, 0, 0)
told["outside"] = refused()
told["outside_said"] = said()
tell(**told)
"""


def test_cameras_outside_of_a_room_are_refused(blender):
    told = blender(SCENE + ROOM)
    assert told["chosen"] is None and told["outside"] is None
    assert told["chosen_said"] == told["outside_said"] == []
    assert len(told["inside_said"]) == 1 and "Camera stands amid" in told["inside_said"][0]
    assert "Camera: they stand inside" in told["dark"] and "Studio Lighting" in told["dark"]
    assert "inside of what is captured" in told["inside"] and "stand inside too (Camera)" in told["inside"]
